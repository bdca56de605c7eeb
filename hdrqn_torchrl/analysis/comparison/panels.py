"""What all comparing figures share: panels, colours, ceilings, legends."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter
from numpy.typing import NDArray

from hdrqn_torchrl.analysis.estimates import Center, Estimate, Group, TaskResults
from hdrqn_torchrl.analysis.figure_files import save_figure
from hdrqn_torchrl.analysis.results import Array, is_share


class Panel(NamedTuple):
    """What one panel shows: a column as line or bars and, if there is a second, that one as points."""

    column: str
    points: str | None = None
    label: str | None = None
    """Of its values; else what the column's name says."""

    @property
    def columns(self) -> set[str]:
        """Those that it draws."""
        return {self.column} if self.points is None else {self.column, self.points}


PAPER = tuple(Panel(f"behaviour/{name}", f"greedy/{name}") for name in ("return", "intrinsic", "extrinsic", "steps"))
"""The paper's four curves, with greedy evaluations as points beside."""
GREEDY = tuple(Panel(f"greedy/{name}") for name in ("return", "success", "in_order", "steps"))
FINALS = GREEDY
DISCOVERY = (Panel("discovery/subgoals", label="subgoals found"), PAPER[0], Panel("greedy/success"))

_QUANTITIES = {  # by the last part of a column's name
    "return": "reward per episode",
    "intrinsic": "intrinsic reward per episode",
    "extrinsic": "extrinsic reward per episode",
    "steps": "steps per episode",
    "success": "success (all goals in order)",
    "in_order": "goals reached in order",
}
_REFERENCE_KEYS = {"return": "return_mean", "steps": "steps_mean", "success": "success_rate"}

# Okabe and Ito's palette, which colour-blind readers can tell apart. Its yellow is too light for lines.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_MARKERS = ("o", "s", "^", "D", "v", "p", "<", ">", "h")
_PLAYERS: dict[str, tuple[str, Any]] = {  # line style and name of the scripted players
    "planner": ("ceiling: full information", (0, (1, 1.5))),
    "memory": ("ceiling: perfect memory", (0, (5, 2))),
    "ceiling": ("ceiling", (0, (5, 2))),  # that a run has logged, of whichever player
    "egocentric": ("ceiling: memory, start unknown", (0, (3, 1, 1, 1, 1, 1))),
    "random": ("floor: random", (0, (5, 2, 1, 2))),
}
GREY = "0.45"
_PANEL_SIZE = (2.7, 2.1)  # inches
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


def with_data(panels: Sequence[Panel], tasks: Sequence[TaskResults]) -> list[Panel]:
    """The panels that some group has data for.

    Raises:
        ValueError: if there are none.
    """
    columns = {column for task in tasks for group in task.groups for column in group.estimates}
    if not (shown := [panel for panel in panels if columns & panel.columns]):
        wanted = ", ".join(panel.column for panel in panels)
        raise ValueError(f"panels must name columns that a group has estimates for, got {wanted}; they have {columns}.")
    return shown


