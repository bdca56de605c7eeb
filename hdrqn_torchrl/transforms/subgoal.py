"""The option book of a hierarchical agent, kept inside the environment (lines 14-26 of Algorithm 1).

Which subgoal is active, whether it was reached (the critic), the intrinsic reward, and what the option
has collected. All state lies in the tensordict, so partial resets, collectors and worker processes carry
it like any other entry.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from hdrqn_torchrl import keys
from hdrqn_torchrl.transforms.entries import Entries


class SubgoalTransform(Transform):
    r"""Turns a flat task into one of subgoals and options.

    At every step, with :math:`g` the active subgoal and :math:`k` the steps the option has lasted:

    1. :math:`g \leftarrow` the policy's ``subgoal`` where ``option_init`` was set, else it is kept;
    2. the critic: ``subgoal_reached`` :math:`=` ``attained``:math:`[g]`;
    3. :math:`r^{in} =` ``reached_reward`` if reached, plus ``hazard_reward`` if the hazard was met, plus
       ``wrong_subgoal_reward`` if another subgoal was attained;
    4. ``option_return`` :math:`\mathrel{+}= \gamma^{k} r^{ex}`, ``option_steps`` :math:`= k + 1`;
    5. ``option_done`` = reached, or the episode is done, or ``max_option_steps`` are over, or :math:`g` can no
       longer be chosen; ``option_terminated`` = reached or the episode terminated.

    The policy's ``subgoal`` becomes an additional action. Put every transform that can end an episode
    (``StepCounter(max_steps)``) *before* this one, so that each end of an episode closes its option.

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
            ``subgoal_mask``, and ``repeatable`` is not asked. ``None``: the environment says nothing about it.
        critic: computes ``attained`` ``[*batch, G]`` from the tensordict that follows a step. ``None`` reads
            ``attained_key``, which the environment then has to write.
        attained_key, hazard_key, extrinsic_reward_key: entries of the environment; ``hazard_key=None``: no hazard.
        done_key, terminated_key: end of the episode.
        subgoal_key: the policy's proposal.
        option_init_key, active_subgoal_key, subgoal_mask_key, option_steps_key, option_return_key,
            subgoal_reached_key, option_done_key, option_terminated_key, intrinsic_reward_key: entries written.

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
        critic: Callable[[TensorDictBase], Tensor] | None = None,
        attained_key: NestedKey = keys.ATTAINED,
        hazard_key: NestedKey | None = keys.HAZARD,
        extrinsic_reward_key: NestedKey = keys.EXTRINSIC_REWARD,
        done_key: NestedKey = keys.DONE,
        terminated_key: NestedKey = keys.TERMINATED,
        subgoal_key: NestedKey = keys.SUBGOAL,
        option_init_key: NestedKey = keys.OPTION_INIT,
        active_subgoal_key: NestedKey = keys.ACTIVE_SUBGOAL,
        subgoal_mask_key: NestedKey = keys.SUBGOAL_MASK,
        option_steps_key: NestedKey = keys.OPTION_STEPS,
        option_return_key: NestedKey = keys.OPTION_RETURN,
        subgoal_reached_key: NestedKey = keys.SUBGOAL_REACHED,
        option_done_key: NestedKey = keys.OPTION_DONE,
        option_terminated_key: NestedKey = keys.OPTION_TERMINATED,
        intrinsic_reward_key: NestedKey = keys.INTRINSIC_REWARD,
    ) -> None:
        if num_subgoals < 1:
            raise ValueError(f"num_subgoals must be >= 1, got {num_subgoals}; give one for each subgoal of the task.")
        if not 0.0 <= gamma <= 1.0:
            raise ValueError(f"gamma must lie in [0, 1], got {gamma}; use 0.99, or 1.0 for an undiscounted sum.")
        if max_option_steps is not None and max_option_steps < 1:
            raise ValueError(f"max_option_steps must be >= 1 or None, got {max_option_steps}; use None for no limit.")
        # What is carried from step to step, and what each step reports.
        self._carried = [option_init_key, active_subgoal_key, subgoal_mask_key, option_steps_key, option_return_key]
        self._reported = [subgoal_reached_key, option_done_key, option_terminated_key]
        in_keys = [attained_key] if critic is None else []
        in_keys += [extrinsic_reward_key, *(key for key in (hazard_key, available_key) if key is not None)]
        super().__init__(in_keys=in_keys, out_keys=[*self._carried, *self._reported, intrinsic_reward_key])
        self.num_subgoals, self.gamma, self.max_option_steps = num_subgoals, gamma, max_option_steps
        self.reached_reward, self.hazard_reward = reached_reward, hazard_reward
        self.wrong_subgoal_reward, self.repeatable, self.critic = wrong_subgoal_reward, repeatable, critic
        self.available_key = available_key
        self.attained_key, self.hazard_key, self.extrinsic_reward_key = attained_key, hazard_key, extrinsic_reward_key
        self.done_key, self.terminated_key, self.subgoal_key = done_key, terminated_key, subgoal_key
        self.option_init_key, self.active_subgoal_key = option_init_key, active_subgoal_key
        self.subgoal_mask_key = subgoal_mask_key
        self.option_steps_key, self.option_return_key = option_steps_key, option_return_key
        self.subgoal_reached_key, self.option_done_key = subgoal_reached_key, option_done_key
        self.option_terminated_key, self.intrinsic_reward_key = option_terminated_key, intrinsic_reward_key

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        init = tensordict.get(self.option_init_key)  # [*batch, 1]
        mask = tensordict.get(self.subgoal_mask_key)  # [*batch, G]
        subgoal = torch.where(
            init.squeeze(-1), tensordict.get(self.subgoal_key), tensordict.get(self.active_subgoal_key)
        )
        chosen = subgoal.unsqueeze(-1)
        book = tensordict.get(self.option_steps_key), tensordict.get(self.option_return_key)
        steps, collected = advance_option(init, *book, next_tensordict.get(self.extrinsic_reward_key), self.gamma)

        attained = next_tensordict.get(self.attained_key) if self.critic is None else self.critic(next_tensordict)
        reached = attained.gather(-1, chosen)
        done = reached | next_tensordict.get(self.done_key)
        if self.max_option_steps is not None:
            done = done | (steps >= self.max_option_steps)
        if self.available_key is not None or not self.repeatable:
            done = done | ~mask.gather(-1, chosen)
            mask = mask & ~attained if self.available_key is None else next_tensordict.get(self.available_key).clone()

        for key, value in (
            (self.option_init_key, done),
            (self.active_subgoal_key, subgoal),
            (self.subgoal_mask_key, mask),
            (self.option_steps_key, steps),
            (self.option_return_key, collected),
            (self.subgoal_reached_key, reached),
            (self.option_done_key, done.clone()),
            (self.option_terminated_key, reached | next_tensordict.get(self.terminated_key)),
            (self.intrinsic_reward_key, self._intrinsic_reward(attained, reached, next_tensordict)),
        ):
            next_tensordict.set(key, value)
        return next_tensordict

    def _intrinsic_reward(self, attained: Tensor, reached: Tensor, next_tensordict: TensorDictBase) -> Tensor:
        reads_hazard = self.hazard_key is not None and self.hazard_reward
        return intrinsic_reward(
            attained,
            reached,
            next_tensordict.get(self.hazard_key) if reads_hazard else None,
            reached_reward=self.reached_reward,
            hazard_reward=self.hazard_reward,
            wrong_subgoal_reward=self.wrong_subgoal_reward,
        )

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        reset = tensordict.get("_reset", None)
        book = self._fresh_book(tensordict_reset.batch_size, tensordict_reset.device)
        if self.available_key is not None:
            book[self.subgoal_mask_key] = tensordict_reset.get(self.available_key).clone()
        for key, fresh in book.items():
            if reset is not None and (kept := tensordict.get(key, None)) is not None:
                fresh = torch.where(expand_as_right(reset.view(tensordict.batch_size), kept), fresh, kept)
            tensordict_reset.set(key, fresh)
        return tensordict_reset

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
        if self.hazard_key is not None and self.hazard_reward:
            entries.require_flags(self.hazard_key)
        if self.available_key is not None:
            entries.require_flags(self.available_key, self.num_subgoals)
        entries.require_number(self.extrinsic_reward_key)
        for key in (self.done_key, self.terminated_key):
            entries.require_flags(key)
        entries.check("SubgoalTransform")

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        for key, spec in self._option_specs(observation_spec.shape, observation_spec.device).items():
            _set_spec(observation_spec, key, spec)
        return observation_spec

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        intrinsic = Unbounded(shape=(*reward_spec.shape, 1), dtype=torch.float32, device=reward_spec.device)
        _set_spec(reward_spec, self.intrinsic_reward_key, intrinsic)
        return reward_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        if input_spec["full_state_spec"] is None:
            input_spec["full_state_spec"] = Composite(shape=input_spec.shape, device=input_spec.device)
        specs = self._option_specs(input_spec.shape, input_spec.device)
        for key in self._carried:
            _set_spec(input_spec["full_state_spec"], key, specs[key])
        _set_spec(input_spec["full_action_spec"], self.subgoal_key, specs[self.active_subgoal_key].clone())
        return input_spec


