"""Runs read back and summed up over seeds: learning curves and final results with confidence intervals.

Neither figures (``plotting.py``) nor settings (``plot.py``) are known here: folders come in, arrays go out.
"""

from __future__ import annotations

import csv
import glob
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Metrics = dict[str, list[float]]
References = dict[str, dict[str, float]]
Array = NDArray[np.floating[Any]]
Center = Literal["mean", "iqm"]

METRICS_FILE = "metrics.csv"
RESAMPLES = 1000


@dataclass(frozen=True)
class Run:
    """What a run folder holds, finished or not."""

    folder: Path
    metrics: dict[str, Array]
    """Columns of ``metrics.csv``, ``[log points]``; a cell that was not measured is NaN."""
    summary: dict[str, float] = field(default_factory=dict)
    """Final greedy evaluation; empty as long as the run goes on."""
    failed: bool = False


@dataclass(frozen=True)
class Estimate:
    """Mean or IQM over runs with its confidence interval, at P positions."""

    x: Array
    """``[P]``"""
    value: Array
    """``[P]``; NaN where too few runs reach."""
    low: Array
    """``[P]``; like ``high`` NaN where no interval can be given."""
    high: Array
    """``[P]``"""
    runs: NDArray[np.integer[Any]]
    """``[P]``: how many runs reach a position."""
    samples: Array
    """``[R, P]``: the runs' own values."""


@dataclass(frozen=True)
class Group:
    """Runs that are summed up together, usually the seeds of one algorithm."""

    label: str
    runs: list[Run]
    estimates: dict[str, Estimate]
    """By column of ``metrics.csv``; columns that no run has are absent."""
    references: References = field(default_factory=dict)
    """Scripted players on the group's task."""


@dataclass(frozen=True)
class TaskResults:
    """Groups that played the same task."""

    title: str
    groups: list[Group]


def find_runs(patterns: Iterable[str]) -> list[Path]:
    """Run folders (those with a ``metrics.csv``) at or anywhere below what the patterns match.

    Args:
        patterns: folders or glob patterns; ``**`` is recursive.

    Returns:
        Sorted, each folder once.
    """
    found: set[Path] = set()
    for pattern in patterns:
        pattern = glob.escape(pattern) if Path(pattern).exists() else pattern  # folders may have brackets in their name
        start = pattern.removesuffix(METRICS_FILE).rstrip("/").removesuffix("**").rstrip("/")
        root = f"{Path(start).expanduser()}/" if start or pattern.startswith("/") else ""
        files = glob.iglob(f"{root}**/{METRICS_FILE}", recursive=True)  # noqa: PTH207  (Path.glob wants relative ones)
        found.update(Path(file).parent for file in files)
    return sorted(found)


def read_metrics(path: Path) -> Metrics:
    """Columns of a ``metrics.csv``; an empty cell is NaN. A last line that is still being written is left out.

    Raises:
        ValueError: if the file is not a table of numbers.
    """
    complete = path.read_text().rpartition("\n")[0]
    try:
        names, *rows = csv.reader(complete.splitlines()) if complete else [[]]
        for line, row in enumerate(rows, 2):
            if len(row) != len(names):
                raise ValueError(f"line {line} has {len(row)} cells, the header has {len(names)}")
        columns = zip(*rows, strict=True) if rows else ([] for _ in names)
        return {name: [float(cell or "nan") for cell in column] for name, column in zip(names, columns, strict=True)}
    except (ValueError, csv.Error) as error:
        raise ValueError(
            f"{path} must be a table of numbers: {error}; leave the run out or repair the file."
        ) from error


def read_run(folder: Path) -> Run:
    """Reads one run folder.

    Where rows were logged twice, because the run was resumed from an earlier point, the later ones count. A summary
    that is older than the last row (of a run that was ended and then resumed) counts as none.

    Raises:
        ValueError: if a file is broken, or there is no complete log point yet.
        OSError: if a file can't be read.
    """
    metrics = {name: np.array(column) for name, column in read_metrics(folder / METRICS_FILE).items()}
    frames = metrics.get("frames", np.empty(0))
    if not len(frames):
        raise ValueError(f"{folder / METRICS_FILE} has no complete log point (a row with its frames) yet.")
    kept = frames <= _least_from_here(frames)
    return Run(
        folder,
        {name: column[kept] for name, column in metrics.items()},
        _read_summary(folder / "summary.json", frames[-1]),
        (folder / "error.txt").exists(),
    )