def grid_of_panels(
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
            row[0].set_title(as_text(task.title), loc="left", fontweight="bold")
        figure.suptitle(title)
    return figure, rows


_LONGEST_LABEL = 120


def styles_of(tasks: Sequence[TaskResults]) -> dict[str, tuple[str, str]]:
    """Colour and marker of each label, the same in all rows."""
    fullest_first = sorted(tasks, key=lambda task: -len(task.groups))
    labels = dict.fromkeys(group.label for task in fullest_first for group in task.groups)
    return {
        label: (_COLORS[index % len(_COLORS)], _MARKERS[index % len(_MARKERS)]) for index, label in enumerate(labels)
    }


def reached(line: Estimate) -> NDArray[np.bool_]:
    """The positions that all runs with any values have reached."""
    return line.runs == np.isfinite(line.samples).any(1).sum()


def distances(points: Estimate) -> Array:
    """``[2, P]``: how far the interval goes down and up from the estimate."""
    return np.stack([points.value - points.low, points.high - points.value]).clip(min=0)


@contextmanager
def beside_the_values(place: Axes, lying: bool = False) -> Iterator[None]:
    """Intervals that are drawn inside widen a panel by half at most, to either side: of two seeds they are huge."""
    get, set_ = (place.get_xlim, place.set_xlim) if lying else (place.get_ylim, place.set_ylim)
    low, high = get()
    yield
    lower, higher = get()
    reach = (high - low) / 2
    set_(max(lower, low - reach), min(higher, high + reach))


def finish_panel(place: Axes, panel: Panel, lying: bool = False) -> None:
    """Label, scale and grid of a panel; ``lying``: its values go to the right."""
    source, _, name = panel.column.rpartition("/")
    known = source in ("behaviour", "greedy") and name in _QUANTITIES
    values = place.xaxis if lying else place.yaxis
    values.set_label_text(panel.label or (_QUANTITIES[name] if known else panel.column))
    if known and is_share(name):
        (place.set_xlim if lying else place.set_ylim)(-0.03, 1.05)
        values.set_major_formatter(PercentFormatter(1.0))
    if source == "discovery":  # whole numbers
        values.set_major_locator(MaxNLocator(5, integer=True))
    place.grid(alpha=0.25, linewidth=0.6)


def draw_references(
    place: Axes, groups: Sequence[Group], column: str, colors: dict[str, str], lying: bool = False
) -> None:
    """Scripted players as lines: grey where the groups share them, else in the colours of the groups."""
    for player, (_, dashes) in _PLAYERS.items():
        results = {group.label: _reference(group, player, column) for group in groups}
        shared = set(results.values())
        for label, value in results.items() if len(shared) > 1 else [("", shared.pop())]:
            if value is not None:
                draw = place.axvline if lying else place.axhline
                draw(value, color=colors.get(label, GREY), linestyle=dashes, linewidth=1.1, zorder=1.5)


def _reference(group: Group, player: str, column: str) -> float | None:
    source, _, name = column.rpartition("/")
    known = source in ("behaviour", "greedy")
    return group.references.get(player, {}).get(_REFERENCE_KEYS.get(name, "")) if known else None


def with_seeds(label: str, tasks: Sequence[TaskResults]) -> str:
    """A label with the number of its runs; with their range if it differs between tasks."""
    counts = {len(group.runs) for task in tasks for group in task.groups if group.label == label}
    number = str(max(counts)) if len(counts) == 1 else f"{min(counts)} to {max(counts)}"
    return f"{label} ({number} {'seed' if number == '1' else 'seeds'})"


def reference_handles(tasks: Sequence[TaskResults], panels: Sequence[Panel]) -> list[Line2D]:
    """Lines of the scripted players, for a legend."""
    groups = [group for task in tasks for group in task.groups]
    drawn = [
        player
        for player in _PLAYERS
        if any(_reference(group, player, panel.column) is not None for group in groups for panel in panels)
    ]
    return [
        Line2D([], [], color=GREY, linestyle=_PLAYERS[player][1], linewidth=1.1, label=_PLAYERS[player][0])
        for player in drawn
    ]


def caption_of(tasks: Sequence[TaskResults], center: Center) -> str:
    """What lines and intervals are."""
    estimates = [each for task in tasks for group in task.groups for each in group.estimates.values()]
    parts = []
    if any(np.isfinite(each.low).any() for each in estimates):
        name = "interquartile mean" if center == "iqm" else "mean"
        parts.append(f"{name} over seeds with 95 % t interval")
    if any((~reached(each) & np.isfinite(each.value)).any() for each in estimates):
        parts.append("dotted where not all seeds reach")
    return "; ".join(parts)


def as_text(label: str) -> str:
    """A label from a run's settings as plain text: no mathematics, and not longer than a line.

    Examples:
        >>> as_text("a$b")
        'a\\\\$b'
    """
    return (label if len(label) <= _LONGEST_LABEL else f"{label[: _LONGEST_LABEL - 3]}...").replace("$", r"\$")


def add_legend(figure: Figure, handles: list[Any], explained: list[Any], caption: str) -> None:
    """Below all panels, in as many columns as fit: first the groups, then, in columns of their own, what lines mean."""
    for handle in handles:
        handle.set_label(as_text(handle.get_label()))
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
    """Width in inches of a legend with this number of rows, at 8 points."""
    longest = max((len(handle.get_label()) for handle in handles), default=0)
    return -(-len(handles) // rows) * (0.062 * longest + 0.55)


def save(figure: Figure, paths: Iterable[Path]) -> None:
    """Writes a figure to files; the same figure is the same bytes."""
    with matplotlib.rc_context(_STYLE):
        for path in paths:
            undated = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
            save_figure(figure, path, metadata=undated.get(path.suffix.lower()))