def advance_option(
    init: Tensor, steps: Tensor, collected: Tensor, reward: Tensor, gamma: float
) -> tuple[Tensor, Tensor]:
    """The book of an option after one more step: rule 4 of :class:`SubgoalTransform`.

    Args:
        init: whether the step is the option's first, ``[*, 1]`` bool; then what stood in the book is void.
        steps, collected: how long the option has lasted and what it has collected, ``[*, 1]``.
        reward: extrinsic reward of the step, ``[*, 1]``.
        gamma: discount inside an option.

    Returns:
        ``steps`` and ``collected`` after the step.
    """
    steps = steps.masked_fill(init, 0)
    return steps + 1, collected.masked_fill(init, 0.0) + gamma**steps * reward


def intrinsic_reward(
    attained: Tensor,
    reached: Tensor,
    hazard: Tensor | None,
    *,
    reached_reward: float = 1.0,
    hazard_reward: float = -1.0,
    wrong_subgoal_reward: float = 0.0,
) -> Tensor:
    """The critic's reward of a step, for any subgoal: rule 3 of :class:`SubgoalTransform`.

    Args:
        attained: subgoals that the step attained, ``[*, G]`` bool.
        reached: whether the one in question is among them, ``[*, 1]`` bool.
        hazard: whether the step met the hazard, ``[*, 1]`` bool; ``None``: there is none.
        reached_reward, hazard_reward, wrong_subgoal_reward: as in :class:`SubgoalTransform`.

    Returns:
        ``[*, 1]``.

    Examples:
        >>> attained, reached = torch.tensor([[False, True]] * 2), torch.tensor([[True], [False]])
        >>> intrinsic_reward(attained, reached, None, wrong_subgoal_reward=-0.5)
        tensor([[ 1.0000],
                [-0.5000]])
    """
    reward = reached_reward * reached.float()
    if hazard is not None and hazard_reward:
        reward = reward + hazard_reward * hazard.float()
    if wrong_subgoal_reward:
        others = attained.sum(-1, keepdim=True) > reached.long()
        reward = reward + wrong_subgoal_reward * others.float()
    return reward


def largest_intrinsic_return(
    *, reached_reward: float = 1.0, hazard_reward: float = -1.0, wrong_subgoal_reward: float = 0.0
) -> float:
    """Largest sum of intrinsic rewards that an option can bring: reaching the subgoal pays once, and ends it.

    Where something else pays as well, there is no bound.

    Args:
        reached_reward, hazard_reward, wrong_subgoal_reward: as in :class:`SubgoalTransform`.

    Examples:
        >>> largest_intrinsic_return(), largest_intrinsic_return(wrong_subgoal_reward=0.5)
        (1.0, inf)
    """
    return math.inf if max(hazard_reward, wrong_subgoal_reward) > 0.0 else max(reached_reward, 0.0)


def _set_spec(composite: Composite, key: NestedKey, spec: TensorSpec) -> None:
    """Sets a nested spec, making the composites on its way."""
    if isinstance(key, tuple) and len(key) > 1:
        if composite.get(key[0], None) is None:
            composite[key[0]] = Composite(shape=composite.shape, device=composite.device)
        _set_spec(composite[key[0]], key[1:], spec)
    else:
        composite[key[0] if isinstance(key, tuple) else key] = spec
