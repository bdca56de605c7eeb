"""What one level of hDRQNv3 learns from each step of a sequence: the rule of its loss, level by level.

Shapes: ``B`` sequences of ``T`` steps and one more, which only serves to evaluate the step before; ``C`` subgoals that
the level can be given, ``X`` choices that it has. At level 0 only the action taken has a column.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from hdrqn_torchrl.keys import OptionKeys
from hdrqn_torchrl.objectives.targets import double_q_value, greedy_choice, watkins_trace
from hdrqn_torchrl.transforms import IntrinsicReward, penalties_of_sets


@dataclass(frozen=True, kw_only=True)
class LevelRule:
    """What a level chooses among, what it pursues, and how it is rewarded.

    Args:
        name: name of the level's figures in the report of the loss.
        gamma: discount of one environment step.
        choices: entries of the subgoals that it chooses among; ``None``: actions.
        pursues: entries of the subgoals that it is given; ``None``: the task.
        mask_key: which of its choices there are; ``None``: all.
        rewards: the critic's rewards for reaching them; ``None`` at the top.
        largest_return, smallest_return: bounds of its targets.
    """

    name: str
    gamma: float
    choices: OptionKeys | None
    pursues: OptionKeys | None
    mask_key: NestedKey | None
    rewards: IntrinsicReward | None = None
    largest_return: float = math.inf
    smallest_return: float = -math.inf


@dataclass(frozen=True, kw_only=True)
class StepEvents:
    """The outcome of each step ``[B, T]``, except for subgoals.

    Args:
        terminated: bool; the episode terminated.
        unseen: bool; what follows is not in the sequence, because of a time limit or the end of the sequence.
        reward: reward of the task, ``[B, T, 1]``.
        hazard: ``[B, T, 1]`` bool; ``None``: not read.
    """

    terminated: Tensor
    unseen: Tensor
    reward: Tensor
    hazard: Tensor | None


@dataclass(frozen=True, kw_only=True)
class Columns:
    """The parts of a level's targets (:func:`~hdrqn_torchrl.objectives.targets.lambda_returns`), ``[B, T, C * X]``."""

    reward: Tensor
    ended: Tensor
    next_value: Tensor
    trace: Tensor
    discount: Tensor
    trained: Tensor
    """bool: entries that enter the loss."""


