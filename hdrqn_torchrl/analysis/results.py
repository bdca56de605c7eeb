"""Runs read back from their folders: metrics, summaries, single curves."""

from __future__ import annotations

import csv
import glob
import os
import re
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import RunFileError, read_json, read_text

Metrics = dict[str, list[float]]
References = dict[str, dict[str, float]]
Array = NDArray[np.floating[Any]]

AXES = {
    "frames": "environment frames",
    "episodes": "training episodes",
    "updates": "updates of all levels",
    "wall_seconds": "wall time",
    "processor_seconds": "processor time",
}
"""Columns that all others can be seen against, and what they are."""
LARGEST_WIDTH = 10_000  # columns; 100 subgoals have as many legs
_SHARES = ("success", "in_order")
_UNTIL = re.compile(rf"(?P<axis>{'|'.join(AXES)}) until (?P<column>\S+) *>= *(?P<level>-?[\d.]+)")


@dataclass(frozen=True)
class Run:
    """What a run folder holds, finished or not."""

    folder: Path
    metrics: dict[str, Array]
    """Columns of ``metrics.csv``, ``[log points]``; a cell that was not measured is NaN."""
    summary: dict[str, float] = field(default_factory=dict)
    """Final greedy evaluation; empty as long as the run goes on."""
    failed: bool = False


def find_runs(patterns: Iterable[str]) -> list[Path]:
    """Run folders (those with a ``metrics.csv``) at or anywhere below what the patterns match.

    Args:
        patterns: folders or glob patterns; ``**`` is recursive.

    Returns:
        Sorted, each folder once: of a folder and links to it, the one whose name comes first.
    """
    found: set[Path] = set()
    for pattern in patterns:
        pattern = glob.escape(pattern) if Path(pattern).exists() else pattern  # folders may have brackets in their name
        start = pattern.removesuffix(layout.METRICS).rstrip("/").removesuffix("**").rstrip("/")
        root = str(Path(start).expanduser()) if start else "/" if pattern.startswith("/") else "."
        for place in glob.iglob(root, recursive=True):  # noqa: PTH207  (Path.glob wants relative ones)
            found.update(_runs_below(Path(place)))
    kept: dict[Path, Path] = {}
    for each in sorted(found):
        kept.setdefault(each.resolve(), each)
    return list(kept.values())


def _runs_below(place: Path) -> Iterator[Path]:
    """Run folders at or below a folder; links to run folders count, others are not followed: they may be circular."""
    for folder, inner, files in os.walk(place):
        if layout.METRICS in files:
            yield Path(folder)
        for each in map(Path(folder).joinpath, inner):
            if each.is_symlink() and (each / layout.METRICS).exists():
                yield each


def read_metrics(path: Path) -> Metrics:
    """Columns of a ``metrics.csv``; an empty cell is NaN. A last line that is still being written is left out.

    Raises:
        ValueError: if the file is not a table of numbers.
    """
    try:
        rows = csv.reader(read_text(path).rpartition("\n")[0].splitlines())
        names = next(rows, [])
        if len(names) > LARGEST_WIDTH:
            raise ValueError(f"it has {len(names):,} columns, more than {LARGEST_WIDTH:,}")
        table = [_numbers(row, len(names), line) for line, row in enumerate(rows, 2)]
        return {name: [row[place] for row in table] for place, name in enumerate(names)}
    except RunFileError:
        raise
    except (ValueError, csv.Error) as error:
        raise ValueError(
            f"{path} must be a table of numbers: {error}; leave the run out or repair the file."
        ) from error


def _numbers(row: list[str], width: int, line: int) -> array[float]:
    if len(row) != width:
        raise ValueError(f"line {line} has {len(row)} cells, the header has {width}")
    return array("d", [float(cell or "nan") for cell in row])


def read_run(folder: Path) -> Run:
    """Reads one run folder.

    Where rows were logged twice, because the run was resumed from an earlier point, the later ones count. A summary
    that is older than the last row (of a run that was ended and then resumed) is ignored.

    Raises:
        ValueError: if a file is broken, or there is no complete log point yet.
        OSError: if a file can't be read.
    """
    metrics = {name: np.array(column) for name, column in read_metrics(folder / layout.METRICS).items()}
    frames = metrics.get("frames", np.empty(0))
    if not len(frames):
        raise ValueError(f"{folder / layout.METRICS} has no complete log point (a row with its frames) yet.")
    if not np.isfinite(frames).all():
        raise ValueError(f"{folder / layout.METRICS} must hold the frames of every row, got {frames.tolist()[:10]}.")
    kept = _is_below_all_that_follow(frames)
    return Run(
        folder,
        {name: column[kept] for name, column in metrics.items()},
        _read_summary(folder / layout.SUMMARY, frames[-1]),
        (folder / layout.ERROR).exists(),
    )


