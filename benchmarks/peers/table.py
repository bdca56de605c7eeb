"""All results beside each other: ``python benchmarks/peers/table.py`` prints a table and draws ``peers.png``.

Of each task, all agents at equal frames and at equal processor time: where the run that is the first to end has ended.
Values between two evaluations are interpolated. Intervals are 95 % t intervals over seeds.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from evaluations import Evaluation, read
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from numpy.typing import NDArray

from hdrqn_torchrl.analysis.intervals import mean_interval

Run = list[Evaluation]
Groups = dict[str, list[Run]]
AXES = {"frames": "environment frames", "cpu_seconds": "seconds of processor time"}
UNITS = {"frames": "frames", "cpu_seconds": "s"}
FIGURES = {
    "success_rate": ("success", ".3f"),
    "return_mean": ("return", ".3f"),
    "steps_mean": ("steps", ".1f"),
    "sampled_success_rate": ("success, actions drawn", ".3f"),
}


def read_all(folder: Path) -> dict[str, Groups]:
    """Runs by task, and by agent and bonus."""
    tasks: dict[str, Groups] = defaultdict(lambda: defaultdict(list))
    for path in sorted(folder.glob("*.jsonl")):
        if run := read(path):
            tasks[run[0].id][f"{run[0].agent}, bonus {run[0].bonus:g}"].append(run)
    return tasks


def values_at(runs: Sequence[Run], axis: str, figure: str, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """A figure of runs at places of an axis, ``[P, R]``; NaN where it is not known."""
    curves = [[np.array([getattr(each, name) for each in run], float) for name in (axis, figure)] for run in runs]
    return np.stack([np.interp(places, *curve) for curve in curves], -1)


def shared_end(groups: Groups, axis: str) -> float:
    """Where the first of all runs has ended."""
    return min(getattr(run[-1], axis) for runs in groups.values() for run in runs)


def rows_of(task: str, groups: Groups) -> list[str]:
    """Rows of the table in Markdown, one for each agent and axis."""
    rows = []
    for axis in AXES:
        end = shared_end(groups, axis)
        for agent, runs in groups.items():
            figures = [_cell(values_at(runs, axis, name, np.array([end])), form) for name, (_, form) in FIGURES.items()]
            rows.append(
                " | ".join(["", task, f"{end:,.0f} {UNITS[axis]}", agent, str(len(runs)), *figures, ""]).strip()
            )
    return rows


def _cell(values: NDArray[np.float64], form: str) -> str:
    """The mean of ``[1, R]`` with its interval."""
    low, high = mean_interval(values)
    mean = "-" if np.isnan(values).any() else format(values.mean(), form)
    return mean if np.isnan(low[0]) else f"{mean} ({low[0]:{form}} to {high[0]:{form}})"


def draw(tasks: dict[str, Groups], path: Path) -> None:
    """Success of all agents over frames and over seconds, a row for each task; dashed: with actions drawn."""
    figure = Figure(figsize=(10, 3.4 * len(tasks)), layout="constrained")
    panels = figure.subplots(len(tasks), len(AXES), squeeze=False, sharey=True)
    for row, (task, groups) in zip(panels, tasks.items(), strict=True):
        for panel, axis in zip(row, AXES, strict=True):
            for agent, runs in groups.items():
                _curve(panel, runs, axis, agent)
            panel.set(xlabel=AXES[axis], title=task, ylim=(-0.03, 1.03))
            panel.xaxis.set_major_formatter(EngFormatter(sep=""))
            panel.grid(alpha=0.3)
        row[0].set(ylabel="share of greedy episodes that succeed")
        row[0].legend()
    figure.savefig(path, dpi=110)


def _curve(panel: Axes, runs: Sequence[Run], axis: str, label: str) -> None:
    """The mean over seeds, as far as all of them go, with its interval."""
    places = np.linspace(0.0, min(getattr(run[-1], axis) for run in runs), 100)
    values, sampled = (values_at(runs, axis, name, places) for name in ("success_rate", "sampled_success_rate"))
    (line,) = panel.plot(places, values.mean(-1), label=label)
    panel.plot(places, sampled.mean(-1), "--", color=line.get_color(), linewidth=1)
    panel.fill_between(places, *mean_interval(values), color=line.get_color(), alpha=0.2)


def main() -> None:
    """Reads, prints, draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--figure", type=Path, default=Path("outputs/peers/peers.png"))
    arguments = parser.parse_args()
    tasks = read_all(arguments.results)
    if not tasks:
        parser.error(f"--results must be a folder with results (*.jsonl), got {arguments.results}.")
    print("| task | at | agent | seeds |", " | ".join(name for name, _ in FIGURES.values()), "|")
    print("|---" * (4 + len(FIGURES)) + "|")
    for task, groups in tasks.items():
        print("\n".join(rows_of(task, groups)))
    arguments.figure.parent.mkdir(parents=True, exist_ok=True)
    draw(tasks, arguments.figure)


if __name__ == "__main__":
    main()
