"""Draws learning curves or final results of many runs, with confidence intervals, against the ceilings of their tasks.

    python plot.py runs='outputs/**' out=figure.png
    python plot.py runs='[outputs/a,outputs/b]' out='[figure.svg,table.csv]' kind=greedy by=algo,env.view

runs      folders or glob patterns, in quotes, several in brackets; all runs at or below them, unfinished ones too
out       what to write, by ending: .png .svg .pdf .csv; several in brackets
kind      curves: the paper's four curves with greedy evaluations as points (default)
          greedy: greedy return, success, goals in order, steps; bars: final results
          discovery: how many subgoals agents have found, return, success
columns   any columns of metrics.csv instead, one panel each: columns=greedy/return,greedy/success,sub/loss; with
          kind=bars also how long it took: columns='wall_seconds until behaviour/return>=1.01', a mean only of groups
          whose runs all got there
x         frames (default), episodes, updates, wall_seconds or processor_seconds
by        what makes a group: algo (default), env, network, any setting (algo.sub.slice_len), several (algo,network),
          run (each run alone), or null (all together)
center    mean (default) or iqm, the interquartile mean; either with a 95 % t interval over seeds (of the IQM after
          Tukey and McLaughlin). One seed has none, nor have equal values; of two or three it is wide, and cut off
          where it would make a panel more than twice as high
smooth    moving average over this number of log points or, if < 1, this share of a run (default 0: none); greedy
          evaluations stay as they are
pool      true: all tasks in one row of panels; intervals are of seeds, not of tasks (default: a row for each task)
ceilings  known (default): scripted players where they have been measured; simulate: the others play, each for two
          minutes at most; none
log_x     true: logarithmic axis
title     heading

Runs of a group are aligned by linear interpolation and never extrapolated. A curve goes as far as half of them reach,
and is dotted where not all do. Bands are pointwise: each holds at its position, not for the curve as a whole. Where
agents find their subgoals themselves, triangles on the axis mark when.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

from omegaconf import MISSING

from hdrqn_torchrl.analysis.comparison import DISCOVERY, FINALS, GREEDY, PAPER, Panel, plot_bars, plot_curves
from hdrqn_torchrl.analysis.estimates import Group, TaskResults, estimate_curves, estimate_finals, write_table
from hdrqn_torchrl.analysis.grouping import Entry, Row, differences, rows_of, task_key, value_of
from hdrqn_torchrl.analysis.results import (
    AXES,
    Run,
    asks_for_a_time,
    final_value,
    source_of,
)
from hdrqn_torchrl.cli.command_line import as_list, check_place, command_line
from hdrqn_torchrl.cli.entries import common_references, note, read_entries, shortened
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.settings.arguments import SettingsError

ALLOWED = {
    "kind": ("curves", "greedy", "discovery", "bars"),
    "x": tuple(AXES),
    "center": ("mean", "iqm"),
    "ceilings": ("known", "simulate", "none"),
}
ENDINGS = (".png", ".svg", ".pdf", ".csv")


@dataclass
class Settings:
    """Arguments; the module's docstring explains them."""

    runs: Any = MISSING
    out: Any = MISSING
    kind: str = "curves"
    columns: Any = None
    x: str = "frames"
    by: Any = "algo"
    center: str = "mean"
    smooth: float = 0.0
    pool: bool = False
    ceilings: str = "known"
    log_x: bool = False
    title: str = ""


def run(settings: Settings) -> None:
    """Reads, groups, sums up, draws."""
    check(settings)
    out = [Path(str(name)) for name in as_list(settings.out)]
    for path in out:
        check_place(path, "out")
    entries = read_entries([str(pattern) for pattern in as_list(settings.runs)])
    panels = choose_panels(settings, entries)
    try:
        rows = rows_of(entries, as_list(settings.by, split=True), pool=settings.pool)
    except ValueError as error:
        raise SettingsError(str(error)) from error
    tasks = [sum_up(row, panels, settings) for row in rows]
    if not any(group.estimates for task in tasks for group in task.groups):
        raise SettingsError(f"runs must hold at least one value to draw; none of the {len(entries)} found has one yet.")
    write(tasks, panels, out, settings)
    groups = {group.label for task in tasks for group in task.groups}
    print(f"{', '.join(map(str, out))}: runs {len(entries)}, groups {len(groups)}, tasks {len(tasks)}")


