"""What the scripted players achieve on the paper's tasks: the ceilings that learning curves are drawn against.

``python benchmarks/ceilings.py`` measures the table anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from hdrqn_torchrl.envs.grid.environment import MultiGoalGridEnv
from hdrqn_torchrl.envs.grid.scripted import PlayerName, scripted_ceiling


class StandardTask(NamedTuple):
    """A standard task, two obstacles that stay. ``view`` is None for players that do not look through a window."""

    player: PlayerName
    layout: str
    num_goals: int
    max_steps: int
    view: int | None


_LOOKING: tuple[PlayerName, ...] = ("memory", "egocentric")  # players that look through the window
MEASURED_EPISODES = 20_000
MEASURED: dict[StandardTask, tuple[float, float, float]] = {  # return_mean, success_rate, steps_mean
    StandardTask("planner", "open", 2, 50, None): (2.000, 1.0000, 12.1),
    StandardTask("memory", "open", 2, 50, None): (2.000, 1.0000, 12.1),
    StandardTask("memory", "open", 2, 50, 5): (2.000, 1.0000, 15.5),
    StandardTask("memory", "open", 2, 50, 3): (2.000, 0.9997, 22.5),
    StandardTask("egocentric", "open", 2, 50, None): (2.000, 1.0000, 12.1),
    StandardTask("egocentric", "open", 2, 50, 5): (2.000, 1.0000, 16.5),
    StandardTask("egocentric", "open", 2, 50, 3): (1.994, 0.9946, 25.1),
    StandardTask("random", "open", 2, 50, None): (-0.910, 0.0315, 48.8),
    StandardTask("planner", "open", 3, 50, None): (3.000, 1.0000, 18.1),
    StandardTask("memory", "open", 3, 50, None): (3.000, 1.0000, 18.1),
    StandardTask("memory", "open", 3, 50, 5): (3.000, 0.9999, 21.8),
    StandardTask("memory", "open", 3, 50, 3): (2.991, 0.9913, 29.6),
    StandardTask("egocentric", "open", 3, 50, None): (3.000, 1.0000, 18.1),
    StandardTask("egocentric", "open", 3, 50, 5): (3.000, 0.9998, 23.0),
    StandardTask("egocentric", "open", 3, 50, 3): (2.956, 0.9624, 32.2),
    StandardTask("random", "open", 3, 50, None): (-0.961, 0.0022, 49.8),
    StandardTask("planner", "four_rooms", 2, 50, None): (1.959, 1.0000, 14.3),
    StandardTask("memory", "four_rooms", 2, 50, None): (1.959, 1.0000, 14.3),
    StandardTask("memory", "four_rooms", 2, 50, 5): (1.958, 0.9999, 17.7),
    StandardTask("memory", "four_rooms", 2, 50, 3): (1.949, 0.9907, 25.2),
    StandardTask("egocentric", "four_rooms", 2, 50, None): (1.959, 1.0000, 14.3),
    StandardTask("egocentric", "four_rooms", 2, 50, 5): (1.958, 0.9999, 17.7),
    StandardTask("egocentric", "four_rooms", 2, 50, 3): (1.947, 0.9889, 26.0),
    StandardTask("random", "four_rooms", 2, 50, None): (-1.170, 0.0231, 49.0),
    StandardTask("planner", "four_rooms", 3, 100, None): (2.885, 0.9892, 21.6),
    StandardTask("memory", "four_rooms", 3, 100, None): (2.885, 0.9892, 21.6),
    StandardTask("memory", "four_rooms", 3, 100, 5): (2.882, 0.9892, 25.6),
    StandardTask("memory", "four_rooms", 3, 100, 3): (2.882, 0.9892, 34.1),
    StandardTask("egocentric", "four_rooms", 3, 100, None): (2.885, 0.9892, 21.6),
    StandardTask("egocentric", "four_rooms", 3, 100, 5): (2.882, 0.9892, 25.6),
    StandardTask("egocentric", "four_rooms", 3, 100, 3): (2.882, 0.9892, 35.1),
    StandardTask("random", "four_rooms", 3, 100, None): (-2.566, 0.0056, 98.8),
}


def ceiling(
    player: PlayerName,
    env: MultiGoalGridEnv,
    *,
    episodes: int = 1000,
    seed: int = 0,
    tell: Callable[[str], None] | None = None,
) -> dict[str, float]:
    """What a scripted player achieves on a task: looked up for the paper's tasks, simulated for all others.

    Args:
        player: ``"planner"`` (full information), ``"memory"`` (remembers all it saw, and knows where it is),
            ``"egocentric"`` (remembers all it saw, and must find out where it is) or ``"random"``.
        env: the environment whose task is meant; it is not played.
        episodes: number of episodes of a simulation.
        seed: seed of a simulation.
        tell: called with a sentence before a simulation, which on a large map takes minutes.

    Returns:
        ``return_mean``, ``success_rate`` (share of episodes with all goals reached in order), ``steps_mean`` and
        ``episodes``.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> ceiling("memory", MultiGoalGridEnv(layout="four_rooms", num_goals=3, max_steps=100, view=3))["episodes"]
        20000
    """
    task = env.settings
    if task["obstacle"] == "stay" and task["num_obstacles"] == 2 and isinstance(task["layout"], str):
        view = task["view"] if player in _LOOKING else None
        figures = MEASURED.get(StandardTask(player, task["layout"], task["num_goals"], task["max_steps"], view))
        if figures is not None:
            names = ("return_mean", "success_rate", "steps_mean")
            return dict(zip(names, figures, strict=True)) | {"episodes": MEASURED_EPISODES}
    if tell is not None:
        tell(f"the scripted player {player!r} plays {episodes:,} episodes of this task")
    return scripted_ceiling(player, **task, episodes=episodes, seed=seed)


def standard_tasks() -> Iterator[StandardTask]:
    """Every row of :data:`MEASURED`."""
    for layout, num_goals, max_steps in (
        ("open", 2, 50),
        ("open", 3, 50),
        ("four_rooms", 2, 50),
        ("four_rooms", 3, 100),
    ):
        yield StandardTask("planner", layout, num_goals, max_steps, None)
        for player in _LOOKING:
            for view in (None, 5, 3):
                yield StandardTask(player, layout, num_goals, max_steps, view)
        yield StandardTask("random", layout, num_goals, max_steps, None)


def measure(task: StandardTask, episodes: int, seed: int = 0) -> dict[str, float]:
    """Simulates a standard task; see :func:`~hdrqn_torchrl.envs.grid.scripted.scripted_ceiling`."""
    player, layout, num_goals, max_steps, view = task
    return scripted_ceiling(
        player, layout=layout, num_goals=num_goals, max_steps=max_steps, view=view, episodes=episodes, seed=seed
    )