def _read_summary(path: Path, last_frames: float) -> dict[str, float]:
    if not path.exists():
        return {}
    found = read_json(path)
    if not isinstance(found, dict):
        raise ValueError(f"{path} must hold the results of a run as one JSON object, got {type(found).__name__}.")
    summary = {name: float(value) for name, value in found.items() if _is_number(value)}
    return summary if summary.get("frames", 0) >= last_frames else {}


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300  # which NaN is not


def _is_below_all_that_follow(x: Array) -> Array:
    """Whether each value is smaller than all that follow it."""
    least_from_here = np.minimum.accumulate(x[::-1])[::-1]
    return np.append(x[:-1] < least_from_here[1:], True)


def curve(run: Run, column: str, *, axis: str = "frames", smooth: float = 0) -> tuple[Array, Array]:
    """Positions and values of a run's column where it was measured, by increasing position.

    Args:
        run: the run.
        column: column of ``metrics.csv``.
        axis: column of the positions.
        smooth: centred moving average over this many log points, or over this share of the run's points if < 1;
            evaluations (``greedy/``) stay as they are.
    """
    nothing = np.empty(0)
    x, y = run.metrics.get(axis, nothing), run.metrics.get(column, nothing)
    if not len(x) or not len(y) or (column == "greedy/intrinsic" and _is_flat(run)):
        return nothing, nothing
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    if len(x):
        rising = _is_below_all_that_follow(x)
        x, y = x[rising], y[rising]
    return x, smoothed(y, 0 if column.startswith("greedy/") else smooth)


def _is_flat(run: Run) -> bool:
    """Whether the agent has no intrinsic reward: its greedy column says 0 then."""
    intrinsic = run.metrics.get("behaviour/intrinsic", np.empty(0))
    return "behaviour/return" in run.metrics and not np.isfinite(intrinsic).any()


def smoothed(y: Array, window: float) -> Array:
    """Centred moving average; at the ends over as many points as there are.

    Args:
        y: ``[P]``.
        window: number of points, made odd; a share of all points if < 1; 0 for none.
    """
    points = round(window * len(y) if window < 1 else window)
    reach = min(points // 2, (len(y) - 1) // 2)
    if reach < 1:
        return y
    ones = np.ones(2 * reach + 1)
    return np.convolve(y, ones, "same") / np.convolve(np.ones_like(y), ones, "same")


def source_of(column: str) -> str:
    """The column that a final value is read from; ``column`` itself, unless that asks for a time."""
    asked = _UNTIL.fullmatch(column)
    return asked["column"] if asked else column


def is_share(column: str) -> bool:
    """Whether a column's values lie between 0 and 1.

    Examples:
        >>> is_share("greedy/success"), is_share("greedy/return")
        (True, False)
    """
    return column.rpartition("/")[2] in _SHARES


def asks_for_a_time(column: str) -> bool:
    """Whether a final value says when a level was reached: a run that never does has none, and is complete."""
    return _UNTIL.fullmatch(column) is not None


def final_value(run: Run, column: str) -> float:
    """A run's final value of a column.

    Args:
        run: the run.
        column: ``greedy/...``: from the summary, else the last that was logged. ``"frames until behaviour/return>=1"``:
            frames (or another of :data:`AXES`) at the first log point at which a column was as high.

    Returns:
        NaN if there is none.
    """
    if asked := _UNTIL.fullmatch(column):
        x, y = curve(run, asked["column"], axis=asked["axis"])
        high = y >= float(asked["level"])
        return float(x[high.argmax()]) if high.any() else np.nan
    if column == "greedy/intrinsic" and _is_flat(run):
        return np.nan
    name = column.removeprefix("greedy/")
    for key in (f"{name}_mean", f"{name}_rate"):
        if key in run.summary:
            return run.summary[key]
    _, y = curve(run, column)
    return y[-1] if len(y) else np.nan
