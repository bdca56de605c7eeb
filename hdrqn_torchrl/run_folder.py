"""What a finished run leaves behind: ``summary.json`` and ``curves.png`` beside its metrics and weights."""

from __future__ import annotations

import json
from pathlib import Path

from torchrl.envs import EnvBase

from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.envs.ceilings import ceiling
from hdrqn_torchrl.plotting import plot_run, read_metrics
from hdrqn_torchrl.trainer import Trainer

References = dict[str, dict[str, float]]


def write_results(
    folder: Path, trainer: Trainer, result: dict[str, float], *, references: References, title: str = ""
) -> dict[str, float | None]:
    """Writes ``summary.json`` and ``curves.png``.

    Args:
        folder: run folder with its ``metrics.csv``.
        trainer: the trainer that ran.
        result: final greedy evaluation (:func:`~hdrqn_torchrl.evaluation.evaluate`).
        references: scripted players' results by name (:func:`references_for`); ``"memory"`` is the ceiling.
        title: heading of the picture.

    Returns:
        What stands in ``summary.json``.
    """
    summary: dict[str, float | None] = {
        **result,
        "frames": trainer.frames,
        "updates": trainer.updates,
        "training_episodes": trainer.episodes,
        "wall_seconds": round(trainer.wall_seconds, 1),
        "ceiling": ceiling_of(references),
    }
    partial = folder / "summary.json.partial"
    partial.write_text(json.dumps(summary, indent=2) + "\n")
    partial.replace(folder / "summary.json")
    plot_run(read_metrics(folder / "metrics.csv"), folder / "curves.png", title=title, references=references)
    return summary


def references_for(env: EnvBase) -> References:
    """What the scripted players achieve on the task of ``env``, by name; empty for tasks that have none."""
    if not isinstance(env, MultiGoalGridEnv):
        return {}
    return {player: ceiling(player, env) for player in ("planner", "memory", "random")}


def ceiling_of(references: References) -> float | None:
    """Return of the scripted player with the agent's own view; ``None`` if the task has none."""
    return references["memory"]["return_mean"] if "memory" in references else None
