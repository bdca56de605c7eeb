"""Scripted players that look through the window and remember all they saw.

They walk to the next goal if they have seen it, else to where they expect to see most. One knows where it is.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.grid.cells import FLOOR, WALL
from hdrqn_torchrl.envs.grid.environment import MultiGoalGridEnv
from hdrqn_torchrl.envs.grid.planning import plan
from hdrqn_torchrl.envs.grid.rules import ACTIONS, GridRules

_HASTE = 2.0  # steps of detour that are worth e times as much to see
_HASTE_IN_DOUBT = 1.5  # the same where it is not known how much there is to see


class PerfectMemorySearch:
    """Remembers every cell it has seen; walks to the next goal if it knows its place, else to where it sees most.

    What it may use: the windows seen in this episode, its own position, the map's walls, and which goals its steps
    reached. Objects that it has not seen do not influence it. To search, it weighs how much a cell would show against
    the way there; an unseen cell counts up to double when its neighbours are seen, so that no single cells stay unseen.

    Args:
        env: the environment it plays; a new episode is recognised by ``env.steps == 0``.

    Examples:
        >>> env = MultiGoalGridEnv(num_envs=8, view=3, seed=0)
        >>> rollout = env.rollout(50, PerfectMemorySearch(env), break_when_any_done=False)
        >>> rollout["next", "hazard"].any().item()
        False
    """

    def __init__(self, env: MultiGoalGridEnv) -> None:
        self.env, self._memory = env, _Memory(env.rules, env.num_envs, env.rules.is_wall)

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Reads ``observation`` and ``attained``; writes ``action`` ``[N]`` int64."""
        rules, agent, memory = self.env.rules, self.env.state.agent, self._memory
        memory.forget(self.env.steps == 0)
        memory.remember(agent, tensordict)
        gain = memory.shown(memory.unseen * (2.0 - memory.beside(memory.unseen)))
        search_cost = torch.where(rules.is_wall, torch.inf, -_HASTE * gain.log())
        action = plan(rules, agent, memory.codes, memory.collected, memory.in_order, search_cost)
        return tensordict.set(keys.ACTION, action)


