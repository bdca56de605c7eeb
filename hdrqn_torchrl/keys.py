"""TensorDict keys shared by environments, modules, replay and losses.

Every class takes its keys as arguments; the names below are only their defaults. Shapes are given
after the batch dimensions, ``G`` is the number of subgoals and ``H`` the size of an LSTM state.
"""

from __future__ import annotations

from dataclasses import dataclass

# Written by the environment.
OBSERVATION = "observation"  # [V, V] uint8 cell codes, or [3, 44, 44] uint8 pixels: o_t
REWARD = "reward"  # [1] float32: total reward of the task
EXTRINSIC_REWARD = "extrinsic_reward"  # [1] float32: r^ex
ATTAINED = "attained"  # [G] bool: subgoals reached by this very step
AVAILABLE = "available"  # [G] bool: subgoals worth choosing now; not every environment has it
HAZARD = "hazard"  # [1] bool: obstacle hit or life lost in this step
SUCCESS = "success"  # [1] bool: the whole task was completed by this very step
IS_INIT = "is_init"  # [1] bool: first step of an episode
PIXELS, POSITION = (
    "pixels",
    "position",
)  # [height, width, 3] uint8: a whole screen; [2] float32: where the agent is on it

# Written by the policy.
ACTION = "action"  # [] int64
SUBGOAL = "subgoal"  # [] int64: the meta-controller's proposal, honoured where OPTION_INIT
ACTION_VALUE = "action_value"  # [A] float32: Q-values; [G, A] where every subgoal has its own
SUBGOAL_VALUE = "subgoal_value"  # [G] float32: Q-values of the meta level where one module has both
SUB_HIDDEN, SUB_CELL = "sub_hidden", "sub_cell"  # [H] float32: h^S
MEMORY_HIDDEN, MEMORY_CELL = "memory_hidden", "memory_cell"  # [H] float32: v3's memory of the whole episode
PREVIOUS_ACTION = "previous_action"  # [] int64: action of the step before; meaningless at the first step
ACTION_EXPLORATION = "repeated_action"  # carried by the exploration of actions: [2] int64, a stretch in progress
SUBGOAL_EXPLORATION = "subgoal_exploration"  # the same for subgoals, if theirs carries something
META_HIDDEN, META_CELL = "meta_hidden", "meta_cell"  # [H] float32: h^M

# Written by SubgoalTransform.
OPTION_INIT = "option_init"  # [1] bool: the next policy call starts an option
ACTIVE_SUBGOAL = "active_subgoal"  # [] int64: g of the option in progress
SUBGOAL_MASK = "subgoal_mask"  # [G] bool: subgoals that can be chosen
OPTION_STEPS = "option_steps"  # [1] int64: k
OPTION_RETURN = "option_return"  # [1] float32: r^ex collected by the option
SUBGOAL_REACHED = "subgoal_reached"  # [1] bool
OPTION_DONE = "option_done"  # [1] bool
OPTION_TERMINATED = "option_terminated"  # [1] bool
INTRINSIC_REWARD = "intrinsic_reward"  # [1] float32: r^in

# Written by hindsight (data/hindsight.py).
ELIGIBLE = "eligible"  # [1] bool: the step may enter the loss
HINDSIGHT_SUBGOAL = "hindsight_subgoal"  # [] int64: the subgoal that an option attained or, failing that, pursued

# TorchRL's own.
DONE, TERMINATED, TRUNCATED = "done", "terminated", "truncated"
TRAJ_IDS = ("collector", "traj_ids")
PAD_MASK = ("collector", "mask")  # written by SliceSampler where it pads short trajectories


@dataclass(frozen=True)
class OptionKeys:
    """Names of the entries that concern one set of subgoals: what is attained, and the book of options for them.

    Every set but the farthest has a prefix of its own, so that books of several levels lie side by side.

    Args:
        prefix: put before each name; empty for the farthest set, which every hierarchical agent has.

    Examples:
        >>> OptionKeys().attained, OptionKeys("rooms").attained
        ('attained', 'rooms_attained')
    """

    prefix: str = ""

    def of(self, key: str) -> str:
        """The name of an entry for this set of subgoals."""
        return f"{self.prefix}_{key}" if self.prefix else key

    @property
    def attained(self) -> str:
        return self.of(ATTAINED)

    @property
    def available(self) -> str:
        return self.of(AVAILABLE)

    @property
    def subgoal(self) -> str:
        return self.of(SUBGOAL)

    @property
    def subgoal_value(self) -> str:
        return self.of(SUBGOAL_VALUE)

    @property
    def exploration(self) -> str:
        return self.of(SUBGOAL_EXPLORATION)

    @property
    def option_init(self) -> str:
        return self.of(OPTION_INIT)

    @property
    def active_subgoal(self) -> str:
        return self.of(ACTIVE_SUBGOAL)

    @property
    def subgoal_mask(self) -> str:
        return self.of(SUBGOAL_MASK)

    @property
    def option_steps(self) -> str:
        return self.of(OPTION_STEPS)

    @property
    def option_return(self) -> str:
        return self.of(OPTION_RETURN)

    @property
    def subgoal_reached(self) -> str:
        return self.of(SUBGOAL_REACHED)

    @property
    def option_done(self) -> str:
        return self.of(OPTION_DONE)

    @property
    def option_terminated(self) -> str:
        return self.of(OPTION_TERMINATED)

    @property
    def intrinsic_reward(self) -> str:
        return self.of(INTRINSIC_REWARD)
