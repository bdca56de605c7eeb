"""Cheapest paths of the scripted players.

Entering a cell costs one step, plus :data:`_LOSS` steps for each unit of reward that it loses: an obstacle loses 1, a
later goal all that the remaining goals are worth in their order. So a cheapest path loses as little reward as possible,
and among such paths it is the shortest.
"""

from __future__ import annotations

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
    entry = entry.T.contiguous()  # [cells, N]: rows are copied whole, which is fast
    cost = _cost_to_go(start.T.contiguous(), entry, rules.moves)
    world = torch.arange(len(agent), device=agent.device)
    choices, column = rules.moves[agent], world[:, None]  # [N, 4]
    pays = cost[agent, world] < _LOSS * (worth + 1)
    onward = torch.where(pays[:, None], cost[choices, column], 0.0)
    return (entry[choices, column] + onward).argmin(-1)


def _cost_to_go(start: Tensor, entry: Tensor, moves: Tensor) -> Tensor:
    """Cost of the cheapest path from every cell to a target, by value iteration in all worlds at once.

    Args:
        start: cost of ending on a cell, infinite where it is no target, ``[cells, N]``.
        entry: cost of entering a cell, ``[cells, N]``.
        moves: cell after each action, ``[cells, 4]`` int64.

    Returns:
        ``[cells, N]``; infinite where no target can be reached.
    """
    cost = start
    while True:
        through = entry + cost
        improved = start
        for cells in moves.unbind(-1):
            improved = torch.minimum(improved, through.index_select(0, cells))
        if torch.equal(improved, cost):
            return cost
        cost = improved
