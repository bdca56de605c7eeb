"""Cheapest paths of the scripted players.

Entering a cell costs one step, plus :data:`_LOSS` steps for each unit of reward that it loses: an obstacle loses 1, a
later goal all that the remaining goals are worth in their order. So a cheapest path loses as little reward as possible,
and among such paths it is the shortest. Players look ahead to the next goal only: where every way to it costs less than
all remaining goals bring, they go. On maps on which several goals can be reached only over obstacles that may lose more
than it brings in the end; on the paper's maps no leg crosses more than one.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from hdrqn_torchrl.envs.grid.cells import FIRST_GOAL, OBSTACLE, WALL
from hdrqn_torchrl.envs.grid.rules import GridRules

_LOSS = 1000.0  # a lost unit of reward, in steps: more than any path is long


def plan(
    rules: GridRules,
    agent: Tensor,
    codes: Tensor,
    collected: Tensor,
    in_order: Tensor,
    search_cost: Tensor | None = None,
) -> Tensor:
    """First action of the cheapest way to the next goal.

    Args:
        rules: the rules of the grid.
        agent: ``[N]`` int64.
        codes: what stands where, as far as the player knows, ``[N, cells]`` uint8.
        collected: goals already collected, ``[N, K]`` bool.
        in_order: whether the order has been kept, ``[N]`` bool; once it is broken, any goal is as good as any other.
        search_cost: cost of ending on a cell to look around, ``[N, cells]``; counts where the next goal is unknown.

    Returns:
        ``[N]`` int64.
    """
    num_collected = collected.sum(-1)
    is_goal = codes >= FIRST_GOAL
    is_target = is_goal & ((codes == FIRST_GOAL + num_collected[:, None]) | ~in_order[:, None])
    worth = torch.where(in_order, rules.num_goals - num_collected, 0)
    loss = (codes == OBSTACLE) + (worth[:, None] + 0.5) * (is_goal & ~is_target)
    start = torch.where(is_target, 0.0, torch.inf)
    if search_cost is not None:
        start = torch.where(is_target.any(-1, keepdim=True), start, search_cost)
    entry = torch.where(codes == WALL, torch.inf, 1.0 + _LOSS * loss)
    shape = rules.height, rules.width, len(agent)  # worlds last: lines of a map are then whole blocks of memory
    entry, start = (each.T.contiguous().view(shape) for each in (entry, start))
    cost, entry = _cost_to_go(start, entry).flatten(0, 1), entry.flatten(0, 1)
    world = torch.arange(len(agent), device=agent.device)
    choices, column = rules.moves[agent], world[:, None]  # [N, 4]
    pays = cost[agent, world] < _LOSS * (worth + 1)
    onward = torch.where(pays[:, None], cost[choices, column], 0.0)
    return (entry[choices, column] + onward).argmin(-1)


def _cost_to_go(start: Tensor, entry: Tensor) -> Tensor:
    """Cost of the cheapest path from every cell to a target, in all worlds at once.

    Value iteration that goes over the map line by line, in each of the four directions in turn: a cost travels a whole
    corridor at a time, so that there are about as many rounds as a path has turns.

    Args:
        start: cost of ending on a cell, infinite where it is not a target, ``[height, width, N]``.
        entry: cost of entering a cell, infinite for walls, of the same shape.

    Returns:
        The same shape; infinite where no target can be reached.
    """
    cost = start.clone()
    while True:
        before = cost.clone()
        for axis in (0, 1):
            lines = list(zip(cost.unbind(axis), entry.unbind(axis), strict=True))
            for way in (lines, lines[::-1]):
                for (behind, toll), (line, _) in pairwise(way):
                    torch.minimum(line, behind + toll, out=line)
        if torch.equal(before, cost):
            return cost
