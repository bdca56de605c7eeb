"""The rules of "multiple goals in a gridworld" and "in four-rooms" as table look-ups.

One agent, obstacles and K goals stand on distinct random free cells. Goals must be reached in order.
Positions are flat cell indices; an object that is gone stands on the cell :attr:`GridRules.nowhere`,
which no agent can reach and no window shows. With that, a step is a handful of look-ups for any number
of worlds at once, on any device.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from hdrqn_torchrl.devices import on_host
from hdrqn_torchrl.envs.grid.cells import FIRST_GOAL, FLOOR, OBSTACLE, WALL
from hdrqn_torchrl.envs.grid.layouts import OF_ROOMS, map_rows
from hdrqn_torchrl.envs.grid.places import PlacedApart, Places, find_places

ACTIONS = ("up", "down", "left", "right")
MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))


LARGEST_TABLE = 1 << 24  # 0.1 GB each; a map of 40x40 cells that is seen whole


class GridState(NamedTuple):
    """Where everything stands in N worlds. ``agent`` ``[N]``, ``objects`` ``[N, num_obstacles + K]`` int64;
    ``in_order`` ``[N]`` bool: no goal was taken out of order so far."""

    agent: Tensor
    objects: Tensor
    in_order: Tensor


class GridEvents(NamedTuple):
    """What one step did. ``reward``, ``extrinsic_reward`` ``[N]`` float; ``hazard``, ``success``, ``all_collected``
    ``[N]`` bool; ``attained`` ``[N, K]`` bool."""

    reward: Tensor
    extrinsic_reward: Tensor
    hazard: Tensor
    attained: Tensor
    success: Tensor
    all_collected: Tensor


class GridRules:
    """Dynamics, rewards and views of the multi-goal grid tasks, for any number of worlds at once.

    Args:
        layout: ``"open"``, ``"four_rooms"``, ``"nine_rooms"`` or the rows of a map (``#`` is wall, all else is free).
        num_goals: K, at least 1.
        view: side of the square window around the agent, an odd number of cells; ``None`` shows the whole
            map, still centred on the agent.
        obstacle: ``"stay"`` leaves a hit obstacle where it is, ``"teleport"`` moves it to a random free cell
            (as the authors' script does).
        num_obstacles: number of obstacles.
        places: whether rooms and doors are nearer subgoals; ``None``: as the layout has it (``"nine_rooms"``: yes).
        device: where the tables live.

    Raises:
        ValueError: if an argument breaks its rule, or the objects do not fit on the map.
    """

    def __init__(
        self,
        layout: str | Sequence[str] = "open",
        *,
        num_goals: int = 2,
        view: int | None = 5,
        obstacle: Literal["stay", "teleport"] = "stay",
        num_obstacles: int = 2,
        places: bool | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        rows = map_rows(layout)
        self.height, self.width = len(rows), len(rows[0])
        self._check_size(self.height * self.width)
        if num_goals < 1:
            raise ValueError(f"num_goals must be >= 1, got {num_goals}; use 2 or 3 for the paper's tasks.")
        if num_obstacles < 0:
            raise ValueError(f"num_obstacles must be >= 0, got {num_obstacles}; use 2 for the paper's tasks.")
        if view is not None and (view < 1 or view % 2 == 0):
            raise ValueError(
                f"view must be an odd number of cells >= 1 or None, got {view}; use 3, 5 or None (whole map)."
            )
        if obstacle not in ("stay", "teleport"):
            raise ValueError(
                f"obstacle must be 'stay' or 'teleport', got {obstacle!r}; use 'stay' for the default rules."
            )
        is_wall = torch.tensor([[cell == "#" for cell in row] for row in rows]).flatten()
        free = (~is_wall).nonzero().squeeze(-1)
        needed = 1 + num_obstacles + num_goals + (obstacle == "teleport")  # teleport: a cell to move to
        if len(free) < needed:
            raise ValueError(
                f"layout must have at least {needed} free cells for the agent, {num_obstacles} obstacles and "
                f"{num_goals} goals, got {len(free)}; use a larger layout, or a smaller num_obstacles or num_goals."
            )
        self.num_goals, self.num_obstacles, self.teleport = num_goals, num_obstacles, obstacle == "teleport"
        self.view = view or 2 * self._span(free) + 3  # from any free cell all others and the walls around them
        self._check_size(self.view**2)
        self.num_codes = FIRST_GOAL + num_goals
        self.nowhere = self.height * self.width
        self.is_wall = is_wall.to(device)
        self.free_cells = free.to(device)
        self.moves = self._move_table(is_wall).to(device)
        bare, slots = self._window_tables(is_wall)
        self._bare_windows, self._window_slots = bare.to(device), slots.to(device)
        self.window_cells = self._window_cell_table(slots).to(device)
        codes = [OBSTACLE] * num_obstacles + [FIRST_GOAL + index for index in range(num_goals)]
        self._object_codes = torch.tensor(codes, dtype=torch.uint8, device=device)
        self._goal_bits = (2 ** torch.arange(num_goals)).to(device)
        of_rooms = isinstance(layout, str) and layout in OF_ROOMS
        rooms = find_places(rows, device) if places or of_rooms else None
        self.places: Places | None = None if places is False else rooms
        self._apart: PlacedApart | None = None
        if of_rooms and rooms is not None:
            self._apart = PlacedApart(rooms, num_goals=num_goals, num_obstacles=num_obstacles)

    def _check_size(self, places: int) -> None:
        """Refuses maps and views whose tables would fill the memory."""
        entries = self.height * self.width * places
        if entries > LARGEST_TABLE:
            raise ValueError(
                f"layout and view must need tables of at most {LARGEST_TABLE:,} entries (cells of the map times cells "
                f"of the map or the view), got {entries:,}; use a smaller map or view."
            )

    def _span(self, free: Tensor) -> int:
        """Largest distance between two free cells along one axis."""
        rows, columns = free // self.width, free % self.width
        return int(max(rows.max() - rows.min(), columns.max() - columns.min()))

    def _move_table(self, is_wall: Tensor) -> Tensor:
        """Cell after each action from each cell, ``[cells, 4]``; a wall or the border stops the move."""
        moves = torch.arange(self.nowhere)[:, None].repeat(1, len(ACTIONS))
        for cell in range(self.nowhere):
            row, column = divmod(cell, self.width)
            for action, (down, right) in enumerate(MOVES):
                inside = 0 <= row + down < self.height and 0 <= column + right < self.width
                target = (row + down) * self.width + column + right
                if inside and not is_wall[target]:
                    moves[cell, action] = target
        return moves

    def _window_tables(self, is_wall: Tensor) -> tuple[Tensor, Tensor]:
        """The empty window around each cell, and the place in it where another cell is seen.

        Both have one place more than the window has: cells out of view are written there and cut off.
        """
        radius, size = self.view // 2, self.view * self.view
        cells = torch.arange(self.nowhere)
        rows, columns = cells // self.width, cells % self.width
        down = rows[None, :] - rows[:, None] + radius  # [from, to]
        right = columns[None, :] - columns[:, None] + radius
        visible = (down >= 0) & (down < self.view) & (right >= 0) & (right < self.view)
        slots = torch.full((self.nowhere, self.nowhere + 1), size)
        slots[:, : self.nowhere] = torch.where(visible, down * self.view + right, size)
        bare = torch.full((self.nowhere, size + 1), WALL, dtype=torch.uint8)
        contents = torch.where(is_wall, WALL, FLOOR).to(torch.uint8).expand(self.nowhere, -1)
        bare.scatter_(1, slots[:, : self.nowhere], contents)
        return bare, slots

    def _window_cell_table(self, slots: Tensor) -> Tensor:
        """Cell shown at each place of the window around each cell, ``[cells, view * view]``; outside is ``nowhere``."""
        table = torch.full((self.nowhere, self.view * self.view + 1), self.nowhere)
        table.scatter_(1, slots[:, : self.nowhere], torch.arange(self.nowhere).expand(self.nowhere, -1))
        return table[:, :-1].contiguous()

    def sample(self, num_worlds: int, generator: torch.Generator | None = None) -> GridState:
        """Puts the agent and all objects of ``num_worlds`` new worlds on distinct random free cells."""
        device = self.free_cells.device
        in_order = torch.ones(num_worlds, dtype=torch.bool, device=device)
        if self._apart is not None:
            return GridState(*self._apart(num_worlds, generator), in_order)
        order = torch.rand((num_worlds, len(self.free_cells)), generator=generator, device=device)
        picked = self.free_cells[order.topk(1 + self.num_obstacles + self.num_goals, dim=-1).indices]
        return GridState(picked[:, 0].contiguous(), picked[:, 1:].contiguous(), in_order)

    def place(self, agent: Tensor, objects: Tensor) -> GridState:
        """Puts the agent and the objects of N new worlds where the caller wants them.

        Args:
            agent: flat cell index (``row * width + column``) of each agent, ``[N]`` int64.
            objects: flat cell indices of the obstacles, then of goals 0..K-1, ``[N, num_obstacles + K]`` int64;
                :attr:`nowhere` leaves an object out (a goal left out counts as already collected).

        Raises:
            ValueError: if a shape is wrong, something stands on a wall, or two things share a cell.
        """
        device, count = self.free_cells.device, self.num_obstacles + self.num_goals
        agent, objects = agent.to(device, torch.int64), objects.to(device, torch.int64)
        if agent.ndim != 1 or objects.shape != (len(agent), count):
            raise ValueError(
                f"agent must be [N] and objects [N, {count}] (obstacles, then goals), got {list(agent.shape)} and "
                f"{list(objects.shape)}; give every object a cell, or `nowhere` ({self.nowhere}) to leave it out."
            )
        for name, cells in (("agent", agent), ("objects", objects[objects != self.nowhere])):
            off_map = ~torch.isin(cells, self.free_cells)
            if off_map.any():
                raise ValueError(
                    f"{name} must stand on free cells, got {cells[off_map].unique().tolist()}; "
                    f"a cell is row * {self.width} + column and must not be wall."
                )
        everything = torch.cat([agent.unsqueeze(-1), objects], -1).sort(-1).values
        shared = (everything[:, 1:] == everything[:, :-1]) & (everything[:, 1:] != self.nowhere)
        if shared.any():
            twice = everything[:, 1:][shared].unique().tolist()
            raise ValueError(f"agent and objects must stand on distinct cells, got {twice} twice; move one of them.")
        return GridState(agent, objects, torch.ones_like(agent, dtype=torch.bool))

    def step(
        self, state: GridState, action: Tensor, generator: torch.Generator | None = None
    ) -> tuple[GridState, GridEvents]:
        """Moves every agent once. ``action`` ``[N]`` int64 indexes :data:`ACTIONS`.

        Reward: -1 where the agent ends on an obstacle; +1 for a goal reached in order; 0.01 for any other, that
        is, before its turn or after a goal that was taken before its turn. Reached goals disappear.
        """
        agent = self.moves[state.agent, action]
        met = state.objects == agent.unsqueeze(-1)  # [N, objects]
        hazard, attained = met[:, : self.num_obstacles].any(-1), met[:, self.num_obstacles :]
        collected = state.objects[:, self.num_obstacles :] == self.nowhere
        collected_bits, attained_bits = (collected * self._goal_bits).sum(-1), (attained * self._goal_bits).sum(-1)
        reached = attained_bits > 0
        is_next = attained_bits == collected_bits + 1  # {0..k-1} collected is 2^k - 1, goal k is 2^k
        in_order = state.in_order & is_next
        extrinsic = torch.where(in_order, 1.0, 0.01) * reached
        objects = torch.where(met, self.nowhere, state.objects)
        objects[:, : self.num_obstacles] = state.objects[:, : self.num_obstacles]
        if self.teleport:
            objects = self._move_hit_obstacles(agent, objects, met, generator)
        all_collected = collected_bits + attained_bits == 2**self.num_goals - 1
        success = all_collected & in_order
        events = GridEvents(extrinsic - hazard.float(), extrinsic, hazard, attained, success, all_collected)
        return GridState(agent, objects, in_order | (state.in_order & ~reached)), events

    def _move_hit_obstacles(
        self, agent: Tensor, objects: Tensor, met: Tensor, generator: torch.Generator | None
    ) -> Tensor:
        hit = met.clone()
        hit[:, self.num_obstacles :] = False
        if not on_host(hit):
            landing = self._free_cell(torch.cat([agent.unsqueeze(-1), objects], -1), generator)
            return torch.where(hit, landing.unsqueeze(-1), objects)
        worlds = hit.any(-1).nonzero().squeeze(-1)
        if worlds.numel():
            objects[hit] = self._free_cell(torch.cat([agent[worlds, None], objects[worlds]], -1), generator)
        return objects

    def _free_cell(self, taken: Tensor, generator: torch.Generator | None) -> Tensor:
        """A random free cell of each world ``[M]``, none of those ``taken`` ``[M, K]``."""
        order = torch.rand((len(taken), self.nowhere + 1), generator=generator, device=taken.device)
        order[:, :-1].masked_fill_(self.is_wall, -1.0)
        order.scatter_(1, taken, -1.0)[:, -1] = -1.0
        return order.argmax(-1)

    @property
    def near_names(self) -> tuple[str, ...]:
        """Names of the nearer subgoals: places, and the goals themselves, as a place alone does not lead to a goal."""
        return (*self.places.names, *self.goal_names) if self.places is not None else ()

    @property
    def goal_names(self) -> tuple[str, ...]:
        """``"goal 1"``, ..."""
        return tuple(f"goal {index + 1}" for index in range(self.num_goals))

    def near_subgoals(self, before: Tensor, state: GridState, attained: Tensor) -> tuple[Tensor, Tensor]:
        """Which nearer subgoals a step attained, and which are worth choosing now, ``[N, len(near_names)]`` bool.

        Args:
            before: cells of the agents before the step ``[N]``.
            state: after it.
            attained: goals that it attained ``[N, K]``.
        """
        assert self.places is not None
        entered, elsewhere = self.places.entered(before, state.agent), self.places.elsewhere(state.agent)
        left = state.objects[:, self.num_obstacles :] != self.nowhere
        return torch.cat([entered, attained], -1), torch.cat([elsewhere, left], -1)

    def observe(self, state: GridState) -> Tensor:
        """The window around each agent, ``[N, view, view]`` uint8 codes (:mod:`~hdrqn_torchrl.envs.grid.cells`)."""
        windows = self._bare_windows[state.agent]
        slots = self._window_slots[state.agent.unsqueeze(-1), state.objects]
        windows.scatter_(1, slots, self._object_codes.expand_as(slots))
        return windows[:, :-1].unflatten(-1, (self.view, self.view))

    def whole_map(self, state: GridState) -> Tensor:
        """The map with every object on it, ``[N, height, width]`` uint8 cell codes."""
        maps = torch.where(self.is_wall, WALL, FLOOR).to(torch.uint8)
        maps = torch.cat([maps, maps.new_zeros(1)]).repeat(len(state.agent), 1)
        maps.scatter_(1, state.objects, self._object_codes.expand_as(state.objects))
        return maps[:, :-1].unflatten(-1, (self.height, self.width))
