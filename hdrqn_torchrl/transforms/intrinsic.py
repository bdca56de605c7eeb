"""The reward that the critic pays for a step: the only place with that rule."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class IntrinsicReward:
    """The intrinsic reward of a step, for the subgoal that is pursued or for all of them.

    The option book pays by it (:class:`~hdrqn_torchrl.transforms.SubgoalTransform`), hindsight relabels steps by
    it (:func:`~hdrqn_torchrl.data.relabel_subgoals`), and losses that teach all subgoals from every step use it.

    Args:
        reached: for attaining the subgoal in question.
        hazard: for meeting the hazard.
        wrong_subgoal: for attaining another subgoal.

    Examples:
        >>> import torch
        >>> attained = torch.tensor([[False, True, False], [True, True, False]])
        >>> IntrinsicReward(wrong_subgoal=-0.5).of_all(attained)
        tensor([[-0.5000,  1.0000, -0.5000],
                [ 0.5000,  0.5000, -0.5000]])
        >>> IntrinsicReward(wrong_subgoal=-0.5).of(attained, torch.tensor([[True], [False]]))
        tensor([[ 1.0000],
                [-0.5000]])
    """

    reached: float = 1.0
    hazard: float = -1.0
    wrong_subgoal: float = 0.0

    def of(self, attained: Tensor, reached: Tensor, hazard: Tensor | None = None) -> Tensor:
        """For one subgoal.

        Args:
            attained: subgoals that the step attained, ``[*, G]`` bool.
            reached: whether the one in question is among them, ``[*, 1]`` bool.
            hazard: whether the step met the hazard, ``[*, 1]`` bool; ``None``: there is none.

        Returns:
            ``[*, 1]``.
        """
        reward = self.reached * reached.float()
        if hazard is not None and self.hazard:
            reward = reward + self.hazard * hazard.float()
        if self.wrong_subgoal:
            others = attained.sum(-1, keepdim=True) > reached.long()
            reward = reward + self.wrong_subgoal * others.float()
        return reward

    def of_all(self, attained: Tensor, hazard: Tensor | None = None) -> Tensor:
        """For each subgoal as if it were the one in question; arguments as in :meth:`of`.

        Returns:
            ``[*, G]``.
        """
        return self.of(attained, attained, hazard)

    @property
    def largest_return(self) -> float:
        """Largest sum that an option can bring: reaching the subgoal pays once, and ends it.

        Where something else pays as well, there is no bound.

        Examples:
            >>> IntrinsicReward().largest_return, IntrinsicReward(wrong_subgoal=0.5).largest_return
            (1.0, inf)
        """
        return math.inf if max(self.hazard, self.wrong_subgoal) > 0.0 else max(self.reached, 0.0)


def penalties_of_sets(wrong_subgoal_reward: float | Sequence[float], number: int) -> list[float]:
    """What attaining another subgoal of the same set pays, for each set from near to far.

    Args:
        wrong_subgoal_reward: one number is for the farthest set, as nearer subgoals are passed on the way to others;
            or a list of one number for each set.
        number: of sets.

    Raises:
        ValueError: if the list has another length than ``number``.

    Examples:
        >>> penalties_of_sets(-0.5, 2)
        [0.0, -0.5]
    """
    if not isinstance(wrong_subgoal_reward, Sequence):
        return [0.0] * (number - 1) + [wrong_subgoal_reward] * min(number, 1)
    if len(wrong_subgoal_reward) != number:
        raise ValueError(
            f"wrong_subgoal_reward must be one number, or one for each of {number} sets of subgoals from near to far, "
            f"got {list(wrong_subgoal_reward)}; one number is for the farthest set."
        )
    return list(wrong_subgoal_reward)