def _read_summary(path: Path, last_frames: float) -> dict[str, float]:
    if not path.exists():
        return {}
    try:
        summary = {name: value for name, value in json.loads(path.read_text()).items() if value is not None}
    except (ValueError, AttributeError) as error:
        raise ValueError(f"{path} must hold the results of a run as one JSON object: {error}.") from error
    return summary if summary.get("frames", 0) >= last_frames else {}


def _least_from_here(x: Array) -> Array:
    """Smallest of each value and all that follow."""
    return np.minimum.accumulate(x[::-1])[::-1]


def curve(run: Run, column: str, *, axis: str = "frames", smooth: float = 0) -> tuple[Array, Array]:
    """Positions and values of a run's column where it was measured, by increasing position.

    Args:
        run: the run.
        column: column of ``metrics.csv``.
        axis: column of the positions.
        smooth: centred moving average over this many log points, or over this share of the run's points if < 1.
    """
    nothing = np.empty(0)
    x, y = run.metrics.get(axis, nothing), run.metrics.get(column, nothing)
    if not len(x) or not len(y) or (column == "greedy/intrinsic" and _is_flat(run)):
        return nothing, nothing
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    if len(x):
        rising = np.append(x[:-1] < _least_from_here(x)[1:], True)
        x, y = x[rising], y[rising]
    return x, smoothed(y, smooth)


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


