"""The curves of one run against the ceiling of its task."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from hdrqn_torchrl.analysis.figure_files import save_figure
from hdrqn_torchrl.analysis.results import Metrics, References, read_metrics

__all__ = ["plot_run", "read_metrics"]

_PANELS = (
    ("return", "total reward of an episode"),
    ("intrinsic", "intrinsic reward of an episode"),
    ("extrinsic", "extrinsic reward of an episode"),
    ("steps", "steps of an episode"),
)
_SOURCES: dict[str, dict] = {"behaviour": {"alpha": 0.5}, "greedy": {"marker": ".", "linewidth": 2}}


def plot_run(
    metrics: Metrics,
    path: Path,
    *,
    title: str = "",
    references: References | None = None,
) -> None:
    """Draws the paper's four curves (reward, intrinsic, extrinsic, steps) of one run over environment frames.

    Those that the run has no values of are left out, as intrinsic rewards of flat agents.

    Args:
        metrics: columns as :func:`~hdrqn_torchrl.analysis.results.read_metrics` returns them.
        path: picture to write; its ending chooses the format.
        title: heading.
        references: scripted players by name, each with ``return_mean`` and ``steps_mean``, drawn as dashed lines.
    """
    panels = [panel for panel in _PANELS if any(_points(metrics, f"{source}/{panel[0]}") for source in _SOURCES)]
    panels = panels or [_PANELS[0]]
    figure = Figure(figsize=(4 * len(panels), 3.4), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, (name, label) in zip(axes, panels, strict=True):
        for source, style in _SOURCES.items():
            _curve(axis, metrics, f"{source}/{name}", source, style)
        _reference_lines(axis, references or {}, f"{name}_mean")
        axis.set(xlabel="environment frames", title=label)
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.grid(alpha=0.3)
    if axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(loc="lower right")
    figure.suptitle(title.replace("$", r"\$"))  # it names what a run was composed from
    save_figure(figure, path, dpi=110)


def _reference_lines(axis: Axes, references: References, name: str) -> None:
    for place, (player, result) in enumerate(references.items()):
        if name in result:
            axis.axhline(result[name], linestyle="--", linewidth=1, color="grey")
            at = (0.02 + 0.2 * place, result[name])  # side by side: two players may achieve the same
            axis.annotate(player, at, xycoords=("axes fraction", "data"), fontsize=8, va="bottom")


def _points(metrics: Metrics, column: str) -> list[tuple[float, float]]:
    return [(x, y) for x, y in zip(metrics.get("frames", []), metrics.get(column, []), strict=False) if y == y]


def _curve(axis: Axes, metrics: Metrics, column: str, label: str, style: dict) -> None:
    if points := _points(metrics, column):
        axis.plot(*zip(*points, strict=True), label=label, **style)