def check(settings: Settings) -> None:
    """Refuses what can't be drawn, before anything is read."""
    for name, allowed in ALLOWED.items():
        if (value := getattr(settings, name)) not in allowed:
            raise SettingsError(f"{name} must be one of {', '.join(allowed)}, got {value!r}.")
    if settings.kind == "bars" and (settings.x != "frames" or settings.smooth or settings.log_x):
        raise SettingsError("x, smooth and log_x must be left out with kind=bars, which shows final results.")
    if settings.smooth < 0:
        raise SettingsError(f"smooth must be >= 0, got {settings.smooth:g}; 0 draws the curves as they are.")
    if not as_list(settings.out):
        raise SettingsError("out must name at least one file, got none; for example out=figure.png.")
    for name in as_list(settings.out):
        if Path(str(name)).suffix.lower() not in ENDINGS:
            raise SettingsError(f"out must end in one of {', '.join(ENDINGS)}, got {name!r}.")
        if Path(str(name)).name == layout.METRICS:
            raise SettingsError(f"out must not have the name of a run's own data, got {name!r}; use table.csv.")


def choose_panels(settings: Settings, entries: list[Entry]) -> list[Panel]:
    """What to draw, one panel each."""
    if not (columns := as_list(settings.columns, split=True)):
        return list({"curves": PAPER, "greedy": GREEDY, "discovery": DISCOVERY, "bars": FINALS}[settings.kind])
    known = {name for entry in entries for name in entry.run.metrics}
    source = source_of if settings.kind == "bars" else str
    if unknown := [name for name in columns if source(name) not in known]:
        raise SettingsError(f"columns must be some of {', '.join(sorted(known))}, got {unknown[0]!r}.")
    return [Panel(name) for name in columns]


def sum_up(row: Row, panels: list[Panel], settings: Settings) -> TaskResults:
    """Estimates of the groups of one task."""
    columns = [name for panel in panels for name in panel if name]
    groups = []
    everyone = [entry for entries in row.groups.values() for entry in entries]
    for label, entries in row.groups.items():
        tell_about(label, entries, settings)
        runs = [entry.run for entry in entries]
        options: dict[str, Any] = {"strata": [task_key(entry) for entry in entries], "center": settings.center}
        if settings.kind == "bars":
            estimates = estimate_finals(runs, columns, **options)
            tell_who_is_missing(label, runs, columns)
        else:
            estimates = estimate_curves(runs, columns, axis=settings.x, smooth=settings.smooth, **options)
        references = common_references(everyone if settings.pool else entries, settings.ceilings)
        groups.append(Group(label, runs, estimates, references))
    return TaskResults(row.title, groups)


def tell_about(label: str, entries: list[Entry], settings: Settings) -> None:
    """Notes about what a group's estimate hides."""
    if settings.center == "iqm" and len(entries) < 4:
        note(f"note: {label}: the IQM of fewer than 4 runs cuts nothing off and is their mean")
    if settings.kind == "bars" and (unfinished := [entry for entry in entries if not entry.run.summary]):
        note(f"note: {label}: {len(unfinished)} of {len(entries)} runs are unfinished; their last evaluation counts")
    seeds = Counter((task_key(entry), value_of(entry, "seed")) for entry in entries)
    if twice := [seed for (_, seed), number in seeds.items() if number > 1 and seed != "none"]:
        note(f"note: {label}: several runs with seed {', '.join(dict.fromkeys(twice))}; each counts as one")
    counts = Counter(task for task, _ in seeds.elements())
    if len(set(counts.values())) > 1:
        fewest, most = min(counts.values()), max(counts.values())
        note(f"note: {label}: tasks have {fewest} to {most} runs; each run has the same weight, so tasks do not")
    if differing := differences(entries):
        note(f"note: {label} combines runs that differ in {shortened(differing)}; by=... separates them")


def tell_who_is_missing(label: str, runs: list[Run], columns: list[str]) -> None:
    """Notes about times that some runs of a group did not reach."""
    for column in filter(asks_for_a_time, columns):
        reached = sum(isfinite(final_value(run, column)) for run in runs)
        if reached < len(runs):
            note(f"note: {label}: {reached} of {len(runs)} runs have {column}; without the others there is no mean")


def write(tasks: list[TaskResults], panels: list[Panel], out: list[Path], settings: Settings) -> None:
    """Writes all pictures and tables."""
    for path in out:
        path.parent.mkdir(parents=True, exist_ok=True)
    pictures = [path for path in out if path.suffix.lower() != ".csv"]
    options: dict[str, Any] = {"panels": panels, "center": settings.center, "title": settings.title}
    if pictures and settings.kind == "bars":
        plot_bars(tasks, pictures, **options)
    elif pictures:
        plot_curves(tasks, pictures, axis=settings.x, log_x=settings.log_x, **options)
    for path in out:
        if path.suffix.lower() == ".csv":
            write_table(path, tasks, axis="final" if settings.kind == "bars" else settings.x)


def main() -> None:
    """Runs with the arguments of the command line."""
    command_line(Settings, __doc__ or "", run)