class EgocentricSearch:
    """Like :class:`PerfectMemorySearch`, but without knowing where it starts: it knows what a learning agent can know.

    What it may use: the windows seen in this episode, its own actions, whether they moved it (windows of 3 cells and
    more show that, too), the map's walls, and which goals its steps reached. It draws a map around its start, and keeps
    all start cells that fit what it saw of walls and floor. They are equally likely: objects stand anywhere, so what it
    saw of them favours none. To search, it weighs how much it *expects* to see. A cell counts more where its unseen
    neighbours may be walls, because it shows on which side there is more room.

    Measured in the open map, the first sight of a goal takes as long as with one step of policy improvement by
    rollouts (6.47 and 6.46 steps, 5x5 view, no obstacles); the shortest search for those who know their place, 5.53.

    Args:
        env: the environment it plays; a new episode is recognised by ``env.steps == 0``.

    Examples:
        >>> env = MultiGoalGridEnv(num_envs=8, view=3, seed=0)
        >>> rollout = env.rollout(50, EgocentricSearch(env), break_when_any_done=False)
        >>> rollout["next", "hazard"].any().item()
        False
    """

    def __init__(self, env: MultiGoalGridEnv) -> None:
        rules = env.rules
        rows, columns = rules.free_cells // rules.width, rules.free_cells % rules.width
        far = [int(axis.max() - axis.min()) for axis in (rows, columns)]  # no walk leads further away
        height, width = 2 * far[0] + 1, 2 * far[1] + 1
        walls = pad(rules.is_wall.view(rules.height, rules.width), (far[1], far[1], far[0], far[0]), value=True)
        around = walls.unfold(0, height, 1).unfold(1, width, 1)[rows, columns]
        self._floor = (~around).flatten(1).float()  # [starts, cells]: the map as each start cell has it around itself
        self._rules = GridRules(
            (" " * width,) * height, num_goals=rules.num_goals, view=rules.view, num_obstacles=0, device=env.device
        )
        self._memory = _Memory(self._rules, env.num_envs, torch.zeros_like(around[0].flatten()))
        self._start = self._rules.nowhere // 2  # the centre
        self._place = torch.full((env.num_envs,), self._start, device=env.device)
        self._last: tuple[Tensor, Tensor] | None = None  # what it did, and from where; only to compare with where it is
        self.env = env

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Reads ``observation`` and ``attained``; writes ``action`` ``[N]`` int64."""
        rules, memory, begins = self._rules, self._memory, self.env.steps == 0
        self._follow_last_step()
        self._place = torch.where(begins, self._start, self._place)
        memory.forget(begins)
        memory.remember(self._place, tensordict)
        floor = self._chance_of_floor()
        possible, expected = memory.unseen * (floor > 0), memory.unseen * floor
        weight = expected * (2.0 - memory.beside(possible) + 2.0 * memory.beside(possible - expected))
        search_cost = torch.where(floor > 0, -_HASTE_IN_DOUBT * memory.shown(weight).log(), torch.inf)
        codes = torch.where(floor > 0, memory.codes, WALL)
        action = plan(rules, self._place, codes, memory.collected, memory.in_order, search_cost)
        self._last = action, self.env.state.agent
        return tensordict.set(keys.ACTION, action)

    def _follow_last_step(self) -> None:
        if self._last is None:
            return
        action, agent = self._last
        ahead, stopped = self._rules.moves[self._place, action], self.env.state.agent == agent
        self._memory.fill(ahead[:, None], torch.where(stopped, WALL, FLOOR)[:, None])
        self._place = torch.where(stopped, self._place, ahead)

    def _chance_of_floor(self) -> Tensor:
        """How likely each cell is free, given all that was seen: ``[N, cells]``."""
        memory = self._memory
        seen = torch.where(memory.codes == WALL, -1.0, 1.0) * (1.0 - memory.unseen)
        fits = (seen @ (2.0 * self._floor - 1.0).T == seen.abs().sum(-1, keepdim=True)).float()  # [N, starts]
        return fits @ self._floor / fits.sum(-1, keepdim=True)


class _Memory:
    """A map for each world that windows fill in, and what was collected.

    Args:
        rules: rules of the map.
        worlds: N.
        walls: what is known to be wall from the start, ``[cells]`` bool.
    """

    def __init__(self, rules: GridRules, worlds: int, walls: Tensor) -> None:
        cells, device = rules.nowhere, walls.device
        self._window_cells = rules.window_cells
        self._shape, self._view = (rules.height, rules.width), rules.view
        self._walls = torch.cat([walls, walls.new_ones(1)])  # windows show `nowhere` outside the map
        self._codes = torch.empty((worlds, cells + 1), dtype=torch.uint8, device=device)
        self._unseen = torch.empty((worlds, cells + 1), device=device)
        self.collected = torch.empty((worlds, rules.num_goals), dtype=torch.bool, device=device)
        self.in_order = torch.empty(worlds, dtype=torch.bool, device=device)
        self.forget(torch.ones_like(self.in_order))

    @property
    def codes(self) -> Tensor:
        """What is where, as far as known; floor elsewhere, ``[N, cells]`` uint8."""
        return self._codes[:, :-1]

    @property
    def unseen(self) -> Tensor:
        """1 where nothing is known, else 0, ``[N, cells]``."""
        return self._unseen[:, :-1]

    def forget(self, worlds: Tensor) -> None:
        """Starts again in ``worlds`` ``[N]`` bool."""
        self._codes[worlds] = torch.where(self._walls, WALL, FLOOR).to(torch.uint8)
        self._unseen[worlds] = (~self._walls).float()
        self.collected[worlds], self.in_order[worlds] = False, True

    def remember(self, agent: Tensor, tensordict: TensorDictBase) -> None:
        """Takes in ``observation`` and ``attained`` of agents that stand on the cells ``agent`` ``[N]``."""
        self.fill(self._window_cells[agent], tensordict.get(keys.OBSERVATION).flatten(1))
        self.collected |= tensordict.get(keys.ATTAINED)
        prefix = self.collected.cumprod(-1).sum(-1)  # goals 0, 1, ... without a gap
        self.in_order &= prefix == self.collected.sum(-1)

    def fill(self, cells: Tensor, codes: Tensor) -> None:
        """Writes what was seen: ``codes`` on ``cells``, both ``[N, n]``."""
        self._codes.scatter_(1, cells, codes.to(torch.uint8))
        self._unseen.scatter_(1, cells, 0.0)

    def shown(self, weight: Tensor) -> Tensor:
        """Sum of ``weight`` ``[N, cells]`` over the window around each cell."""
        return _in_window(_in_window(self._map(weight), self._view // 2), self._view // 2).flatten(1)

    def beside(self, weight: Tensor) -> Tensor:
        """A quarter of the sum of ``weight`` ``[N, cells]`` over the neighbours of each cell; walls must have none."""
        around = pad(self._map(weight), (1, 1, 1, 1))
        rows, columns = around[:, :, 1:-1], around[:, 1:-1]
        return ((columns[..., :-2] + columns[..., 2:] + rows[:, :-2] + rows[:, 2:]) / len(ACTIONS)).flatten(1)

    def _map(self, weight: Tensor) -> Tensor:
        return weight.unflatten(1, self._shape)


def _in_window(weight: Tensor, radius: int) -> Tensor:
    """Sum over each line from ``radius`` cells before to ``radius`` behind a cell; lines and columns change places."""
    length = weight.shape[-1]
    total = weight.clone()
    for far in range(1, min(radius, length - 1) + 1):
        total[..., far:] += weight[..., :-far]
        total[..., :-far] += weight[..., far:]
    return total.transpose(-1, -2)