def align(curves: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Curves on common positions, by linear interpolation inside each one's own range, NaN outside.

    The common positions are all those of any curve. If these are more than twice those of the longest curve (clocks
    never agree), they are as many as the longest has, evenly spaced.

    Args:
        curves: positions and values of each, at least one with a point.

    Returns:
        Positions ``[P]`` and values ``[R, P]``.

    Examples:
        >>> first, second = (np.array([0.0, 10.0]), np.array([0.0, 1.0])), (np.array([5.0]), np.array([3.0]))
        >>> align([first, second])[1]
        array([[0. , 0.5, 1. ],
               [nan, 3. , nan]])
    """
    grid = np.unique(np.concatenate([x for x, _ in curves]))
    longest = max(len(x) for x, _ in curves)
    if len(grid) > 2 * longest:
        grid = np.linspace(grid[0], grid[-1], longest)
    missing = np.full(len(grid), np.nan)
    values = [np.interp(grid, x, y, left=np.nan, right=np.nan) if len(x) else missing for x, y in curves]
    return grid, np.stack(values)


def center_of(values: Array, center: Center, axis: int = -1) -> Array:
    """Mean, or interquartile mean: a quarter of the values is cut off at either end (of fewer than 4 none)."""
    if center == "mean":
        return values.mean(axis)
    from scipy.stats import trim_mean

    return trim_mean(values, 0.25, axis=axis)


def estimate(
    x: Array, values: Array, *, strata: Sequence[str] | None = None, center: Center = "mean", confidence: float = 0.95
) -> Estimate:
    """Mean or IQM over runs with a bootstrap interval (percentiles of 1,000 resamples, always the same ones).

    A position counts where at least half of the runs of each stratum reach it. It has an interval where at least two
    runs of each stratum do.

    Args:
        x: positions ``[P]``.
        values: ``[R, P]``; NaN where a run does not reach. Runs without any value do not count.
        strata: a name for each run; runs are resampled within their stratum only. ``None``: all in one.
        center: ``"mean"`` or ``"iqm"``.
        confidence: level of the interval.

    Examples:
        >>> estimate(np.array([0.0]), np.array([[1.0], [2.0], [6.0]])).value
        array([3.])
    """
    named = np.array(strata if strata is not None else [""] * len(values))
    some = ~np.isnan(values).all(1)
    members = [some & (named == name) for name in np.unique(named[some])]
    here = ~np.isnan(values)
    result = np.full((3, len(x)), np.nan)
    for present in np.unique(here, axis=1).T:  # positions that the same runs reach go through scipy together
        positions = (here == present[:, None]).all(0)
        samples = [values[np.ix_(present & member, positions)].T for member in members]
        needed = [-(-int(member.sum()) // 2) for member in members]
        if members and all(sample.shape[1] >= least for sample, least in zip(samples, needed, strict=True)):
            result[:, positions] = _center_and_interval(samples, center, confidence)
    value, low, high = result
    return Estimate(x, value, low, high, here.sum(0), values)


def _center_and_interval(samples: list[Array], center: Center, confidence: float) -> Array:
    """``[3, P]``: center, low and high of samples ``[P, R]``, one for each stratum."""
    value = center_of(np.concatenate(samples, -1), center)
    if min(sample.shape[1] for sample in samples) < 2:
        return np.stack([value, np.full_like(value, np.nan), np.full_like(value, np.nan)])
    from scipy.stats import bootstrap

    interval = bootstrap(
        samples,
        lambda *parts, axis: center_of(np.concatenate(parts, axis), center, axis),
        n_resamples=RESAMPLES,
        batch=max(1, 4_000_000 // sum(sample.size for sample in samples)),  # numbers in memory at once
        vectorized=True,
        axis=-1,
        confidence_level=confidence,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return np.stack([value, interval.low, interval.high])


def estimate_curves(
    runs: Sequence[Run],
    columns: Iterable[str],
    *,
    axis: str = "frames",
    smooth: float = 0,
    strata: Sequence[str] | None = None,
    center: Center = "mean",
) -> dict[str, Estimate]:
    """Each column's estimate over runs along an axis; columns that no run has are left out.

    Args:
        runs: the runs of one group.
        columns: columns of ``metrics.csv``.
        axis: column of the positions.
        smooth: see :func:`curve`.
        strata: see :func:`estimate`.
        center: see :func:`estimate`.
    """
    estimates = {}
    for column in columns:
        curves = [curve(run, column, axis=axis, smooth=smooth) for run in runs]
        if any(len(x) for x, _ in curves):
            estimates[column] = estimate(*align(curves), strata=strata, center=center)
    return estimates


def final_value(run: Run, column: str) -> float:
    """Final value of a ``greedy/...`` column: from the summary, else the last that was logged, else NaN."""
    name = column.removeprefix("greedy/")
    for key in (f"{name}_mean", f"{name}_rate"):
        if key in run.summary:
            return run.summary[key]
    _, y = curve(run, column)
    return y[-1] if len(y) else np.nan


def estimate_finals(
    runs: Sequence[Run], columns: Iterable[str], *, strata: Sequence[str] | None = None, center: Center = "mean"
) -> dict[str, Estimate]:
    """Each column's estimate over the runs' final values, at one position; see :func:`estimate_curves`."""
    estimates = {}
    for column in columns:
        values = np.array([[final_value(run, column)] for run in runs])
        if np.isfinite(values).any():
            estimates[column] = estimate(np.zeros(1), values, strata=strata, center=center)
    return estimates


def write_table(path: Path, tasks: Iterable[TaskResults], *, axis: str) -> None:
    """Writes all estimates as a tidy CSV: ``task, group, metric, axis, x, estimate, low, high, seeds``.

    Args:
        path: file to write.
        tasks: results; positions without an estimate are left out.
        axis: what ``x`` counts.
    """
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("task", "group", "metric", "axis", "x", "estimate", "low", "high", "seeds"))
        for task in tasks:
            for group in task.groups:
                for column, each in group.estimates.items():
                    write = partial(_table_row, task.title, group.label, column, axis)
                    rows = zip(each.x, each.value, each.low, each.high, each.runs, strict=True)
                    writer.writerows(write(*row) for row in rows if not np.isnan(row[1]))


def _table_row(*cells: Any) -> list[str]:
    """Nine significant digits; an empty cell for NaN."""
    return ["" if cell != cell else cell if isinstance(cell, str) else f"{cell:.9g}" for cell in cells]
