"""Learning curves of groups of runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator

from hdrqn_torchrl.analysis.comparison.panels import (
    GREY,
    PAPER,
    Panel,
    add_legend,
    beside_the_values,
    caption_of,
    distances,
    draw_references,
    finish_panel,
    grid_of_panels,
    reached,
    reference_handles,
    save,
    styles_of,
    with_data,
    with_seeds,
)
from hdrqn_torchrl.analysis.discoveries import found_at
from hdrqn_torchrl.analysis.estimates import Center, Estimate, Group, TaskResults
from hdrqn_torchrl.analysis.results import AXES

_UNITS = ((7200.0, 3600.0, "hours"), (180.0, 60.0, "minutes"), (0.0, 1.0, "seconds"))  # from, seconds, name

_DISCOVERY: Any = {"linestyle": "", "marker": "^", "markersize": 5, "markeredgewidth": 0, "alpha": 0.5}


def plot_curves(
    tasks: Sequence[TaskResults],
    paths: Iterable[Path],
    *,
    panels: Sequence[Panel] = PAPER,
    axis: str = "frames",
    center: Center = "mean",
    log_x: bool = False,
    title: str = "",
) -> None:
    """Draws curves of groups of runs with confidence bands: a row for each task, a panel for each quantity.

    A curve is solid as far as all runs of its group reach and dotted where only some do. Where agents find their
    subgoals themselves, triangles on the axis mark when.

    Args:
        tasks: results, one row each.
        paths: pictures to write; their endings choose the format.
        panels: what to draw; panels that no group has data for are left out.
        axis: column that the positions of the estimates were taken from.
        center: what the estimates are, for the caption.
        log_x: logarithmic axis.
        title: heading.

    Raises:
        ValueError: if there are no data for any panel.
    """
    panels = with_data(panels, tasks)
    figure, rows = grid_of_panels(tasks, panels, title)
    scale, unit = _unit_of(axis, tasks)
    styles = styles_of(tasks)
    for task, row in zip(tasks, rows, strict=True):
        for panel, place in zip(panels, row, strict=True):
            for group in task.groups:
                _draw_group(place, group, panel, scale, styles[group.label])
            draw_references(place, task.groups, panel.column, {label: style[0] for label, style in styles.items()})
            with beside_the_values(place):
                for group in task.groups:
                    _draw_intervals(place, group, panel, scale, styles[group.label][0])
            finish_panel(place, panel)
            for group in task.groups:
                _draw_discoveries(place, group, axis, scale, styles[group.label][0])
            place.set_xlabel(unit if task is tasks[-1] else "")
            if log_x:
                place.set_xscale("log")
            else:
                place.xaxis.set_major_locator(MaxNLocator(6))
            place.xaxis.set_major_formatter(EngFormatter(sep=""))
            if not place.has_data():
                place.set(xticks=[], yticks=[])
    handles = [_group_handle(with_seeds(label, tasks), style, panels) for label, style in styles.items()]
    explained = [*_meaning_handles(panels), *_discovery_handles(tasks), *reference_handles(tasks, panels)]
    add_legend(figure, handles, explained, caption_of(tasks, center))
    save(figure, paths)


def _unit_of(axis: str, tasks: Sequence[TaskResults]) -> tuple[float, str]:
    """Scale of the positions and the label of their axis."""
    label = AXES.get(axis, axis)
    if not axis.endswith("_seconds"):
        return 1.0, label
    longest = max(each.x[-1] for task in tasks for group in task.groups for each in group.estimates.values())
    _, seconds, name = next(unit for unit in _UNITS if longest >= unit[0])
    return 1 / seconds, f"{label} ({name})"


def _draw_group(place: Axes, group: Group, panel: Panel, scale: float, style: tuple[str, str]) -> None:
    color, marker = style
    if line := group.estimates.get(panel.column):
        _draw_curve(place, group.label, line, scale, color, marker if _has_markers(panel) else "")
    if panel.points and (points := group.estimates.get(panel.points)):
        _draw_points(place, points, scale, color, marker)


def _draw_intervals(place: Axes, group: Group, panel: Panel, scale: float, color: str) -> None:
    if line := group.estimates.get(panel.column):
        place.fill_between(line.x * scale, line.low, line.high, color=color, alpha=0.18, linewidth=0)
    if panel.points and (points := group.estimates.get(panel.points)):
        look: Any = {"fmt": "none", "ecolor": color, "elinewidth": 0.8, "errorevery": _every(points), "zorder": 3}
        place.errorbar(points.x * scale, points.value, yerr=distances(points), **look)


def _draw_discoveries(place: Axes, group: Group, axis: str, scale: float, color: str) -> None:
    """Marks on the axis where the runs of a group found subgoals."""
    x = np.concatenate([np.empty(0), *(found_at(run, axis=axis) for run in group.runs)]) * scale
    if len(x):
        look: Any = {**_DISCOVERY, "transform": place.get_xaxis_transform(), "clip_on": False, "zorder": 4}
        place.plot(x, np.zeros_like(x), color=color, **look)


def _discovery_handles(tasks: Sequence[TaskResults]) -> list[Line2D]:
    if not any(len(found_at(run)) for task in tasks for group in task.groups for run in group.runs):
        return []
    return [Line2D([], [], color=GREY, label="a subgoal was found", **_DISCOVERY)]


def _has_markers(panel: Panel) -> bool:
    return panel.points is None and panel.column.startswith("greedy/")


def _draw_curve(place: Axes, label: str, line: Estimate, scale: float, color: str, marker: str) -> None:
    x = line.x * scale
    marks: Any = {"marker": marker, "markersize": 3.5, "markeredgewidth": 0, "markevery": _every(line)}
    if not marker and np.isfinite(line.value).sum() == 1:
        marks = {"marker": "_", "markersize": 8, "markeredgewidth": 1.6}  # one point makes no line
    place.plot(x, line.value, color=color, linewidth=1.2, linestyle=":", **marks)
    place.plot(x, np.where(reached(line), line.value, np.nan), color=color, linewidth=1.6, label=label)


def _every(line: Estimate) -> int:
    """Distance of markers, so that there are about 20."""
    return -(-len(line.x) // 20)


def _draw_points(place: Axes, points: Estimate, scale: float, color: str, marker: str) -> None:
    look: Any = {"marker": marker, "markersize": 3.5, "markeredgewidth": 0, "markevery": _every(points), "zorder": 3}
    place.plot(points.x * scale, points.value, linestyle="", color=color, **look)


def _group_handle(label: str, style: tuple[str, str], panels: Sequence[Panel]) -> Line2D:
    color, marker = style
    marked = any(panel.points or _has_markers(panel) for panel in panels)
    return Line2D([], [], color=color, marker=marker if marked else "", markersize=4, linewidth=1.6, label=label)


def _meaning_handles(panels: Sequence[Panel]) -> list[Line2D]:
    if not any(panel.points for panel in panels):
        return []
    return [
        Line2D([], [], color=GREY, linewidth=1.6, label="while training, with exploration"),
        Line2D([], [], color=GREY, linestyle="", marker="o", markersize=4, label="greedy evaluation"),
    ]
