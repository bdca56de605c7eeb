"""What the scripted players achieve on a grid task: looked up, or by simulation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

from hdrqn_torchrl.envs.grid.environment import MultiGoalGridEnv
from hdrqn_torchrl.envs.grid.measured import LOOKING, StandardTask, measured
from hdrqn_torchrl.envs.grid.scripted import PlayerName, scripted_ceiling


def ceiling(
    player: PlayerName,
    env: MultiGoalGridEnv,
    *,
    episodes: int = 1000,
    seed: int = 0,
    seconds: float | None = None,
) -> dict[str, float]:
    """What a scripted player achieves: looked up for the paper's tasks, simulated for all others.

    Args:
        player: ``"planner"`` (full information), ``"memory"`` (remembers all it saw, and knows where it is),
            ``"egocentric"`` (remembers all it saw, and must find out where it is) or ``"random"``.
        env: the environment whose task is meant; it is not played.
        episodes: number of episodes of a simulation.
        seed: seed of a simulation.
        seconds: how long a simulation may take; ``None``: as long as it takes.

    Returns:
        ``return_mean``, ``success_rate`` (share of episodes with all goals reached in order), ``steps_mean`` and
        ``episodes``.

    Raises:
        ValueError: if an argument breaks its rule.
        TimeoutError: if the time is up.

    Examples:
        >>> ceiling("memory", MultiGoalGridEnv(layout="four_rooms", num_goals=3, max_steps=100, view=3))["episodes"]
        20000
    """
    known = measured(player, env.settings)
    return known or scripted_ceiling(player, **env.settings, episodes=episodes, seed=seed, seconds=seconds)


def standard_tasks() -> Iterator[StandardTask]:
    """Every row of ``MEASURED`` (measured.py)."""
    for layout, num_goals, max_steps in (
        ("open", 2, 50),
        ("open", 3, 50),
        ("four_rooms", 2, 50),
        ("four_rooms", 3, 100),
    ):
        yield StandardTask("planner", layout, num_goals, max_steps, None)
        for player in LOOKING:
            for view in (None, 5, 3):
                yield StandardTask(player, layout, num_goals, max_steps, view)
        yield StandardTask("random", layout, num_goals, max_steps, None)


def measure(task: StandardTask, episodes: int, seed: int = 0) -> dict[str, float]:
    """Simulates a standard task; see :func:`~hdrqn_torchrl.envs.grid.scripted.scripted_ceiling`."""
    player, layout, num_goals, max_steps, view = task
    return scripted_ceiling(
        cast(PlayerName, player),
        layout=layout,
        num_goals=num_goals,
        max_steps=max_steps,
        view=view,
        episodes=episodes,
        seed=seed,
    )
