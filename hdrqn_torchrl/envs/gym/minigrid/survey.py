"""What occurs in the episodes of a MiniGrid task, found by looking at some."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium

COLOURS = ("red", "green", "blue", "purple", "yellow", "grey")
THINGS = ("key", "ball", "box")
_EPISODES = 50
_TOGGLING_ENDS = ("GoToDoorEnv", "GoToObjectEnv")


class Object(NamedTuple):
    """An object of a world, by what tells it from others."""

    kind: str
    colour: str
    locked: bool = False


@dataclass(frozen=True, kw_only=True)
class Survey:
    """What occurs in the episodes of a task.

    Attributes:
        objects: the largest number of each kind of object in one episode.
        coloured: kinds of which one episode has several that differ in colour.
        colours: of each kind, all that were met.
        locked_doors: whether doors are locked.
        rooms: whether there are several rooms whose extents are known.
        lava: whether there is lava.
        goes_to: whether missions ask to stand before an object.
        missions: all missions met.
        max_steps: the longest time limit met.
        toggling_ends: whether to open something ends an episode without a reward.
        num_actions: of the task.
    """

    objects: Counter[str]
    coloured: frozenset[str]
    colours: Mapping[str, frozenset[str]]
    locked_doors: bool
    rooms: bool
    lava: bool
    goes_to: bool
    missions: frozenset[str]
    max_steps: int
    toggling_ends: bool
    num_actions: int


def survey(env: gymnasium.Env, episodes: int = _EPISODES) -> Survey:
    """Looks at the first moments of some episodes.

    Args:
        env: one world.
        episodes: number of them.
    """
    most: Counter[str] = Counter()
    coloured, missions, max_steps = set(), set(), 0
    colours: dict[str, set[str]] = {}
    locked = rooms = lava = goes_to = False
    for seed in range(episodes):
        env.reset(seed=seed)
        world: Any = env.unwrapped
        found = list(objects_of(world))
        numbers = Counter(each.kind for each in found)
        most |= numbers  # the larger of both
        coloured |= {each for each in numbers if len({one.colour for one in found if one.kind == each}) > 1}
        for each in found:
            colours.setdefault(each.kind, set()).add(each.colour)
        locked = locked or any(each.locked for each in found)
        rooms = rooms or len(rooms_of(world)) > 1
        lava = lava or any(cell.type == "lava" for cell in cells_of(world))
        goes_to = goes_to or asks_to_go(getattr(world, "instrs", None)) or world.mission.startswith("go to the ")
        missions.add(world.mission)
        max_steps = max(max_steps, int(world.max_steps))
    return Survey(
        objects=most, coloured=frozenset(coloured), locked_doors=locked, rooms=rooms, lava=lava, goes_to=goes_to,
        missions=frozenset(missions), max_steps=max_steps,
        colours={kind: frozenset(found) for kind, found in colours.items()},
        toggling_ends=type(env.unwrapped).__name__ in _TOGGLING_ENDS,
        num_actions=int(env.action_space.n),  # type: ignore[attr-defined]
    )  # fmt: skip


def cells_of(world: Any) -> Iterator[Any]:
    """Everything that lies on the grid, walls too."""
    return (cell for cell in world.grid.grid if cell is not None)


def objects_of(world: Any) -> Iterator[Object]:
    """Doors, goals and things, those inside boxes and the carried one included."""
    found = [*cells_of(world)] + ([world.carrying] if world.carrying is not None else [])
    for cell in found:
        while cell is not None:
            if cell.type in (*THINGS, "door", "goal"):
                yield Object(cell.type, cell.color, bool(getattr(cell, "is_locked", False)))
            cell = getattr(cell, "contains", None)


def rooms_of(world: Any) -> list[Any]:
    """Rooms with their extents, ``top`` and ``size``, if the task is made of any; walls belong to them."""
    grid = getattr(world, "room_grid", None)
    if grid is not None:
        return [room for row in grid for room in row]
    rooms = getattr(world, "rooms", [])  # of MultiRoom; LockedRoom's
    return [room for room in rooms if hasattr(room, "top") and hasattr(room, "size")]


def asks_to_go(instruction: Any) -> bool:
    """Whether a BabyAI instruction, or a part of one, is to go to something."""
    if instruction is None:
        return False
    parts = [getattr(instruction, name, None) for name in ("instr_a", "instr_b")]
    return type(instruction).__name__ == "GoToInstr" or any(asks_to_go(part) for part in parts)
