"""The option book of a hierarchical agent, kept inside the environment (lines 14-26 of Algorithm 1).

Which subgoal is active, whether it was reached (the critic), the intrinsic reward, and what the option
has collected. All state lies in the tensordict, so partial resets, collectors and worker processes carry
it like any other entry.
"""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from hdrqn_torchrl import keys
from hdrqn_torchrl.transforms.critic import Critic, Verdict, set_where_reset
from hdrqn_torchrl.transforms.entries import Entries, set_spec
from hdrqn_torchrl.transforms.intrinsic import IntrinsicReward


class SubgoalTransform(Transform):
    r"""Turns a flat task into one of subgoals and options.

    At every step, with :math:`g` the active subgoal and :math:`k` the steps the option has lasted:

    1. :math:`g \leftarrow` the policy's ``subgoal`` where ``option_init`` was set, else it is kept;
    2. the critic: ``subgoal_reached`` :math:`=` ``attained``:math:`[g]`;
    3. :math:`r^{in} =` ``reached_reward`` if reached, plus ``hazard_reward`` if the hazard was met, plus
       ``wrong_subgoal_reward`` if another subgoal was attained;
    4. ``option_return`` grows by :math:`\gamma^{k} r^{ex}`, ``option_steps`` :math:`= k + 1`;
    5. ``option_done`` = reached, or the episode is done, or ``max_option_steps`` are over, or :math:`g` can no
       longer be chosen, or the option of the level above is done; ``option_terminated`` = reached, or lost (:math:`g`
       could be chosen before this step, cannot after it, and was not attained), or the option of the level above or
       the episode terminated.

    The policy's ``subgoal`` becomes an additional action. Put every transform that can end an episode
    (``StepCounter(max_steps)``) *before* this one, so that each end of an episode closes its option.

    Several sets of subgoals, from far to near, have one book each, the farther one before the nearer one. The nearer
    one has a ``prefix`` and sums what the farther one pays: ``SubgoalTransform(5, prefix="rooms",
    upper_done_key="option_done", upper_terminated_key="option_terminated", extrinsic_reward_key="intrinsic_reward")``.

    Args:
        num_subgoals: G.
        gamma: discount inside an option; 1.0 gives the plain sum of the extrinsic reward.
        max_option_steps: step limit of an option; it ends without termination. ``None``: no limit.
        reached_reward: intrinsic reward for reaching the active subgoal.
        hazard_reward: intrinsic reward for meeting the hazard.
        wrong_subgoal_reward: intrinsic reward for attaining a subgoal other than the active one.
        repeatable: whether a subgoal can be attained more than once in an episode. If not,
            ``subgoal_mask`` excludes what was attained, and an option that pursues it ends after one step.
        available_key: subgoals that are worth choosing now ``[*batch, G]``, written by the environment; it becomes
            ``subgoal_mask``, and ``repeatable`` is ignored. ``None``: the environment says nothing about it.
        critic: computes ``attained`` ``[*batch, G]`` from the tensordict that follows a step, and it is written as
            such (:class:`~hdrqn_torchrl.transforms.Critic`). ``None``: the environment has to write it.
        prefix: of the names of all entries that concern this set of subgoals (:class:`~hdrqn_torchrl.keys.OptionKeys`),
            where they are not given below.
        upper_done_key, upper_terminated_key: ``option_done`` and ``option_terminated`` of the level above, written
            before in the same step; ``None``: there is none. Steps that attain the farther subgoal must teach something
            about the nearer one, too: if they were left out, actions would be worth what they bring otherwise.
        hazard_key, extrinsic_reward_key: entries of the environment; ``hazard_key=None``: no hazard.
        done_key, terminated_key: end of the episode.
        attained_key: which subgoals a step attained.
        subgoal_key: the policy's proposal.
        option_init_key, active_subgoal_key, subgoal_mask_key, option_steps_key, option_return_key: the book.
        subgoal_reached_key, option_done_key, option_terminated_key, intrinsic_reward_key: the critic's verdict.

    Raises:
        ValueError: if a number breaks its rule, or the environment does not write what is read.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> env = TransformedEnv(MultiGoalGridEnv(num_envs=4, seed=0), SubgoalTransform(num_subgoals=2))
        >>> rollout = env.rollout(3, break_when_any_done=False)
        >>> rollout["next", "option_steps"].shape
        torch.Size([4, 3, 1])
    """

    def __init__(
        self,
        num_subgoals: int,
        *,
        gamma: float = 0.99,
        max_option_steps: int | None = None,
        reached_reward: float = 1.0,
        hazard_reward: float = -1.0,
        wrong_subgoal_reward: float = 0.0,
        repeatable: bool = False,
        available_key: NestedKey | None = None,
        critic: Verdict | None = None,
        prefix: str = "",
        upper_done_key: NestedKey | None = None,
        upper_terminated_key: NestedKey | None = None,
        hazard_key: NestedKey | None = keys.HAZARD,
        extrinsic_reward_key: NestedKey = keys.EXTRINSIC_REWARD,
        done_key: NestedKey = keys.DONE,
        terminated_key: NestedKey = keys.TERMINATED,
        attained_key: NestedKey | None = None,
        subgoal_key: NestedKey | None = None,
        option_init_key: NestedKey | None = None,
        active_subgoal_key: NestedKey | None = None,
        subgoal_mask_key: NestedKey | None = None,
        option_steps_key: NestedKey | None = None,
        option_return_key: NestedKey | None = None,
        subgoal_reached_key: NestedKey | None = None,
        option_done_key: NestedKey | None = None,
        option_terminated_key: NestedKey | None = None,
        intrinsic_reward_key: NestedKey | None = None,
    ) -> None:
        if num_subgoals < 1:
            raise ValueError(f"num_subgoals must be >= 1, got {num_subgoals}; give one for each subgoal of the task.")
        if not 0.0 <= gamma <= 1.0:
            raise ValueError(f"gamma must lie in [0, 1], got {gamma}; use 0.99, or 1.0 for an undiscounted sum.")
        if max_option_steps is not None and max_option_steps < 1:
            raise ValueError(f"max_option_steps must be >= 1 or None, got {max_option_steps}; use None for no limit.")
        names = keys.OptionKeys(prefix)
        self.attained_key, self.subgoal_key = attained_key or names.attained, subgoal_key or names.subgoal
        self.option_init_key = option_init_key or names.option_init
        self.active_subgoal_key = active_subgoal_key or names.active_subgoal
        self.subgoal_mask_key = subgoal_mask_key or names.subgoal_mask
        self.option_steps_key = option_steps_key or names.option_steps
        self.option_return_key = option_return_key or names.option_return
        self.subgoal_reached_key = subgoal_reached_key or names.subgoal_reached
        self.option_done_key = option_done_key or names.option_done
        self.option_terminated_key = option_terminated_key or names.option_terminated
        self.intrinsic_reward_key = intrinsic_reward_key or names.intrinsic_reward
        self.hazard_key = hazard_key if hazard_reward else None
        self.available_key, self.extrinsic_reward_key = available_key, extrinsic_reward_key
        self.done_key, self.terminated_key = done_key, terminated_key
        self.upper_done_key, self.upper_terminated_key = upper_done_key, upper_terminated_key
        self._carried = [self.option_init_key, self.active_subgoal_key, self.subgoal_mask_key]
        self._carried += [self.option_steps_key, self.option_return_key]
        self._reported = [self.subgoal_reached_key, self.option_done_key, self.option_terminated_key]
        upper = [upper_done_key, upper_terminated_key]
        read = [self.hazard_key, available_key, *upper, None if critic else self.attained_key]
        in_keys = [extrinsic_reward_key, *(key for key in read if key is not None)]
        super().__init__(in_keys=in_keys, out_keys=[*self._carried, *self._reported, self.intrinsic_reward_key])
        self.num_subgoals, self.gamma, self.max_option_steps = num_subgoals, gamma, max_option_steps
        self.repeatable = repeatable
        self.critic = (
            None
            if critic is None
            else Critic(num_subgoals, critic, prefix=prefix, repeatable=repeatable, attained_key=self.attained_key)
        )
        self.reward = IntrinsicReward(reached=reached_reward, hazard=hazard_reward, wrong_subgoal=wrong_subgoal_reward)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        init = tensordict.get(self.option_init_key)  # [*batch, 1]
        mask = tensordict.get(self.subgoal_mask_key)  # [*batch, G]
        subgoal = torch.where(
            init.squeeze(-1), tensordict.get(self.subgoal_key), tensordict.get(self.active_subgoal_key)
        )
        chosen = subgoal.unsqueeze(-1)
        book = tensordict.get(self.option_steps_key), tensordict.get(self.option_return_key)
        steps, collected = advance_option(init, *book, next_tensordict.get(self.extrinsic_reward_key), self.gamma)

        if self.critic is not None:
            next_tensordict = self.critic._step(tensordict, next_tensordict)
        attained = next_tensordict.get(self.attained_key)
        hazard = None if self.hazard_key is None else next_tensordict.get(self.hazard_key)
        reached = attained.gather(-1, chosen)
        terminated = reached | next_tensordict.get(self.terminated_key)
        done = reached | next_tensordict.get(self.done_key)
        if self.upper_done_key is not None:
            done = done | next_tensordict.get(self.upper_done_key)
        if self.upper_terminated_key is not None:
            terminated = terminated | next_tensordict.get(self.upper_terminated_key)
        if self.max_option_steps is not None:
            done = done | (steps >= self.max_option_steps)
        if self.available_key is not None or not self.repeatable:
            left = mask & ~attained if self.available_key is None else next_tensordict.get(self.available_key).clone()
            was, stays = mask.gather(-1, chosen), left.gather(-1, chosen)
            lost = was & ~stays & ~reached & ~next_tensordict.get(self.done_key)
            done, terminated, mask = done | ~(was & stays), terminated | lost, left

        for key, value in (
            (self.option_init_key, done),
            (self.active_subgoal_key, subgoal),
            (self.subgoal_mask_key, mask),
            (self.option_steps_key, steps),
            (self.option_return_key, collected),
            (self.subgoal_reached_key, reached),
            (self.option_done_key, done.clone()),
            (self.option_terminated_key, terminated),
            (self.intrinsic_reward_key, self.reward.of(attained, reached, hazard)),
        ):
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self.critic is not None:
            tensordict_reset = self.critic._reset(tensordict, tensordict_reset)
        book = self._fresh_book(tensordict_reset.batch_size, tensordict_reset.device)
        if self.available_key is not None:
            book[self.subgoal_mask_key] = tensordict_reset.get(self.available_key).clone()
        return set_where_reset(tensordict, tensordict_reset, book)

    def _fresh_book(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, Tensor]:
        """The option book at the start of an episode: an option is due, every subgoal is left."""
        flag = torch.zeros((*batch_size, 1), dtype=torch.bool, device=device)
        return {
            **{key: flag.clone() for key in self._reported},
            self.option_init_key: ~flag,
            self.active_subgoal_key: torch.zeros(batch_size, dtype=torch.int64, device=device),
            self.subgoal_mask_key: (~flag).repeat_interleave(self.num_subgoals, -1),
            self.option_steps_key: torch.zeros((*batch_size, 1), dtype=torch.int64, device=device),
            self.option_return_key: torch.zeros((*batch_size, 1), device=device),
        }

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._reset(tensordict, tensordict_reset)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise RuntimeError(
            "SubgoalTransform keeps a book along an episode and can't be applied to stored data; "
            "append it to an environment."
        )

    def _option_specs(self, batch_size: torch.Size, device: torch.device | None) -> dict[NestedKey, TensorSpec]:
        one, per_subgoal = (*batch_size, 1), (*batch_size, self.num_subgoals)
        flags = [self.option_init_key, *self._reported]
        return {
            **{key: Binary(shape=one, dtype=torch.bool, device=device) for key in flags},
            self.active_subgoal_key: Categorical(self.num_subgoals, shape=batch_size, dtype=torch.int64, device=device),
            self.subgoal_mask_key: Binary(shape=per_subgoal, dtype=torch.bool, device=device),
            self.option_steps_key: Unbounded(shape=one, dtype=torch.int64, device=device),
            self.option_return_key: Unbounded(shape=one, dtype=torch.float32, device=device),
        }

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        self._check(output_spec)
        return super().transform_output_spec(output_spec)

    def _check(self, output_spec: Composite) -> None:
        """Refuses an environment that does not write what the book reads."""
        parts = (output_spec.get(f"full_{name}_spec", None) for name in ("observation", "reward", "done"))
        entries = Entries(output_spec.shape, *parts)
        if self.critic is None:
            entries.require_flags(self.attained_key, self.num_subgoals)
        for key in (self.hazard_key, self.upper_done_key, self.upper_terminated_key):
            if key is not None:
                entries.require_flags(key)
        if self.available_key is not None:
            entries.require_flags(self.available_key, self.num_subgoals)
        entries.require_number(self.extrinsic_reward_key)
        for key in (self.done_key, self.terminated_key):
            entries.require_flags(key)
        entries.check("SubgoalTransform")

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        if self.critic is not None:
            observation_spec = self.critic.transform_observation_spec(observation_spec)
        for key, spec in self._option_specs(observation_spec.shape, observation_spec.device).items():
            set_spec(observation_spec, key, spec)
        return observation_spec

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        intrinsic = Unbounded(shape=(*reward_spec.shape, 1), dtype=torch.float32, device=reward_spec.device)
        set_spec(reward_spec, self.intrinsic_reward_key, intrinsic)
        return reward_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        if input_spec["full_state_spec"] is None:
            input_spec["full_state_spec"] = Composite(shape=input_spec.shape, device=input_spec.device)
        specs = self._option_specs(input_spec.shape, input_spec.device)
        for key in self._carried:
            set_spec(input_spec["full_state_spec"], key, specs[key])
        set_spec(input_spec["full_action_spec"], self.subgoal_key, specs[self.active_subgoal_key].clone())
        return input_spec


def advance_option(
    init: Tensor, steps: Tensor, collected: Tensor, reward: Tensor, gamma: float
) -> tuple[Tensor, Tensor]:
    """The book of an option after one more step: rule 4 of :class:`SubgoalTransform`.

    Args:
        init: whether the step is the option's first, ``[*, 1]`` bool; the book is then void.
        steps, collected: how long the option has lasted and what it has collected, ``[*, 1]``.
        reward: extrinsic reward of the step, ``[*, 1]``.
        gamma: discount inside an option.

    Returns:
        ``steps`` and ``collected`` after the step.

    Examples:
        >>> steps, collected = torch.tensor([[2], [7]]), torch.tensor([[1.0], [9.0]])
        >>> first = torch.tensor([[False], [True]])
        >>> steps, collected = advance_option(first, steps, collected, torch.ones(2, 1), gamma=0.5)
        >>> steps.tolist(), collected.tolist()
        ([[3], [1]], [[1.25], [1.0]])
    """
    steps = steps.masked_fill(init, 0)
    return steps + 1, collected.masked_fill(init, 0.0) + gamma**steps * reward
