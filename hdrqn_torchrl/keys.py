"""TensorDict keys shared by environments, modules, replay and losses.

Classes take their keys as arguments, of which these are the defaults; how an episode ends and begins (``done``,
``terminated``, ``truncated``, ``is_init``) has the names that TorchRL gives it wherever it is the end of an episode and
not of something else. Shapes leave out the batch dimensions; ``G`` is the number of subgoals, ``H`` the size of an LSTM
state.
"""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey

# Written by the environment.
OBSERVATION = "observation"  # cell codes [V, V] or others, pixels [C, height, width] uint8, or a vector [D]: o_t
REWARD = "reward"  # [1] float32: total reward of the task
EXTRINSIC_REWARD = "extrinsic_reward"  # [1] float32: r^ex
ATTAINED = "attained"  # [G] bool: subgoals reached in this step, whichever was chosen
AVAILABLE = "available"  # [G] bool: subgoals worth choosing now; optional
ACTION_MASK = "action_mask"  # [A] bool: actions that can be chosen now; optional
HAZARD = "hazard"  # [1] bool: obstacle hit or life lost in this step
EVENTS = "events"  # [K] int64: what happened in this step, where an agent finds its subgoals itself (discovery/)
SUCCESS = "success"  # [1] bool: the whole task was completed in this step
IS_INIT = "is_init"  # [1] bool: first step of an episode
PIXELS = "pixels"  # [height, width, 3] uint8: the whole screen
POSITION = "position"  # [2] float32: the agent's place on the screen, x and y in pixels

# Written by the policy.
ACTION = "action"  # [] int64
SUBGOAL = "subgoal"  # [] int64: the meta-controller's choice, used only where OPTION_INIT is set
ACTION_VALUE = "action_value"  # [A] float32: Q-values of the actions; [G, A] for all subgoals at once
SUBGOAL_VALUE = "subgoal_value"  # [G] float32: Q-values of the subgoals
SUB_HIDDEN, SUB_CELL = "sub_hidden", "sub_cell"  # [H] float32: h^S
MEMORY_HIDDEN, MEMORY_CELL = "memory_hidden", "memory_cell"  # [H] float32: v3's memory of the whole episode
PREVIOUS_ACTION = "previous_action"  # [] int64: action of the step before; meaningless in an episode's first step
ACTION_EXPLORATION = "repeated_action"  # [2] int64: state that the exploration of actions carries between steps
SUBGOAL_EXPLORATION = "subgoal_exploration"  # the same for the exploration of subgoals, if it carries any
META_HIDDEN, META_CELL = "meta_hidden", "meta_cell"  # [H] float32: h^M

# Written by SubgoalTransform.
OPTION_INIT = "option_init"  # [1] bool: the next policy call starts an option
ACTIVE_SUBGOAL = "active_subgoal"  # [] int64: subgoal g of the option in progress
SUBGOAL_MASK = "subgoal_mask"  # [G] bool: subgoals that can be chosen
OPTION_STEPS = "option_steps"  # [1] int64: k, steps of the option so far
OPTION_RETURN = "option_return"  # [1] float32: discounted r^ex that the option has collected so far
SUBGOAL_REACHED = "subgoal_reached"  # [1] bool: the active subgoal was reached in this step
OPTION_DONE = "option_done"  # [1] bool: the option ended, for whatever reason
OPTION_TERMINATED = "option_terminated"  # [1] bool: subgoal reached or lost, or option above or episode terminated
INTRINSIC_REWARD = "intrinsic_reward"  # [1] float32: r^in

# Written by hindsight (data/hindsight.py).
ELIGIBLE = "eligible"  # [1] bool: the step may enter the loss
HINDSIGHT_SUBGOAL = "hindsight_subgoal"  # [] int64: the subgoal that the option attained, or else the one it pursued

# TorchRL's own keys.
DONE, TERMINATED, TRUNCATED = "done", "terminated", "truncated"
TRAJ_IDS = ("collector", "traj_ids")
PAD_MASK = ("collector", "mask")  # written by SliceSampler when it pads short trajectories


@dataclass(frozen=True)
class OptionKeys:
    """Names of the entries that belong to one set of subgoals: what was attained, and its option book.

    Every set except the farthest has its own prefix, so that the books of several levels can exist side by side.

    Args:
        prefix: put before each name; empty for the farthest set, which every hierarchical agent uses.

    Examples:
        >>> OptionKeys().attained, OptionKeys("rooms").attained
        ('attained', 'rooms_attained')
    """

    prefix: str = ""

    def of(self, key: str) -> str:
        """The name of the entry ``key`` for this set of subgoals."""
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


def next_key(key: NestedKey) -> tuple[str, ...]:
    """Where TorchRL puts what comes after a step.

    Examples:
        >>> next_key("sub_hidden")
        ('next', 'sub_hidden')
    """
    return ("next", *((key,) if isinstance(key, str) else key))
