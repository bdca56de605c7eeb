"""Learning curves of a run against the ceiling of its task."""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.axes import Axes

_PANELS = (
    ("return", "total reward of an episode"),
    ("intrinsic", "intrinsic reward of an episode"),
    ("extrinsic", "extrinsic reward of an episode"),
    ("steps", "steps of an episode"),
)


def read_metrics(path: Path) -> dict[str, list[float]]:
    """Columns of a ``metrics.csv``; an empty cell is NaN."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = list(rows[0]) if rows else []
    return {name: [float(row[name] or "nan") for row in rows] for name in names}


def plot_run(
    metrics: dict[str, list[float]],
    path: Path,
    *,
    title: str = "",
    references: dict[str, dict[str, float]] | None = None,
) -> None:
    """Draws the paper's four curves (reward, intrinsic, extrinsic, steps) of one run over environment frames.

    Args:
        metrics: columns as :func:`read_metrics` returns them.
        path: picture to write; its ending chooses the format.
        title: heading.
        references: scripted players by name, each with ``return_mean`` and ``steps_mean``, drawn as dashed lines.
    """
    figure, axes = pyplot.subplots(1, len(_PANELS), figsize=(4 * len(_PANELS), 3.4), layout="constrained")
    for axis, (name, label) in zip(axes, _PANELS, strict=True):
        for source, style in (("behaviour", {"alpha": 0.5}), ("greedy", {"marker": ".", "linewidth": 2})):
            _curve(axis, metrics, f"{source}/{name}", source, style)
        for player, result in (references or {}).items():
            if f"{name}_mean" in result:
                axis.axhline(result[f"{name}_mean"], linestyle="--", linewidth=1, color="grey")
                axis.annotate(player, (0.02, result[f"{name}_mean"]), xycoords=("axes fraction", "data"), fontsize=8)
        axis.set(xlabel="environment frames", title=label)
        axis.grid(alpha=0.3)
    if axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(loc="lower right")
    figure.suptitle(title)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _curve(axis: Axes, metrics: dict[str, list[float]], column: str, label: str, style: dict) -> None:
    points = [(x, y) for x, y in zip(metrics.get("frames", []), metrics.get(column, []), strict=False) if y == y]
    if points:
        axis.plot(*zip(*points, strict=True), label=label, **style)