@dataclass(frozen=True, kw_only=True)
class LevelTargets:
    """Computes the parts of the targets of all levels from their Q-values.

    Args:
        rules: one for each level, from level 0 up.
        trace_decay: lambda.
        double: Double Q-learning.
        all_subgoals, intra_option: see :class:`~hdrqn_torchrl.objectives.AllSubgoalsLoss`.
    """

    rules: Sequence[LevelRule]
    trace_decay: float
    double: bool
    all_subgoals: bool
    intra_option: bool

    def columns(
        self,
        online: Sequence[Tensor],
        target: Sequence[Tensor],
        action: Tensor,
        tensordict: TensorDictBase,
        events: StepEvents,
    ) -> list[Columns]:
        """The columns of every level.

        Args:
            online, target: Q-values of each level by main and target network, ``[B, T + 1, C, X]``.
            action: the actions taken, ``[B, T + 1]`` int64.
            tensordict: the sequences ``[B, T + 1]``.
            events: the outcomes of their steps.
        """
        greedy = greedy_choice(online[0], _mask(self.rules[0], tensordict))
        agrees = greedy == action.unsqueeze(-1)  # [B, T + 1, C]: the greedy action for c was taken
        found = [self._of_actions(self.rules[0], online[0], target[0], agrees, tensordict, events)]
        for index, rule in enumerate(self.rules[1:], 1):
            if index > 1:  # whether the greedy choice for c of the level below agrees
                chosen = greedy_choice(online[index - 1], _mask(self.rules[index - 1], tensordict))
                agrees = agrees.gather(-1, chosen)
            found.append(self._of_subgoals(rule, online[index], target[index], agrees, tensordict, events))
        return found

    def _of_actions(
        self,
        rule: LevelRule,
        online: Tensor,
        target: Tensor,
        agrees: Tensor,
        tensordict: TensorDictBase,
        events: StepEvents,
    ) -> Columns:
        """Level 0: every step completes its action, so the best action follows."""
        best = double_q_value(online if self.double else target, target, _mask(rule, tensordict))[:, 1:]
        trace = watkins_trace(agrees, self.trace_decay)[:, :-1]
        trained = torch.ones_like(best, dtype=torch.bool)
        return self._finish(rule, best.unsqueeze(-1), trace.unsqueeze(-1), trained.unsqueeze(-1), tensordict, events)

    def _of_subgoals(
        self,
        rule: LevelRule,
        online: Tensor,
        target: Tensor,
        agrees: Tensor,
        tensordict: TensorDictBase,
        events: StepEvents,
    ) -> Columns:
        """Levels above the first: unless x was attained or lost, its option goes on; ``agrees``: ``[B, T + 1, X]``."""
        assert rule.choices is not None
        steps, names = tensordict[:, :-1], rule.choices
        best = double_q_value(online if self.double else target, target, _mask(rule, tensordict))[:, 1:].unsqueeze(-1)
        over = (steps["next", names.attained] | ~tensordict[names.subgoal_mask][:, 1:]).unsqueeze(-2)  # [B, T, 1, X]
        pursued = _pursued(names, steps)
        may_learn = agrees[:, :-1] | pursued
        if not self.all_subgoals:
            may_learn = may_learn & pursued
        if self.intra_option:
            following = torch.where(over, best, target[:, 1:])
            trace = watkins_trace(agrees, self.trace_decay)[:, :-1].unsqueeze(-2).masked_fill(over, 0.0)
        else:
            may_learn = may_learn & pursued & steps[names.option_init]
            active = steps["next", names.active_subgoal][..., None, None].expand(*best.shape[:-1], 1)
            goes_on = target[:, 1:].gather(-1, active)  # stands in where the sequence breaks off within an option
            following = torch.where(tensordict[names.option_init][:, 1:].unsqueeze(-1), best, goes_on)
            trace = self._option_trace(rule, online, tensordict).unsqueeze(-1)
        left = steps[names.subgoal_mask]
        left = left | ~left.any(-1, keepdim=True)  # where none is left, any is chosen, and what they are worth is read
        trained = (left & may_learn).unsqueeze(-2)
        shape = target[:, 1:].shape
        return self._finish(
            rule, following.expand(shape), trace.expand(shape), trained.expand(shape), tensordict, events
        )

    def _finish(
        self,
        rule: LevelRule,
        following: Tensor,
        trace: Tensor,
        trained: Tensor,
        tensordict: TensorDictBase,
        events: StepEvents,
    ) -> Columns:
        """Adds what depends only on the pursued subgoal: reward, end, and which subgoals learn; ``[B, T, C, X]``.

        To lose c, which can't be pursued any more then, ends its pursuit as attaining it does, but pays nothing. Steps
        that lose it must count: without them an action would be worth what it brings where it goes well.
        """
        steps = tensordict[:, :-1]
        reward, ended, unseen = events.reward, events.terminated.unsqueeze(-1), events.unseen.unsqueeze(-1)
        if rule.pursues is not None and rule.rewards is not None:
            attained = steps["next", rule.pursues.attained]  # [B, T, C]
            lost = ~tensordict[rule.pursues.subgoal_mask][:, 1:] & ~unseen
            reward, ended = rule.rewards.of_all(attained, events.hazard), ended | attained | lost
            trained = trained & steps[rule.pursues.subgoal_mask].unsqueeze(-1)
            if not self.all_subgoals:
                trained = trained & _pursued(rule.pursues, steps).unsqueeze(-1)
        unseen = unseen & ~ended
        trace = trace.masked_fill(events.unseen[..., None, None], 0.0)
        trace[:, :-1].masked_fill_(unseen[:, 1:].unsqueeze(-1), 0.0)  # the next step has no target
        shape = following.shape

        def spread(value: Tensor) -> Tensor:
            return value.unsqueeze(-1).expand(shape).flatten(-2)

        return Columns(
            reward=spread(reward),
            ended=spread(ended | unseen),
            next_value=following.flatten(-2),
            trace=trace.flatten(-2),
            discount=torch.full(shape, rule.gamma, device=following.device).flatten(-2),
            trained=(trained & ~unseen.unsqueeze(-1)).flatten(-2),
        )

    def _option_trace(self, rule: LevelRule, online: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Traces ``[B, T, C]`` along options: 1 inside an option; lambda across to the next option if that is the
        greedy choice, else 0."""
        assert rule.choices is not None
        names = rule.choices
        active = tensordict["next", names.active_subgoal].unsqueeze(-1)
        agrees = greedy_choice(online, _mask(rule, tensordict)) == active
        to_next = watkins_trace(agrees, self.trace_decay)[:, :-1]
        return torch.where(tensordict[names.option_init][:, 1:], to_next, 1.0)


def make_rules(
    subgoals: Sequence[OptionKeys],
    *,
    action_mask_key: NestedKey | None = None,
    sub_gamma: float,
    middle_gamma: float,
    meta_gamma: float,
    reached_reward: float,
    wrong_subgoal_reward: float | Sequence[float],
    hazard_reward: float,
    largest_return: float,
    smallest_return: float,
) -> tuple[LevelRule, ...]:
    """The rules of all levels of an agent, from level 0 up.

    Args:
        subgoals: entries of each set of subgoals, from near to far; empty: an agent of one level.
        action_mask_key: actions that there are; ``None``: all.
        sub_gamma, middle_gamma, meta_gamma: discounts of level 0, of the levels in between, and of the top level.
        reached_reward, hazard_reward: the critic's rewards.
        wrong_subgoal_reward: the critic's penalties (:func:`~hdrqn_torchrl.transforms.penalties_of_sets`).
        largest_return, smallest_return: bounds of the task's return.

    Raises:
        ValueError: if the number of penalties does not fit the number of sets.
    """
    penalties = penalties_of_sets(wrong_subgoal_reward, len(subgoals))
    rules = []
    for index, (choices, pursues) in enumerate(zip([None, *subgoals], [*subgoals, None], strict=True)):
        gamma = sub_gamma if choices is None else meta_gamma if pursues is None else middle_gamma
        name = "sub" if choices is None else "meta" if pursues is None else choices.prefix
        rewards, smallest, largest = None, smallest_return, largest_return
        if pursues is not None:
            rewards = IntrinsicReward(reached=reached_reward, hazard=hazard_reward, wrong_subgoal=penalties[index])
            smallest, largest = -math.inf, rewards.largest_return
        rules.append(
            LevelRule(
                name=name,
                gamma=gamma,
                choices=choices,
                pursues=pursues,
                mask_key=action_mask_key if choices is None else choices.subgoal_mask,
                rewards=rewards,
                largest_return=largest,
                smallest_return=smallest,
            )
        )
    return tuple(rules)


def _pursued(names: OptionKeys, steps: TensorDictBase) -> Tensor:
    """Which subgoal of a set was in force at each step, ``[B, T, G]`` bool."""
    active, number = steps["next", names.active_subgoal], steps[names.subgoal_mask].shape[-1]
    return active.unsqueeze(-1) == torch.arange(number, device=active.device)


def _mask(rule: LevelRule, tensordict: TensorDictBase) -> Tensor | None:
    """What the level can choose, ``[B, T + 1, 1, X]`` bool; ``None``: everything."""
    return None if rule.mask_key is None else tensordict[rule.mask_key].unsqueeze(-2)
