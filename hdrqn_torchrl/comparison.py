"""Figures that compare groups of runs: curves and final results with intervals, against the ceilings of their tasks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter, MaxNLocator, PercentFormatter
from numpy.typing import NDArray

from hdrqn_torchrl.estimates import Center, Estimate, Group, TaskResults
from hdrqn_torchrl.results import Array


class Panel(NamedTuple):
    """What one panel shows: a column as line or bars and, if there is a second, that one as points."""

    column: str
    points: str | None = None


PAPER = tuple(Panel(f"behaviour/{name}", f"greedy/{name}") for name in ("return", "intrinsic", "extrinsic", "steps"))
"""The paper's four curves, with greedy evaluations as points beside."""
GREEDY = tuple(Panel(f"greedy/{name}") for name in ("return", "success", "in_order", "steps"))
FINALS = GREEDY

_QUANTITIES = {  # by the last part of a column's name
    "return": "reward per episode",
    "intrinsic": "intrinsic reward per episode",
    "extrinsic": "extrinsic reward per episode",
    "steps": "steps per episode",
    "success": "success (all goals in order)",
    "in_order": "goals reached in order",
}
_SHARES = ("success", "in_order")
_REFERENCE_KEYS = {"return": "return_mean", "steps": "steps_mean", "success": "success_rate"}
_AXES = {
    "frames": "environment frames",
    "episodes": "training episodes",
    "updates": "updates of all levels",
    "wall_seconds": "wall time",
}
_UNITS = ((7200.0, 3600.0, "hours"), (180.0, 60.0, "minutes"), (0.0, 1.0, "seconds"))  # from, seconds, name

