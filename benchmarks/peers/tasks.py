"""Tasks on which agents of different makers are compared: our grid worlds by name, MiniGrid's and BabyAI's by id."""

from __future__ import annotations

from typing import Any, NamedTuple

from torchrl.envs import EnvBase

from hdrqn_torchrl.envs import MultiGoalGridEnv, make_minigrid

GRID_WORLDS: dict[str, dict[str, Any]] = {
    "gridworld": {},
    "gridworld_3_goals": {"num_goals": 3},
    "four_rooms": {"layout": "four_rooms"},
    "four_rooms_3_goals": {"layout": "four_rooms", "num_goals": 3, "max_steps": 100},
}
"""What each is asked of :class:`~hdrqn_torchrl.envs.MultiGoalGridEnv`; the paper's tasks."""
LONG_EXPLORATION = ("BabyAI-KeyCorridorS3R3-v0",)
"""Tasks that need twice the exploration of ``conf/``; docs/minigrid.md says why."""


class Exploration(NamedTuple):
    """Epsilon of the actions: falls linearly from 1."""

    frames: int
    end: float


def exploration_of(id: str) -> Exploration:
    """How long our hierarchical agent explores actions in a task; other learners of Q-values do likewise."""
    if id in GRID_WORLDS:
        return Exploration(100_000, 0.03)
    return Exploration(400_000 if id in LONG_EXPLORATION else 200_000, 0.05)


def make_task(id: str, num_envs: int, *, max_steps: int = 0, seed: int | None = None) -> EnvBase:
    """Worlds of a task.

    Args:
        id: of :data:`GRID_WORLDS`, MiniGrid or BabyAI.
        num_envs: how many.
        max_steps: length of an episode; 0: the task's own.
        seed: of the worlds.
    """
    limit = {"max_steps": max_steps} if max_steps else {}
    if id in GRID_WORLDS:
        return MultiGoalGridEnv(num_envs, **{**GRID_WORLDS[id], **limit}, seed=seed)
    return make_minigrid(id, num_envs, **limit, seed=seed)


def settings_of_task(id: str, *, max_steps: int = 0) -> list[str]:
    """The same for ``train.py``."""
    limit = {"max_steps": max_steps} if max_steps else {}
    if id not in GRID_WORLDS:
        return ["env=minigrid", f"env.id={id}", *(f"env.{name}={value}" for name, value in limit.items())]
    settings = {**GRID_WORLDS[id], **limit}
    layout = settings.pop("layout", "gridworld")
    return [f"env={layout}", *(f"env.{name}={value}" for name, value in settings.items())]
