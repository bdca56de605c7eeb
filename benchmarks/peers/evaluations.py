"""The results of a run: a file with one JSON line for each evaluation."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Greedy episodes at one moment of a training.

    Args:
        agent: which one.
        id: of the task.
        bonus: for each subgoal attained, in training.
        seed: of the training.
        frames: environment steps so far.
        seconds: wall time so far, evaluations before this one included.
        cpu_seconds: processor time so far, likewise.
        episodes: number of them.
        return_mean: without the bonus.
        success_rate: share of episodes that complete the task.
        steps_mean: of all episodes.
        sampled_success_rate: of as many episodes in the same worlds with actions drawn from the policy; ``None``: it
            has no probabilities.
        final: the last one of a training that has used up its frames or its time.
    """

    agent: str
    id: str
    bonus: float
    seed: int
    frames: int
    seconds: float
    cpu_seconds: float
    episodes: int
    return_mean: float
    success_rate: float
    steps_mean: float
    sampled_success_rate: float | None = None
    final: bool = False


def append(path: Path, evaluation: Evaluation) -> None:
    """Adds a line, which is on disk when this returns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(_line(evaluation))
        file.flush()
        os.fsync(file.fileno())


def write(path: Path, evaluations: Iterable[Evaluation]) -> None:
    """Replaces the whole file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = path.with_suffix(".new")
    whole.write_text("".join(map(_line, evaluations)))
    whole.replace(path)


def read(path: Path) -> list[Evaluation]:
    """All evaluations of a run; none if there is no file. A line that was cut off is left out."""
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return [Evaluation(**json.loads(line)) for line in lines if line.endswith("\n")]


def _line(evaluation: Evaluation) -> str:
    rounded = {
        name: round(value, 4) if isinstance(value, float) else value for name, value in asdict(evaluation).items()
    }
    return json.dumps(rounded) + "\n"
