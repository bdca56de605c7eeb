"""Scripted players of the grid tasks: what full information, perfect memory and chance achieve.

A player is a policy for :class:`~hdrqn_torchrl.envs.MultiGoalGridEnv`: it reads the tensordict and writes ``action``,
for all worlds at once. The planner and the memory player share one idea. Entering a cell costs one step, plus
:data:`_LOSS` for each unit of reward that it loses: an obstacle loses 1, a later goal loses all that the remaining
goals are worth in their proper order. Cheapest paths under that cost lose as little reward as possible, and among
those they are the shortest.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hdrqn_torchrl.envs.grid_rules import ACTIONS

_LOSS = 1000.0  # cost of a lost unit of reward, in steps: more than the longest path
_UNSEEN = 255  # code of a cell that the memory player has not seen yet
CURIOSITY = 1e-4
GAIN = 0.0
TIE = 0.5


def _cost_to_go(start: Tensor, entry: Tensor, moves: Tensor) -> Tensor:
    """Cheapest cost from every cell to the targets.

    Args:
        start: cost of ending on a cell, infinite where it is no target, ``[cells, N]``.
        entry: cost of entering a cell, ``[cells, N]``.
        moves: cell after each action, ``[cells, 4]``.

    Returns:
        ``[cells, N]``; infinite where no target can be reached.
    """
    cost = start
    while True:
        onward = entry + cost
        steps = [onward.index_select(0, moves[:, action]) for action in range(len(ACTIONS))]
        better = torch.minimum(cost, torch.stack(steps).amin(0))
        if torch.equal(better, cost):
            return cost
        cost = better


def _choose_actions(codes: Tensor, next_goal: Tensor, targets: Tensor, agent, moves, in_order: Tensor, detour: Tensor):
    num_goals = 0
