"""Rooms and doors of a map: subgoals nearer than the goals, and goals placed in other rooms than the agent."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

Cell = tuple[int, int]


@dataclass(frozen=True, eq=False)  # tensors have no single answer to ==
class Places:
    """The rooms and doors of a map, as subgoals: one is attained by the step that enters it.

    Attributes:
        names: ``"room 1"``, ..., then ``"door 1-2"``, ...
        num_rooms: the number of rooms among them.
        of_cell: the place that each cell belongs to, ``[cells]`` int64; walls belong to none and have ``len(names)``.
    """

    names: tuple[str, ...]
    num_rooms: int
    of_cell: Tensor

    def __len__(self) -> int:
        return len(self.names)

    def entered(self, before: Tensor, after: Tensor) -> Tensor:
        """Which place was entered by the step from the cells ``before`` to ``after`` ``[N]``: ``[N, places]`` bool."""
        place = self.of_cell[after]
        return self._is(place) & (place != self.of_cell[before]).unsqueeze(-1)

    def elsewhere(self, agent: Tensor) -> Tensor:
        """All places but the one where an agent on the cells ``agent`` ``[N]`` is: ``[N, places]`` bool."""
        return ~self._is(self.of_cell[agent])

    def _is(self, place: Tensor) -> Tensor:
        return place.unsqueeze(-1) == torch.arange(len(self), device=place.device)


def find_places(rows: Sequence[str], device: torch.device | str | None = None) -> Places:
    """Finds the rooms and doors of a map.

    A door is a free cell between two walls, with free cells on its two other sides; rooms are what doors separate.

    Args:
        rows: of the map; ``#`` is wall, anything else is free.
        device: where the table lives.

    Raises:
        ValueError: if there is no door, or one that does not lie between two rooms.

    Examples:
        >>> find_places(["#######", "#  #  #", "#     #", "#######"]).names
        ('room 1', 'room 2', 'door 1-2')
    """
    free = {(row, column) for row, line in enumerate(rows) for column, cell in enumerate(line) if cell != "#"}
    doors = sorted(cell for cell in free if _is_door(cell, free))
    room_of = _rooms(free.difference(doors))
    joined = [sorted({room_of[cell] for cell in _beside(door) if cell in room_of}) for door in doors]
    if not doors or any(len(rooms) != 2 for rooms in joined):
        raise ValueError(
            f"layout must have doors of one cell, each between two rooms, for its places to be subgoals, got "
            f"{list(rows)}; leave places out."
        )
    num_rooms, width = len(set(room_of.values())), len(rows[0])
    names = [f"room {room + 1}" for room in range(num_rooms)]
    names += [f"door {first + 1}-{second + 1}" for first, second in joined]
    of_cell = torch.full((len(rows) * width,), len(names))
    for (row, column), room in room_of.items():
        of_cell[row * width + column] = room
    for index, (row, column) in enumerate(doors):
        of_cell[row * width + column] = num_rooms + index
    return Places(tuple(names), num_rooms, of_cell.to(device))


def _beside(cell: Cell) -> tuple[Cell, Cell, Cell, Cell]:
    """Above, below, left and right."""
    row, column = cell
    return (row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)


def _is_door(cell: Cell, free: set[Cell]) -> bool:
    above, below, left, right = (other in free for other in _beside(cell))
    return above == below and left == right and above != left


def _rooms(floor: Iterable[Cell]) -> dict[Cell, int]:
    """Number of the room that each cell lies in; rooms are numbered in reading order."""
    unseen, room_of, rooms = set(floor), {}, 0
    for first in sorted(unseen):
        if first in room_of:
            continue
        front = [first]
        while front:
            cell = front.pop()
            if cell in unseen and cell not in room_of:
                room_of[cell] = rooms
                front.extend(_beside(cell))
        rooms += 1
    return room_of


class PlacedApart:
    """Puts all goals of a world in other rooms than its agent, and nothing in a door.

    Args:
        places: rooms and doors of the map.
        num_goals: K.
        num_obstacles: number of obstacles.

    Raises:
        ValueError: if the objects do not fit outside the largest room.
    """

    def __init__(self, places: Places, *, num_goals: int, num_obstacles: int) -> None:
        self._cells = (places.of_cell < places.num_rooms).nonzero().squeeze(-1)
        self._room = places.of_cell[self._cells]
        sizes = torch.bincount(self._room)
        most = int(sizes.sum() - sizes.max())
        if num_goals + num_obstacles > most:
            raise ValueError(
                f"num_goals and num_obstacles must together be <= {most}, the cells outside the largest room, got "
                f"{num_goals} and {num_obstacles}; use fewer."
            )
        self.num_goals, self.num_obstacles = num_goals, num_obstacles

    def __call__(self, num_worlds: int, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """Random cells of the agents ``[N]``, and of obstacles, then goals ``[N, num_obstacles + K]``."""
        shape, device = (2, num_worlds, len(self._cells)), self._cells.device
        order, again = torch.rand(shape, generator=generator, device=device)
        agent = order.argmax(-1, keepdim=True)
        goals = order.masked_fill(self._room == self._room[agent], -1.0).topk(self.num_goals).indices
        obstacles = again.scatter(-1, torch.cat([agent, goals], -1), -1.0).topk(self.num_obstacles).indices
        return self._cells[agent.squeeze(-1)], self._cells[torch.cat([obstacles, goals], -1)]
