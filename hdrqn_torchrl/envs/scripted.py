"""Scripted players of the grid tasks: what full information, perfect memory and chance achieve.

A player is a policy for one :class:`~hdrqn_torchrl.envs.MultiGoalGridEnv`: it reads a tensordict and writes ``action``,
for all worlds at once. The planner and the memory player follow cheapest paths. Entering a cell costs one step, plus
:data:`_LOSS` steps for each unit of reward that it loses: an obstacle loses 1, a later goal all that the remaining
goals are worth in their order. So they lose as little reward as possible, and among such paths take the shortest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.cells import FIRST_GOAL, FLOOR, OBSTACLE, WALL
from hdrqn_torchrl.envs.grid_rules import ACTIONS, GridRules
from hdrqn_torchrl.envs.gridworld import MultiGoalGridEnv

_LOSS = 1000.0  # a lost unit of reward, in steps: more than any path is long
_HASTE = 2.0  # steps of detour that are worth e times as much to see

Player = Callable[[TensorDictBase], TensorDictBase]
PlayerName = Literal["planner", "memory", "random"]


class FullInformationPlanner:
    """Knows the whole state and walks the shortest way to the goals in their order.

    It avoids obstacles and later goals. Where an obstacle blocks every way it takes the -1, unless that costs more
    than the remaining goals bring; where later goals do, it gives up the order and collects what is left.

    Args:
        env: the environment it plays.

    Examples:
        >>> env = MultiGoalGridEnv(num_envs=8, seed=0)
        >>> rollout = env.rollout(50, FullInformationPlanner(env), break_when_any_done=False)
        >>> rollout["next", "hazard"].any().item()
        False
    """

    def __init__(self, env: MultiGoalGridEnv) -> None:
        self.env = env

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` ``[N]`` int64; reads nothing, the state is taken from the environment."""
        rules, state = self.env.rules, self.env.state
        collected = state.objects[:, rules.num_obstacles :] == rules.nowhere
        codes = rules.whole_map(state).flatten(1)
        return tensordict.set(keys.ACTION, _plan(rules, state.agent, codes, collected, state.in_order))


class PerfectMemorySearch:
    """Remembers every cell it has seen; walks to the next goal if it knows its place, else to where it sees most.

    What it may use: the windows seen in this episode, its own position, the map's walls, and which goals its steps
    reached. Objects that it has not seen do not influence it. To search, it weighs how much a cell would show against
    the way there; an unseen cell counts up to double when its neighbours are seen, so that no crumbs are left behind.

    Args:
        env: the environment it plays; a new episode is recognised by ``env.steps == 0``.

    Examples:
        >>> env = MultiGoalGridEnv(num_envs=8, view=3, seed=0)
        >>> rollout = env.rollout(50, PerfectMemorySearch(env), break_when_any_done=False)
        >>> rollout["next", "hazard"].any().item()
        False
    """

    def __init__(self, env: MultiGoalGridEnv) -> None:
        rules, worlds, device = env.rules, env.num_envs, env.device
        self.env, cells = env, rules.nowhere
        self._visible = torch.zeros((cells, cells + 1), device=device).scatter_(1, rules.window_cells, 1.0)[:, :-1]
        self._adjacent = torch.zeros((cells, cells), device=device).scatter_(1, rules.moves, 1 / len(ACTIONS))
        self._adjacent.fill_diagonal_(0.0)  # a move that a wall stops leads to no neighbour
        self._walls = torch.cat([rules.is_wall, rules.is_wall.new_ones(1)])  # windows show `nowhere` outside the map
        self._codes = torch.empty((worlds, cells + 1), dtype=torch.uint8, device=device)  # what is where, if known
        self._unseen = torch.empty((worlds, cells + 1), device=device)
        self._collected = torch.empty((worlds, rules.num_goals), dtype=torch.bool, device=device)
        self._in_order = torch.empty(worlds, dtype=torch.bool, device=device)
        self._forget(torch.ones_like(self._in_order))

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Reads ``observation`` and ``attained``; writes ``action`` ``[N]`` int64."""
        rules, agent = self.env.rules, self.env.state.agent
        self._forget(self.env.steps == 0)
        self._remember(agent, tensordict.get(keys.OBSERVATION), tensordict.get(keys.ATTAINED))
        codes, unseen = self._codes[:, :-1], self._unseen[:, :-1]
        weight = unseen * (2.0 - unseen @ self._adjacent.T)
        gain = weight @ self._visible.T  # [N, cells]
        search_cost = torch.where(rules.is_wall, torch.inf, -_HASTE * gain.log())
        actions = _plan(rules, agent, codes, self._collected, self._in_order, search_cost)
        return tensordict.set(keys.ACTION, actions)

    def _forget(self, worlds: Tensor) -> None:
        self._codes[worlds] = torch.where(self._walls, WALL, FLOOR).to(torch.uint8)
        self._unseen[worlds] = (~self._walls).float()
        self._collected[worlds], self._in_order[worlds] = False, True

    def _remember(self, agent: Tensor, observation: Tensor, attained: Tensor) -> None:
        window = self.env.rules.window_cells[agent]
        self._codes.scatter_(1, window, observation.flatten(1))
        self._unseen.scatter_(1, window, 0.0)
        self._collected |= attained
        prefix = self._collected.cumprod(-1).sum(-1)  # goals 0, 1, ... without a gap
        self._in_order &= prefix == self._collected.sum(-1)


class UniformRandom:
    """Chooses among the four actions with equal probability.

    Args:
        env: the environment it plays.
        seed: seed of its own random numbers.
    """

    def __init__(self, env: MultiGoalGridEnv, seed: int = 0) -> None:
        self.env, self._generator = env, torch.Generator(env.device).manual_seed(seed)

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` ``[N]`` int64; reads nothing."""
        shape, device = (self.env.num_envs,), self.env.device
        return tensordict.set(keys.ACTION, torch.randint(len(ACTIONS), shape, generator=self._generator, device=device))


