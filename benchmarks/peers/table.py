"""All results beside each other: ``python benchmarks/peers/table.py`` writes tables and a figure into docs/peers.md.

Of each task, all agents at equal processor time and at equal frames: where the run that is the first to end has ended.
Runs that are not over are left out, with a warning.
Values between two evaluations are interpolated. Intervals are 95 % t intervals over seeds.
"""

from __future__ import annotations

import argparse
import sys
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
from hdrqn_torchrl.cli.marks import put

Run = list[Evaluation]
Groups = dict[str, list[Run]]
AXES = {"cpu_seconds": "seconds of processor time", "frames": "environment frames"}
UNITS = {"cpu_seconds": "s", "frames": "frames"}
FIGURES = {
    "return_mean": ("return", ".2f"),
    "success_rate": ("success", ".2f"),
    "steps_mean": ("steps", ".1f"),
    "sampled_success_rate": ("success, actions drawn", ".2f"),
}
PANELS = (("return_mean", "cpu_seconds"), ("success_rate", "cpu_seconds"), ("success_rate", "frames"))
AGENTS = {
    "v3_2_levels": "hDRQNv3",
    "v3_3_levels": "hDRQNv3, three levels",
    "v3_flat": "v3 without hierarchy",
    "recurrent_ppo": "RecurrentPPO (sb3-contrib)",
    "xuance_drqn": "DRQN (XuanCe)",
}
PAGE, FIGURE = (Path(__file__).parents[2] / "docs" / name for name in ("peers.md", "peers.png"))


def read_all(folder: Path) -> dict[str, Groups]:
    """Runs by task, and by agent and bonus: ours first, the others as :data:`AGENTS` has them."""
    tasks: dict[str, Groups] = defaultdict(lambda: defaultdict(list))
    found = {path: run for path in sorted(folder.glob("*.jsonl")) if (run := read(path))}
    for path, run in found.items():
        if not run[-1].final:
            print(f"left out: {path.name} is not over; the same command goes on", file=sys.stderr)
    runs = [run for run in found.values() if run[-1].final]
    for run in sorted(runs, key=lambda run: (list(AGENTS).index(run[0].agent), -run[0].bonus)):
        tasks[run[0].id][label_of(run[0])].append(run)
    return {task: tasks[task] for task in sorted(tasks)}


def label_of(evaluation: Evaluation) -> str:
    """What the agent is called, and whether it was told of subgoals by a bonus."""
    name = AGENTS[evaluation.agent]
    is_hierarchical = evaluation.agent.endswith("_levels")  # and takes no bonus
    bonus = {0.0: "no bonus", 1.0: "bonus"}.get(evaluation.bonus, f"bonus {evaluation.bonus:g}")
    return name if is_hierarchical else f"{name}, {bonus}"


def values_at(runs: Sequence[Run], axis: str, figure: str, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """A figure of runs at places of an axis, ``[P, R]``; NaN where it is not known."""
    curves = [[np.array([getattr(each, name) for each in run], float) for name in (axis, figure)] for run in runs]
    return np.stack([np.interp(places, *curve) for curve in curves], -1)


def shared_end(groups: Groups, axis: str) -> float:
    """Where the first of all runs has ended."""
    return min(getattr(run[-1], axis) for runs in groups.values() for run in runs)


def table_of(tasks: dict[str, Groups], axis: str) -> str:
    """A table in Markdown: all agents at equal time or frames, one row for each."""
    head = ["task", "at", "agent", "seeds", *(name for name, _ in FIGURES.values())]
    return "\n".join(
        [
            _row(head),
            "|---" * len(head) + "|",
            *(row for task, groups in tasks.items() for row in rows_of(task, groups, axis)),
        ]
    )


def rows_of(task: str, groups: Groups, axis: str) -> list[str]:
    """Those of a task."""
    end = shared_end(groups, axis)
    rows = []
    for agent, runs in groups.items():
        figures = [_cell(values_at(runs, axis, name, np.array([end])), name) for name in FIGURES]
        rows.append(_row([f"`{task}`", f"{end:,.0f} {UNITS[axis]}", agent, str(len(runs)), *figures]))
    return rows


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _interval(values: NDArray[np.float64], name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of the means of ``[P, R]``; no further than a share can go."""
    low, high = mean_interval(values)
    return (np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0)) if name.endswith("_rate") else (low, high)


def _cell(values: NDArray[np.float64], name: str) -> str:
    """The mean of ``[1, R]`` with its interval."""
    form = FIGURES[name][1]
    if np.isnan(values).any():
        return "-"
    low, high = _interval(values, name)
    mean = format(values.mean(), form)
    return mean if np.isnan(low[0]) else f"{mean} ({low[0]:{form}} to {high[0]:{form}})"


def draw(tasks: dict[str, Groups], path: Path) -> None:
    """Return and success of all agents over seconds, success over frames, a row for each task."""
    figure = Figure(figsize=(14, 3.4 * len(tasks)), layout="constrained")
    panels = figure.subplots(len(tasks), len(PANELS), squeeze=False)
    for row, (task, groups) in zip(panels, tasks.items(), strict=True):
        for panel, (name, axis) in zip(row, PANELS, strict=True):
            for agent, runs in groups.items():
                _curve(panel, runs, axis, name, agent)
            panel.set(xlabel=AXES[axis], ylabel=f"{FIGURES[name][0]} of greedy episodes", title=task)
            panel.xaxis.set_major_formatter(EngFormatter(sep=""))
            panel.grid(alpha=0.3)
        row[0].legend(fontsize="small")
    figure.savefig(path, dpi=90)


def _curve(panel: Axes, runs: Sequence[Run], axis: str, name: str, label: str) -> None:
    """The mean over seeds, as far as all of them go, with its interval; success dashed where actions are drawn."""
    places = np.linspace(0.0, min(getattr(run[-1], axis) for run in runs), 100)
    values = values_at(runs, axis, name, places)
    (line,) = panel.plot(places, values.mean(-1), label=label)
    panel.fill_between(places, *_interval(values, name), color=line.get_color(), alpha=0.2)
    if name == "success_rate":
        sampled = values_at(runs, axis, "sampled_success_rate", places)  # NaN, which draws nothing, if there is none
        panel.plot(places, sampled.mean(-1), "--", color=line.get_color(), linewidth=1)


def main() -> None:
    """Reads, draws, writes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument("--figure", type=Path, default=FIGURE)
    arguments = parser.parse_args()
    tasks = read_all(arguments.results)
    if not tasks:
        parser.error(
            f"--results must be a folder with results (*.jsonl) of runs that are over, got {arguments.results}."
        )
    text = arguments.page.read_text()
    for axis, mark in (("cpu_seconds", "at equal time"), ("frames", "at equal frames")):
        text = put(text, mark, table_of(tasks, axis))
    draw(tasks, arguments.figure)
    arguments.page.write_text(text)


if __name__ == "__main__":
    main()
