"""What a run folder holds. No other module spells these names."""

from __future__ import annotations

from pathlib import Path

CONFIG = "config.yaml"
"""Every setting, as values."""
ORIGIN = "run.json"
"""Where the run comes from: command, choices of conf/, commit, versions."""
TASK = "task.json"
"""What the environment showed and stated when the run began: it goes on with no other."""
METRICS = "metrics.csv"
"""One row per log point."""
SUMMARY = "summary.json"
"""The final greedy evaluation, when the run is done."""
CURVES = "curves.png"
ERROR = "error.txt"
"""The traceback of a run that failed."""
LOCK = ".lock"
CHECKPOINTS, TENSORBOARD = "checkpoints", "tensorboard"
WEIGHTS = "weights.safetensors"
"""Weights alone, in place of checkpoints: of agents that come trained (zoo/)."""
CARD = "card.json"
"""What such an agent is, and what it achieves."""
PLAY = "play.gif"
"""How it plays."""
EVALUATIONS = "evaluations"
"""What ``evaluate.py out=RUN_DIR/evaluations/NAME.json`` writes."""

WRITTEN = (CONFIG, ORIGIN, TASK, METRICS, ERROR, SUMMARY, CURVES)
"""The files that a training writes."""
AT_THE_END = (ERROR, SUMMARY, CURVES)
"""Those that are out of date as soon as it goes on."""
KEPT = (CONFIG, ORIGIN, METRICS, SUMMARY, f"{EVALUATIONS}/*.json")
"""Patterns of the files that hold its results."""


def holds_run(folder: Path) -> bool:
    """Whether a training was begun in a folder."""
    return (folder / CONFIG).exists() or (folder / CHECKPOINTS).exists()


def holds_training(folder: Path) -> bool:
    """Whether there are measurements or checkpoints in a folder, as in a run's and not in an agent's of a zoo."""
    return (folder / METRICS).exists() or (folder / CHECKPOINTS).exists()


def is_checkpoint(path: Path) -> bool:
    """Whether a path names a checkpoint of a run rather than a run."""
    return path.parent.name == CHECKPOINTS


def split(path: Path) -> tuple[Path, Path | None]:
    """The run folder and, if ``path`` is one of its checkpoints, that.

    Examples:
        >>> [str(part) for part in split(Path("run/checkpoints/checkpoint-100"))]
        ['run', 'run/checkpoints/checkpoint-100']
        >>> split(Path("run"))[1] is None
        True
    """
    return (path.parent.parent, path) if is_checkpoint(path) else (path, None)
