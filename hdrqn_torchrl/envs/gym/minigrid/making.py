"""MiniGrid's and BabyAI's tasks, whole: subgoals, missions, pictures and players by themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import gymnasium
import torch

from hdrqn_torchrl.envs.gym.arguments import SomeSubgoals, import_package_of, make_world
from hdrqn_torchrl.envs.gym.environment import GymTaskEnv
from hdrqn_torchrl.envs.gym.making import make_gym
from hdrqn_torchrl.envs.gym.minigrid.bot import bot_can_play, play
from hdrqn_torchrl.envs.gym.minigrid.scene import minigrid_scene
from hdrqn_torchrl.envs.gym.minigrid.subgoals import ObjectSubgoals
from hdrqn_torchrl.envs.gym.minigrid.survey import Survey, survey
from hdrqn_torchrl.envs.task import Reference

CODES = (11, 6, 4)
"""Number of codes of the planes of an observation: object, colour, state."""

_VERBS = (
    "a", "after", "and", "at", "avoid", "behind", "box", "door", "end", "fetch", "front", "get", "go", "goal", "green",
    "hallway", "in", "key", "lava", "left", "locked", "matching", "near", "next", "object", "of", "on", "open", "pick",
    "put", "right", "room", "square", "the", "then", "to", "up", "use", "you", "your", "ball", "red", "blue", "purple",
    "yellow", "grey", "through", "opening", "reach", "find", "toy", "must", "it", "from", "before", "with", "once",
)  # fmt: skip
WORDS = tuple(sorted(set(_VERBS)))
"""Words of missions; all others have the same code."""
_TASK = "a MiniGrid or BabyAI task"
_USE_DONE = ("GoToDoor", "GoToObject")  # tasks whose end an agent has to declare

_HURTS = "Dynamic-Obstacles"  # a collision pays -1


def make_minigrid(
    id: str,
    num_envs: int = 16,
    *,
    subgoals: SomeSubgoals = "objects",
    settings: Mapping[str, Any] | None = None,
    actions: Sequence[int] | None = None,
    max_steps: int | None = None,
    processes: bool = False,
    seed: int | None = None,
    device: torch.device | str | None = None,
) -> GymTaskEnv:
    """N worlds of a MiniGrid or BabyAI task.

    The agent sees the 7x7 cells before it (object, colour, state) and its direction, and the mission's words if
    missions differ, as one vector of codes. The reward is the task's own, ``1 - 0.9 steps / max_steps`` for a success;
    ``success`` is a positive reward, ``hazard`` an end without one where there is lava.

    Args:
        id: of the task: ``"MiniGrid-..."`` or ``"BabyAI-..."``.
        num_envs: N.
        subgoals: ``"objects"``: those of :class:`~hdrqn_torchrl.envs.gym.minigrid.subgoals.ObjectSubgoals`; or sets of
            your own, as in :func:`~hdrqn_torchrl.envs.make_gym`; ``None``: agents of one level only.
        settings: keyword arguments for ``gymnasium.make``.
        actions: numbers of the actions that the agent has; ``None``: all but ``done``, which few tasks read.
        max_steps: length of an episode; ``None``: the task's own, if it varies the longest of 50 episodes.
        processes: each world has a process of its own.
        seed: of all episodes; ``None`` draws one from torch's global generator.
        device: device of all tensors.

    Raises:
        ImportError: if minigrid is missing.
        ValueError: if there is no such task, or an argument breaks its rule.

    Examples:
        >>> env = make_minigrid("MiniGrid-DoorKey-5x5-v0", num_envs=2, seed=0)
        >>> env.task.subgoals[-1].names
        ('pick up the key', 'unlock the locked door', 'reach the goal')
    """
    import_package_of(id)
    options = {**(settings or {}), **({} if max_steps is None else {"max_steps": max_steps})}
    found, can_play = _look(id, options)
    chosen = _actions(id, found.num_actions) if actions is None else actions
    env = make_gym(
        id,
        num_envs,
        subgoals=ObjectSubgoals(found, chosen) if subgoals == "objects" else subgoals,
        settings=options,
        entries=["image", "direction"] + (["mission"] if len(found.missions) > 1 else []),
        codes=CODES,
        words=WORDS,
        text_length=max(1, *(len(mission.split()) for mission in found.missions)),
        actions=chosen,
        success=_succeeds,
        hazard=_fails if found.lava else None,
        max_steps=found.max_steps,
        largest_return=1.0,
        smallest_return=-1.0 if _HURTS in id else 0.0,
        processes=processes,
        seed=seed,
        device=device,
    )
    make = partial(gymnasium.make, id, **options)
    references = {"random": _reference(make, "random", "chance", id, options)}
    if can_play:
        references["bot"] = _reference(make, "bot", "BabyAI's bot, which remembers all that it has seen", id, options)
    env.task = replace(env.task, references=references, ceiling="bot" if can_play else None, scene=minigrid_scene)
    return env


def _look(id: str, options: Mapping[str, Any]) -> tuple[Survey, bool]:
    """What occurs in the task, and whether the bot can play it."""
    stated = tuple(sorted(options.items()))
    try:
        hash(stated)
    except TypeError:  # a list among them
        return _looked.__wrapped__(id, stated)
    return _looked(id, stated)


@cache  # the episodes that it looks at are always the same
def _looked(id: str, stated: tuple[tuple[str, Any], ...]) -> tuple[Survey, bool]:
    env = make_world(id, dict(stated), what=_TASK)
    try:
        if not hasattr(env.unwrapped, "grid"):
            raise ValueError(f"id must be that of {_TASK}, got {id!r}; use make_gym (env=gym) for others.")
        return survey(env), bot_can_play(env, id)
    finally:
        env.close()


def _reference(make: Any, player: str, what: str, id: str, options: Mapping[str, Any]) -> Reference:
    key = f"{player}, {id}, {sorted(options.items())}"
    return Reference(what=what, play=partial(play, make, player), key=key)


def _actions(id: str, number: int) -> Sequence[int]:
    return range(number) if any(part in id for part in _USE_DONE) else range(min(number, 6))


def _succeeds(reward: float, info: Mapping[str, Any]) -> bool:
    return reward > 0


def _fails(reward: float, info: Mapping[str, Any]) -> bool:
    return bool(info["terminated"]) and reward <= 0
