"""Subgoals of MiniGrid's tasks: what can be done with objects, the same number of them in every episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from hdrqn_torchrl.envs.gym.minigrid.survey import COLOURS, THINGS, Survey, cells_of, objects_of, rooms_of
from hdrqn_torchrl.envs.gym.subgoals import Flags, Subgoals

_PICKUP, _TOGGLE = 3, 5


class Deed(NamedTuple):
    """Something that can be done with objects of a kind."""

    verb: str
    kind: str = ""
    colour: str | None = None

    def __str__(self) -> str:
        article = "an unvisited" if self.kind == "room" else "the" if self.colour is None else f"the {self.colour}"
        return f"{self.verb} {article} {self.kind}".strip() if self.kind else self.verb


class ObjectSubgoals(Subgoals):
    """Pick up a thing, open a box, unlock or open a door, stand before an object, reach the goal, enter a room.

    To complete the mission is a subgoal where there is no goal to reach. Objects of a kind are told apart by colour
    where an episode has several that differ in it. Only the first time counts, but for rooms: each one that was not
    entered before counts. What an episode lacks, or what is done, is not worth choosing.

    Args:
        found: what occurs in the task's episodes.
        actions: numbers of the agent's actions; ``None``: all of the task's.
    """

    def __init__(self, found: Survey, actions: Sequence[int] | None = None) -> None:
        self.deeds = tuple(deeds_of(found, range(found.num_actions) if actions is None else actions))
        self.names = tuple(str(deed) for deed in self.deeds)
        self.repeatable = tuple(deed.kind == "room" for deed in self.deeds)
        self._entered: set[int] = set()
        self._there: Flags = np.ones(len(self.deeds), np.bool_)

    def conditions(self, env: gymnasium.Env | None, before: Any, after: Any, info: Mapping[str, Any]) -> Sequence[bool]:
        """See :class:`~hdrqn_torchrl.envs.gym.Subgoals`."""
        if env is None:
            raise ValueError(
                "subgoals must be your own, or none, where worlds cannot be looked into; use backend='gymnasium'."
            )
        world = env.unwrapped
        if before is None:
            self._begin(world)
        room = _room(world)
        enters = room is not None and room not in self._entered
        if room is not None:
            self._entered.add(room)
        return [enters if deed.kind == "room" else self._is_done(deed, world, info) for deed in self.deeds]

    def available(self, env: gymnasium.Env | None, attained: Flags) -> Sequence[bool] | Flags:
        """See :class:`~hdrqn_torchrl.envs.gym.Subgoals`."""
        left = len(rooms_of(env.unwrapped)) > len(self._entered) if env is not None else True
        again = np.array(self.repeatable, np.bool_)
        return self._there & np.where(again, left, ~attained)

    def _begin(self, world: Any) -> None:
        """A new episode."""
        found = list(objects_of(world))
        self._entered = set()
        self._locked = [cell for cell in cells_of(world) if cell.type == "door" and cell.is_locked]
        self._boxes = sum(each.kind == "box" for each in found)
        there = {(each.kind, colour) for each in found for colour in (each.colour, None)}
        there |= {("locked door", None)} if self._locked else set()
        self._there = np.array([deed.kind in ("", "room") or (deed.kind, deed.colour) in there for deed in self.deeds])

    def _is_done(self, deed: Deed, world: Any, info: Mapping[str, Any]) -> bool:
        if deed.verb == "pick up":
            return _is(world.carrying, deed)
        if deed.verb == "unlock":
            return any(door.is_open for door in self._locked)
        if deed.verb == "stand before":
            return _is(world.grid.get(*world.front_pos), deed)
        if deed.verb == "reach":
            return _is(world.grid.get(*world.agent_pos), deed)
        if deed.kind == "box":
            return sum(each.kind == "box" for each in objects_of(world)) < self._boxes
        if deed.kind == "door":
            return any(_is(cell, deed) and cell.is_open for cell in cells_of(world))
        return bool(info.get("terminated")) and float(info.get("reward", 0.0)) > 0.0  # complete the mission


def deeds_of(found: Survey, actions: Sequence[int]) -> list[Deed]:
    """The subgoals of a task that an agent with these actions can attain without losing the episode."""
    deeds: list[Deed] = []
    if _PICKUP in actions:
        for kind in THINGS:
            deeds += [Deed("pick up", kind, colour) for colour in _colours(found, kind)]
    if _TOGGLE in actions and not found.toggling_ends:
        deeds += [Deed("open", "box")] if found.objects["box"] and "key" in found.objects else []
        deeds += [Deed("unlock", "locked door")] if found.locked_doors else []
        if found.objects["door"] > found.locked_doors:  # else to open it is to unlock it
            deeds += [Deed("open", "door", colour) for colour in _colours(found, "door")]
    if found.goes_to:
        deeds += [Deed("stand before", kind, c) for kind in (*THINGS, "door") for c in _colours(found, kind)]
    deeds += [Deed("reach", "goal")] if found.objects["goal"] else []
    deeds += [Deed("enter", "room")] if found.rooms else []
    return deeds if found.objects["goal"] else [*deeds, Deed("complete the mission")]


def _colours(found: Survey, kind: str) -> tuple[str | None, ...]:
    """Colours that tell a kind's objects apart: those that occur, none is needed, or there are no objects."""
    if not found.objects[kind]:
        return ()
    return tuple(each for each in COLOURS if each in found.colours[kind]) if kind in found.coloured else (None,)


def _is(cell: Any, deed: Deed) -> bool:
    return cell is not None and cell.type == deed.kind and deed.colour in (None, cell.color)


def _room(world: Any) -> int | None:
    """The room whose inside the agent is in."""
    x, y = world.agent_pos
    for index, room in enumerate(rooms_of(world)):
        (left, top), (width, height) = room.top, room.size
        if left < x < left + width - 1 and top < y < top + height - 1:
            return index
    return None
