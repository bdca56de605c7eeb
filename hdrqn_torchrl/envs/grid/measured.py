"""What the scripted players achieve on the paper's tasks; ``python benchmarks/ceilings.py`` measures it again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class StandardTask(NamedTuple):
    """A standard task, two obstacles that stay. ``view`` is None for players that do not look through a window."""

    player: str
    layout: str
    num_goals: int
    max_steps: int
    view: int | None


LOOKING: tuple[str, ...] = ("memory", "egocentric")  # players that look through the window
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


def measured(player: str, settings: Mapping[str, Any]) -> dict[str, float] | None:
    """The figures of a player on a task that is one of the paper's; ``None`` if it is not.

    Args:
        player: its name.
        settings: of :class:`~hdrqn_torchrl.envs.MultiGoalGridEnv`, all that make the task.
    """
    if settings["obstacle"] != "stay" or settings["num_obstacles"] != 2 or not isinstance(settings["layout"], str):
        return None
    view = settings["view"] if player in LOOKING else None
    task = StandardTask(player, settings["layout"], settings["num_goals"], settings["max_steps"], view)
    if (figures := MEASURED.get(task)) is None:
        return None
    names = ("return_mean", "success_rate", "steps_mean")
    return dict(zip(names, figures, strict=True)) | {"episodes": MEASURED_EPISODES}