# Okabe and Ito's palette: told apart by colour-blind readers, too. Its yellow is too light for lines.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_MARKERS = ("o", "s", "^", "D", "v", "p", "<", ">", "h")
_PLAYERS: dict[str, tuple[str, Any]] = {  # line style and name of the scripted players
    "planner": ("ceiling: full information", (0, (1, 1.5))),
    "memory": ("ceiling: perfect memory", (0, (5, 2))),
    "egocentric": ("ceiling: memory, start unknown", (0, (3, 1, 1, 1, 1, 1))),
    "random": ("floor: random", (0, (5, 2, 1, 2))),
}
_GREY, _HATCH = "0.45", "////"
_PANEL_SIZE = (2.7, 2.1)  # inches
_MANY = 8  # bars; more of them lie on their side, with their names once at the left
_STYLE: Any = {
    "font.size": 8,
    "axes.titlesize": 9,
    "legend.fontsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "pdf.fonttype": 42,  # fonts that journals accept
    "svg.hashsalt": "hdrqn_torchrl",  # the same figure is the same file
}


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

    A curve is solid as far as all runs of its group reach and dotted where only some do.

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
    panels = _with_data(panels, tasks)
    figure, rows = _grid_of_panels(tasks, panels, title)
    scale, unit = _unit_of(axis, tasks)
    styles = _styles(tasks)
    for task, row in zip(tasks, rows, strict=True):
        for panel, place in zip(panels, row, strict=True):
            for group in task.groups:
                _draw_group(place, group, panel, scale, styles[group.label])
            _draw_references(place, task.groups, panel.column, {label: style[0] for label, style in styles.items()})
            _finish_panel(place, panel.column)
            place.set_xlabel(unit if task is tasks[-1] else "")
            if log_x:
                place.set_xscale("log")
            else:
                place.xaxis.set_major_locator(MaxNLocator(6))
            place.xaxis.set_major_formatter(EngFormatter(sep=""))
    handles = [_group_handle(_with_seeds(label, tasks), style, panels) for label, style in styles.items()]
    explained = [*_meaning_handles(panels), *_reference_handles(tasks, panels)]
    _legend(figure, handles, explained, _caption(tasks, center))
    _save(figure, paths)


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
        tasks: results at one position (:func:`~hdrqn_torchrl.estimates.estimate_finals`), one row of panels each.
        paths: pictures to write; their endings choose the format.
        panels: what to draw; panels that no group has data for are left out.
        center: what the estimates are, for the caption.
        title: heading.

    Raises:
        ValueError: if there are no data for any panel.
    """
    panels = _with_data(panels, tasks)
    most = max(len(task.groups) for task in tasks)
    lying = most > _MANY
    figure, rows = _grid_of_panels(tasks, panels, title, height=0.16 * most + 0.6 if lying else None)
    colors = {label: style[0] for label, style in _styles(tasks).items()}
    for task, row in zip(tasks, rows, strict=True):
        for panel, place in zip(panels, row, strict=True):
            for position, group in enumerate(task.groups):
                if panel.column in group.estimates:
                    _draw_bar(place, position, group, group.estimates[panel.column], colors[group.label], lying)
            _draw_references(place, task.groups, panel.column, colors, lying)
            _finish_panel(place, panel.column, lying)
            _name_bars(place, [group.label for group in task.groups], lying, shown=not lying or place is row[0])
    unfinished = any(not run.summary for task in tasks for group in task.groups for run in group.runs)
    named = {} if lying else colors
    handles = [Patch(color=color, alpha=0.75, label=_with_seeds(label, tasks)) for label, color in named.items()]
    meaning = [_dot("finished run", _GREY), *([_dot("unfinished run", "white"), _hatched()] if unfinished else [])]
    _legend(figure, handles, [*meaning, *_reference_handles(tasks, panels)], _caption(tasks, center))
    _save(figure, paths)


def _with_data(panels: Sequence[Panel], tasks: Sequence[TaskResults]) -> list[Panel]:
    columns = {column for task in tasks for group in task.groups for column in group.estimates}
    if not (shown := [panel for panel in panels if columns & {*panel}]):
        wanted = ", ".join(panel.column for panel in panels)
        raise ValueError(f"panels must name columns that a group has estimates for, got {wanted}; they have {columns}.")
    return shown


def _grid_of_panels(
    tasks: Sequence[TaskResults], panels: Sequence[Panel], title: str, height: float | None = None
) -> tuple[Figure, list[list[Axes]]]:
    """A figure with one row of panels for each task."""
    width, usual = _PANEL_SIZE
    height = usual if height is None else height
    with matplotlib.rc_context(_STYLE):
        figure = Figure(
            figsize=(max(width * len(panels), 5.0), height * len(tasks) + 0.3),
            dpi=200,
            layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.06),
        )
        rows = figure.subplots(len(tasks), len(panels), squeeze=False).tolist()
        for task, row in zip(tasks, rows, strict=True):
            row[0].set_title(task.title, loc="left", fontweight="bold")
        figure.suptitle(title)
    return figure, rows


def _styles(tasks: Sequence[TaskResults]) -> dict[str, tuple[str, str]]:
    """Colour and marker of each label, the same in all rows."""
    fullest_first = sorted(tasks, key=lambda task: -len(task.groups))
    labels = dict.fromkeys(group.label for task in fullest_first for group in task.groups)
    return {
        label: (_COLORS[index % len(_COLORS)], _MARKERS[index % len(_MARKERS)]) for index, label in enumerate(labels)
    }


def _unit_of(axis: str, tasks: Sequence[TaskResults]) -> tuple[float, str]:
    """Scale of the positions and the label of their axis."""
    label = _AXES.get(axis, axis)
    if axis != "wall_seconds":
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


def _has_markers(panel: Panel) -> bool:
    return panel.points is None and panel.column.startswith("greedy/")


def _draw_curve(place: Axes, label: str, line: Estimate, scale: float, color: str, marker: str) -> None:
    x = line.x * scale
    marks: Any = {"marker": marker, "markersize": 3.5, "markeredgewidth": 0, "markevery": _every(line)}
    if not marker and np.isfinite(line.value).sum() == 1:
        marks = {"marker": "_", "markersize": 8, "markeredgewidth": 1.6}  # one point makes no line
    place.plot(x, line.value, color=color, linewidth=1.2, linestyle=":", **marks)
    place.plot(x, np.where(_reached(line), line.value, np.nan), color=color, linewidth=1.6, label=label)
    place.fill_between(x, line.low, line.high, color=color, alpha=0.18, linewidth=0)


def _reached(line: Estimate) -> NDArray[np.bool_]:
    """Where all runs that have values at all have reached."""
    return line.runs == np.isfinite(line.samples).any(1).sum()


def _every(line: Estimate) -> int:
    """Distance of markers, so that there are about 20."""
    return -(-len(line.x) // 20)


def _draw_points(place: Axes, points: Estimate, scale: float, color: str, marker: str) -> None:
    place.errorbar(
        points.x * scale,
        points.value,
        yerr=_distances(points),
        linestyle="",
        color=color,
        marker=marker,
        markersize=3.5,
        markeredgewidth=0,
        elinewidth=0.8,
        errorevery=_every(points),
        markevery=_every(points),
        zorder=3,
    )


def _distances(points: Estimate) -> Array:
    """``[2, P]``: how far the interval goes down and up from the estimate."""
    return np.stack([points.value - points.low, points.high - points.value]).clip(min=0)


def _draw_bar(place: Axes, position: int, group: Group, final: Estimate, color: str, lying: bool) -> None:
    partly = not all(run.summary for run in group.runs)
    look: Any = {"color": color, "alpha": 0.75, "hatch": _HATCH if partly else "", "edgecolor": "white"}
    error: Any = {"color": "black", "linestyle": "", "elinewidth": 1.4, "capsize": 2 if lying else 4, "zorder": 3}
    if lying:
        place.barh(position, final.value, 0.7, **look)
        place.errorbar(final.value, position, xerr=_distances(final), **error)
    else:
        place.bar(position, final.value, 0.7, **look)
        place.errorbar(position, final.value, yerr=_distances(final), **error)
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


def _finish_panel(place: Axes, column: str, lying: bool = False) -> None:
    source, _, name = column.rpartition("/")
    known = source in ("behaviour", "greedy") and name in _QUANTITIES
    values = place.xaxis if lying else place.yaxis
    values.set_label_text(_QUANTITIES[name] if known else column)
    if known and name in _SHARES:
        (place.set_xlim if lying else place.set_ylim)(-0.03, 1.05)
        values.set_major_formatter(PercentFormatter(1.0))
    place.grid(alpha=0.25, linewidth=0.6)


def _draw_references(
    place: Axes, groups: Sequence[Group], column: str, colors: dict[str, str], lying: bool = False
) -> None:
    """Scripted players as lines: grey where the groups share them, else in the colours of the groups."""
    for player, (_, dashes) in _PLAYERS.items():
        results = {group.label: _reference(group, player, column) for group in groups}
        shared = set(results.values())
        for label, value in results.items() if len(shared) > 1 else [("", shared.pop())]:
            if value is not None:
                draw = place.axvline if lying else place.axhline
                draw(value, color=colors.get(label, _GREY), linestyle=dashes, linewidth=1.1, zorder=1.5)


def _reference(group: Group, player: str, column: str) -> float | None:
    source, _, name = column.rpartition("/")
    known = source in ("behaviour", "greedy")
    return group.references.get(player, {}).get(_REFERENCE_KEYS.get(name, "")) if known else None


def _group_handle(label: str, style: tuple[str, str], panels: Sequence[Panel]) -> Line2D:
    color, marker = style
    marked = any(panel.points or _has_markers(panel) for panel in panels)
    return Line2D([], [], color=color, marker=marker if marked else "", markersize=4, linewidth=1.6, label=label)


def _with_seeds(label: str, tasks: Sequence[TaskResults]) -> str:
    """A label with the number of its runs; with their range if it differs between tasks."""
    counts = {len(group.runs) for task in tasks for group in task.groups if group.label == label}
    number = str(max(counts)) if len(counts) == 1 else f"{min(counts)} to {max(counts)}"
    return f"{label} ({number} {'seed' if number == '1' else 'seeds'})"


def _meaning_handles(panels: Sequence[Panel]) -> list[Line2D]:
    if not any(panel.points for panel in panels):
        return []
    return [
        Line2D([], [], color=_GREY, linewidth=1.6, label="while training, with exploration"),
        Line2D([], [], color=_GREY, linestyle="", marker="o", markersize=4, label="greedy evaluation"),
    ]


def _reference_handles(tasks: Sequence[TaskResults], panels: Sequence[Panel]) -> list[Line2D]:
    groups = [group for task in tasks for group in task.groups]
    drawn = [
        player
        for player in _PLAYERS
        if any(_reference(group, player, panel.column) is not None for group in groups for panel in panels)
    ]
    return [
        Line2D([], [], color=_GREY, linestyle=_PLAYERS[player][1], linewidth=1.1, label=_PLAYERS[player][0])
        for player in drawn
    ]


def _dot(label: str, color: str) -> Line2D:
    return Line2D(
        [], [], linestyle="", marker="o", markersize=3.5, markerfacecolor=color, markeredgecolor="black", label=label
    )


def _hatched() -> Patch:
    return Patch(facecolor=_GREY, edgecolor="white", hatch=_HATCH, label="some runs unfinished")


def _caption(tasks: Sequence[TaskResults], center: Center) -> str:
    estimates = [each for task in tasks for group in task.groups for each in group.estimates.values()]
    parts = []
    if any(np.isfinite(each.low).any() for each in estimates):
        name = "interquartile mean" if center == "iqm" else "mean"
        parts.append(f"{name} over seeds with 95 % bootstrap interval")
    if any((~_reached(each) & np.isfinite(each.value)).any() for each in estimates):
        parts.append("dotted where not all seeds reach")
    return "; ".join(parts)


def _legend(figure: Figure, handles: list[Any], explained: list[Any], caption: str) -> None:
    """Below all panels, in as many columns as fit: first the groups, then, in columns of their own, what lines mean."""
    rows = 1
    while rows < max(len(handles), len(explained)) and _width(handles, rows) + _width(explained, rows) > (
        figure.get_figwidth()
    ):
        rows += 1
    padded = [*handles, *[Line2D([], [], linestyle="", label="")] * (-len(handles) % rows), *explained]
    figure.set_figheight(figure.get_figheight() + 0.17 * rows)
    with matplotlib.rc_context(_STYLE):
        figure.legend(
            handles=padded,
            loc="outside lower center",
            ncols=-(-len(padded) // rows),
            frameon=False,
            title=caption,
            title_fontsize=8,
        )


def _width(handles: list[Any], rows: int) -> float:
    """Inches that legend entries need in so many rows, at 8 points."""
    longest = max((len(handle.get_label()) for handle in handles), default=0)
    return -(-len(handles) // rows) * (0.062 * longest + 0.55)


def _save(figure: Figure, paths: Iterable[Path]) -> None:
    with matplotlib.rc_context(_STYLE):
        for path in paths:
            undated = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
            figure.savefig(path, metadata=undated.get(path.suffix))