def _plan(
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
    entry = (1.0 + _LOSS * loss).T.contiguous()  # [cells, N]: rows are copied whole, which is fast
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
        onward = torch.stack([through.index_select(0, cells) for cells in moves.unbind(-1)]).amin(0)
        improved = torch.minimum(start, onward)
        if torch.equal(improved, cost):
            return cost
        cost = improved


PLAYERS: dict[str, Callable[[MultiGoalGridEnv], Player]] = {
    "planner": FullInformationPlanner,
    "memory": PerfectMemorySearch,
    "random": UniformRandom,
}


def play_episodes(env: MultiGoalGridEnv, player: Player) -> dict[str, float]:
    """Plays one episode in every world of ``env``.

    Args:
        env: the environment; it is reset first.
        player: any policy that writes ``action``.

    Returns:
        ``return_mean``, ``success_rate`` (share of episodes with all goals reached in order), ``steps_mean`` and
        ``episodes``.
    """
    returns = torch.zeros(env.num_envs, dtype=torch.float64, device=env.device)
    steps, success = torch.zeros_like(returns), torch.zeros_like(returns)
    playing = torch.ones_like(returns)
    tensordict = env.reset()
    for _ in range(env.max_steps):
        tensordict = env.step(player(tensordict))
        reward, done, won = (tensordict["next", key].squeeze(-1) for key in (keys.REWARD, keys.DONE, keys.SUCCESS))
        returns += playing * reward
        steps += playing
        success += playing * won
        playing *= ~done
        if not playing.any():
            break
        tensordict = step_mdp(tensordict)
    return {
        "return_mean": returns.mean().item(),
        "success_rate": success.mean().item(),
        "steps_mean": steps.mean().item(),
        "episodes": env.num_envs,
    }


def scripted_ceiling(
    player: PlayerName = "planner",
    *,
    layout: str | Sequence[str] = "open",
    num_goals: int = 2,
    view: int | None = 5,
    max_steps: int = 50,
    obstacle: Literal["stay", "teleport"] = "stay",
    num_obstacles: int = 2,
    episodes: int = 1000,
    seed: int = 0,
) -> dict[str, float]:
    """What a scripted player achieves on a task, by simulation.

    Args:
        player: ``"planner"``, ``"memory"`` or ``"random"``.
        layout: as in :class:`~hdrqn_torchrl.envs.MultiGoalGridEnv`, like all up to ``num_obstacles``.
        num_goals: K.
        view: side of the window in cells; only the memory player looks through it.
        max_steps: step limit of an episode.
        obstacle: ``"stay"`` or ``"teleport"``.
        num_obstacles: number of obstacles.
        episodes: number of episodes, all played at once.
        seed: seed of the worlds.

    Returns:
        ``return_mean``, ``success_rate`` (share of episodes with all goals reached in order), ``steps_mean`` and
        ``episodes``.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> scripted_ceiling("planner", episodes=100)["success_rate"]
        1.0
    """
    if player not in PLAYERS:
        raise ValueError(f"player must be one of {sorted(PLAYERS)}, got {player!r}.")
    if episodes < 1:
        raise ValueError(f"episodes must be >= 1, got {episodes}; use 1000 for an error of about 1 %.")
    env = MultiGoalGridEnv(
        episodes,
        layout=layout,
        num_goals=num_goals,
        view=view,
        max_steps=max_steps,
        obstacle=obstacle,
        num_obstacles=num_obstacles,
        seed=seed,
    )
    return play_episodes(env, PLAYERS[player](env))
