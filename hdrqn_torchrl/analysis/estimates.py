"""Runs summed up over seeds: learning curves and final results with confidence intervals.

Neither figures (``comparison``) nor settings (``plot.py``) are known here: runs come in, arrays go out.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hdrqn_torchrl.analysis.intervals import CONFIDENCE, center_interval
from hdrqn_torchrl.analysis.results import Array, References, Run, asks_for_a_time, curve, final_value, is_share
from hdrqn_torchrl.runs.persistence.files import replaced

Center = Literal["mean", "iqm"]
_CUT = {"mean": 0.0, "iqm": 0.25}


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


def align(curves: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Curves on common positions, by linear interpolation inside the range of each, NaN outside.

    The common positions are all those of any curve. If these are more than twice those of the longest curve (clocks
    never agree), they are as many as the longest has, evenly spaced over what half of the curves reach, and the ends of
    each curve.

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
        ends = np.array([(x[0], x[-1]) for x, _ in curves if len(x)])
        half = (len(ends) - 1) // 2
        first, last = np.sort(ends[:, 0])[-1 - half], np.sort(ends[:, 1])[half]
        grid = np.unique(np.concatenate([np.linspace(first, last, longest), ends.ravel()]))
    missing = np.full(len(grid), np.nan)
    values = [np.interp(grid, x, y, left=np.nan, right=np.nan) if len(x) else missing for x, y in curves]
    return grid, np.stack(values)


def center_of(values: Array, center: Center) -> Array:
    """Mean, or interquartile mean: a quarter of the values is cut off at either end (of fewer than 4 none).

    Args:
        values: ``[*, R]``.
        center: ``"mean"`` or ``"iqm"``.

    Returns:
        ``[*]``.
    """
    cut = int(_CUT[center] * values.shape[-1])
    return np.sort(values, -1)[..., cut : values.shape[-1] - cut].mean(-1) if cut else values.mean(-1)


def estimate(
    x: Array,
    values: Array,
    *,
    strata: Sequence[str] | None = None,
    center: Center = "mean",
    confidence: float = CONFIDENCE,
) -> Estimate:
    """Mean or IQM over runs with its t interval (:func:`~hdrqn_torchrl.analysis.intervals.center_interval`).

    A position counts where at least half of the runs of each stratum reach it. It has an interval where at least two
    runs of each stratum do and not all of them have the same value.

    Args:
        x: positions ``[P]``.
        values: ``[R, P]``; NaN where a run does not reach. Runs without any value do not count.
        strata: a name for each run; only differences within a stratum widen the interval. ``None``: all in one.
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
    for present in np.unique(here, axis=1).T:  # positions that the same runs reach go together
        positions = (here == present[:, None]).all(0)
        samples = [values[np.ix_(present & member, positions)].T for member in members]
        needed = [-(-int(member.sum()) // 2) for member in members]
        if members and all(sample.shape[1] >= least for sample, least in zip(samples, needed, strict=True)):
            result[:, positions] = _center_and_interval(samples, center, confidence)
    value, low, high = result
    return Estimate(x, value, low, high, here.sum(0), values)


def _center_and_interval(samples: list[Array], center: Center, confidence: float) -> Array:
    """``[3, P]``: center, low and high of samples ``[P, R]``, one for each stratum."""
    interval = center_interval(samples, cut=_CUT[center], confidence=confidence)
    return np.stack([center_of(np.concatenate(samples, -1), center), *interval])


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
            estimates[column] = _possible(column, estimate(*align(curves), strata=strata, center=center))
    return estimates


def estimate_finals(
    runs: Sequence[Run], columns: Iterable[str], *, strata: Sequence[str] | None = None, center: Center = "mean"
) -> dict[str, Estimate]:
    """Each column's estimate over the runs' final values, at one position; see :func:`estimate_curves`.

    A time until a level was reached has an estimate only if all runs did: those that were quick enough to get there
    are not a fair sample.
    """
    estimates = {}
    for column in columns:
        values = np.array([[final_value(run, column)] for run in runs])
        if np.isfinite(values).any():
            each = estimate(np.zeros(1), values, strata=strata, center=center)
            if asks_for_a_time(column) and not np.isfinite(values).all():
                none = np.full(1, np.nan)
                each = replace(each, value=none, low=none, high=none)
            estimates[column] = _possible(column, each)
    return estimates


def _possible(column: str, each: Estimate) -> Estimate:
    """An estimate whose interval ends where the means of a column do."""
    return replace(each, low=each.low.clip(min=0), high=each.high.clip(max=1)) if is_share(column) else each


def write_table(path: Path, tasks: Iterable[TaskResults], *, axis: str) -> None:
    """Writes all estimates as a tidy CSV: ``task, group, metric, axis, x, estimate, low, high, seeds``.

    Args:
        path: file to write.
        tasks: results; positions without an estimate are left out.
        axis: what ``x`` counts.
    """
    with replaced(path) as unfinished, unfinished.open("w", newline="") as file:
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
