"""Final results of groups of runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hdrqn_torchrl.analysis.comparison.panels import (
    FINALS,
    GREY,
    Panel,
    add_legend,
    as_text,
    beside_the_values,
    caption_of,
    distances,
    draw_references,
    finish_panel,
    grid_of_panels,
    reference_handles,
    save,
    styles_of,
    with_data,
    with_seeds,
)
from hdrqn_torchrl.analysis.estimates import Center, Estimate, Group, TaskResults

_HATCH = "////"
_MANY = 8  # bars; if there are more they are horizontal, with their names once at the left


def plot_bars(
    tasks: Sequence[TaskResults],
    paths: Iterable[Path],
    *,
    panels: Sequence[Panel] = FINALS,
    center: Center = "mean",
    title: str = "",
) -> None:
    """Draws final results of groups of runs as bars with intervals; each run is a dot, hollow if it is unfinished.

    Args:
        tasks: results at one position (:func:`~hdrqn_torchrl.analysis.estimates.estimate_finals`), one row of panels
            each.
        paths: pictures to write; their endings choose the format.
        panels: what to draw; panels that no group has data for are left out.
        center: what the estimates are, for the caption.
        title: heading.

    Raises:
        ValueError: if there are no data for any panel.
    """
    panels = with_data(panels, tasks)
    most = max(len(task.groups) for task in tasks)
    lying = most > _MANY
    figure, rows = grid_of_panels(tasks, panels, title, height=0.16 * most + 0.6 if lying else None)
    colors = {label: style[0] for label, style in styles_of(tasks).items()}
    for task, row in zip(tasks, rows, strict=True):
        for panel, place in zip(panels, row, strict=True):
            for position, group in enumerate(task.groups):
                if panel.column in group.estimates:
                    _draw_bar(place, position, group, group.estimates[panel.column], colors[group.label], lying)
            draw_references(place, task.groups, panel.column, colors, lying)
            with beside_the_values(place, lying):
                for position, group in enumerate(task.groups):
                    if panel.column in group.estimates:
                        _draw_interval(place, position, group.estimates[panel.column], lying)
            finish_panel(place, panel, lying)
            _name_bars(
                place, [as_text(group.label) for group in task.groups], lying, shown=not lying or place is row[0]
            )
    unfinished = any(not run.summary for task in tasks for group in task.groups for run in group.runs)
    named = {} if lying else colors
    handles = [Patch(color=color, alpha=0.75, label=with_seeds(label, tasks)) for label, color in named.items()]
    meaning = [_dot("finished run", GREY), *([_dot("unfinished run", "white"), _hatched()] if unfinished else [])]
    add_legend(figure, handles, [*meaning, *reference_handles(tasks, panels)], caption_of(tasks, center))
    save(figure, paths)


def _draw_bar(place: Axes, position: int, group: Group, final: Estimate, color: str, lying: bool) -> None:
    partly = not all(run.summary for run in group.runs)
    look: Any = {"color": color, "alpha": 0.75, "hatch": _HATCH if partly else "", "edgecolor": "white"}
    if lying:
        place.barh(position, final.value, 0.7, **look)
    else:
        place.bar(position, final.value, 0.7, **look)
    offsets = np.linspace(-0.22, 0.22, len(group.runs)) if len(group.runs) > 1 else [0.0]
    for run, value, offset in zip(group.runs, final.samples[:, 0], offsets, strict=True):
        at = (value, position + offset) if lying else (position + offset, value)
        place.plot(
            *at,
            "o",
            markersize=2 if lying else 3,
            markerfacecolor=color if run.summary else "white",
            markeredgecolor="black",
            markeredgewidth=0.6,
            zorder=4,
        )


def _draw_interval(place: Axes, position: int, final: Estimate, lying: bool) -> None:
    look: Any = {"color": "black", "linestyle": "", "elinewidth": 1.4, "capsize": 2 if lying else 4, "zorder": 3}
    if lying:
        place.errorbar(final.value, position, xerr=distances(final), **look)
    else:
        place.errorbar(position, final.value, yerr=distances(final), **look)


def _name_bars(place: Axes, labels: Sequence[str], lying: bool, *, shown: bool) -> None:
    ends = -0.6, len(labels) - 0.4
    if lying:
        place.set_yticks(range(len(labels)), labels if shown else [""] * len(labels))
        place.set_ylim(*reversed(ends))  # the first on top
        place.grid(False, axis="y")
        return
    place.set_xticks(range(len(labels)), labels)
    if sum(len(label) + 2 for label in labels) > 30:
        place.tick_params("x", labelrotation=35)
        for name in place.get_xticklabels():
            name.set(ha="right", rotation_mode="anchor")
    place.set_xlim(*ends)
    place.grid(False, axis="x")


def _dot(label: str, color: str) -> Line2D:
    return Line2D(
        [], [], linestyle="", marker="o", markersize=3.5, markerfacecolor=color, markeredgecolor="black", label=label
    )


def _hatched() -> Patch:
    return Patch(facecolor=GREY, edgecolor="white", hatch=_HATCH, label="some runs unfinished")
