"""Learning curves of a run against the ceiling of its task."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

Metrics = dict[str, list[float]]
References = dict[str, dict[str, float]]

_PANELS = (
    ("return", "total reward of an episode"),
    ("intrinsic", "intrinsic reward of an episode"),
    ("extrinsic", "extrinsic reward of an episode"),
    ("steps", "steps of an episode"),
)


def read_metrics(path: Path) -> Metrics:
    """Columns of a ``metrics.csv``; an empty cell is NaN."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = list(rows[0]) if rows else []
    return {name: [float(row[name] or "nan") for row in rows] for name in names}


def plot_run(
    metrics: Metrics,
    path: Path,
    *,
    title: str = "",
    references: References | None = None,
) -> None:
    """Draws the paper's four curves (reward, intrinsic, extrinsic, steps) of one run over environment frames.

    Args:
        metrics: columns as :func:`read_metrics` returns them.
        path: picture to write; its ending chooses the format.
        title: heading.
        references: scripted players by name, each with ``return_mean`` and ``steps_mean``, drawn as dashed lines.
    """
    figure = Figure(figsize=(4 * len(_PANELS), 3.4), layout="constrained")
    axes = figure.subplots(1, len(_PANELS))
    for axis, (name, label) in zip(axes, _PANELS, strict=True):
        for source, style in (("behaviour", {"alpha": 0.5}), ("greedy", {"marker": ".", "linewidth": 2})):
            _curve(axis, metrics, f"{source}/{name}", source, style)
        _reference_lines(axis, references or {}, f"{name}_mean")
        axis.set(xlabel="environment frames", title=label)
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.grid(alpha=0.3)
    if axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(loc="lower right")
    figure.suptitle(title)
    figure.savefig(path, dpi=110)


def plot_comparison(
    runs: dict[str, list[Metrics]], path: Path, *, title: str = "", references: References | None = None
) -> None:
    """Draws greedy return and success of several algorithms over environment frames: mean and range over their runs.

    Args:
        runs: metrics of the runs (one per seed) of each algorithm, by label. The runs of one label share their
            evaluation frames; frames that only some of them have reached are left out.
        path: picture to write; its ending chooses the format.
        title: heading.
        references: scripted players by name, with ``return_mean`` and ``success_rate``, drawn as dashed lines.
    """
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots(1, 2)
    panels = (("greedy/return", "return_mean", "return"), ("greedy/success", "success_rate", "all goals in order"))
    for axis, (column, reference, label) in zip(axes, panels, strict=True):
        for name, seeds in runs.items():
            points = [dict(zip(run["frames"], run[column], strict=True)) for run in seeds]
            frames = [x for x in seeds[0]["frames"] if all(not np.isnan(run.get(x, np.nan)) for run in points)]
            values = np.array([[run[x] for x in frames] for run in points])
            axis.plot(
                frames, values.mean(0), marker=".", label=f"{name} ({len(seeds)} seed{'s' if len(seeds) > 1 else ''})"
            )
            axis.fill_between(frames, values.min(0), values.max(0), alpha=0.2)
        _reference_lines(axis, references or {}, reference)
        axis.set(xlabel="environment frames", title=f"greedy evaluation: {label}")
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.grid(alpha=0.3)
    axes[1].legend(loc="lower right")
    figure.suptitle(title)
    figure.savefig(path, dpi=110)


def _reference_lines(axis: Axes, references: References, name: str) -> None:
    for place, (player, result) in enumerate(references.items()):
        if name in result:
            axis.axhline(result[name], linestyle="--", linewidth=1, color="grey")
            at = (0.02 + 0.2 * place, result[name])  # side by side: two players may achieve the same
            axis.annotate(player, at, xycoords=("axes fraction", "data"), fontsize=8, va="bottom")


def _curve(axis: Axes, metrics: Metrics, column: str, label: str, style: dict) -> None:
    points = [(x, y) for x, y in zip(metrics.get("frames", []), metrics.get(column, []), strict=False) if y == y]
    if points:
        axis.plot(*zip(*points, strict=True), label=label, **style)
