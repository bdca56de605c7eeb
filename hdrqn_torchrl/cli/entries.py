"""Runs read back with the settings they were started with, and the results of scripted players on their tasks."""

from __future__ import annotations

import json
import sys
from functools import lru_cache
from pathlib import Path

from hdrqn_torchrl.analysis.grouping import Entry, task_key, task_of
from hdrqn_torchrl.analysis.results import References, curve, find_runs, read_run
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.settings.arguments import TARGET, SettingsError
from hdrqn_torchrl.runs.settings.reading import read_choices
from hdrqn_torchrl.runs.settings.stored_settings import read_settings
from hdrqn_torchrl.runs.settings.trust import BUILDERS

BROKEN = (ValueError, TypeError, KeyError, OSError)


def note(text: str) -> None:
    """Prints something that the reader of the figure should know."""
    print(text, file=sys.stderr)


def read_entries(patterns: list[str]) -> list[Entry]:
    """All runs that can be read; those that can't are named in a warning."""
    folders = find_runs(patterns)
    if not folders:
        raise SettingsError(
            f"runs must match at least one folder with a metrics.csv, got {', '.join(patterns)}, looked up in "
            f"{Path.cwd()}; trainings write to outputs/ by default."
        )
    entries = []
    for folder in folders:
        try:
            entries.append(read_entry(folder))
        except BROKEN as error:  # one broken run must not hide the others
            note(f"warning: {folder} is left out: {' '.join(str(error).split())}")
    if not entries:
        raise SettingsError(f"runs must match at least one readable run; all {len(folders)} found were left out.")
    if failed := [str(entry.run.folder) for entry in entries if entry.run.failed]:
        note(f"note: {len(failed)} of the runs ended with an error (error.txt): {shortened(failed)}")
    return entries


def read_entry(folder: Path) -> Entry:
    """A run folder; one without settings is drawn, too."""
    run, path = read_run(folder), folder / layout.CONFIG
    settings = read_settings(path, keep_unknown=True) if path.exists() else {}
    return Entry(run, settings, read_choices(folder))


def shortened(names: list[str], number: int = 4) -> str:
    """The first few of a list."""
    more = f" and {len(names) - number} more" if len(names) > number else ""
    return ", ".join(names[:number]) + more


def common_references(entries: list[Entry], ceilings: str) -> References:
    """Scripted players' results that hold for all runs of a group."""
    tasks = {task_key(entry): entry for entry in entries}
    first, *others = [references_of(entry, ceilings) for entry in tasks.values()]
    return {player: result for player, result in first.items() if all(each.get(player) == result for each in others)}


def references_of(entry: Entry, ceilings: str) -> References:
    """Scripted players' results on a run's task; where they are not known, the ceiling that the run has logged."""
    if ceilings == "none":
        return {}
    if found := players(json.dumps(task_of(entry)), simulate=ceilings == "simulate"):
        return found
    _, logged = curve(entry.run, "greedy/ceiling")
    return {"ceiling": {"return_mean": float(logged[-1])}} if len(logged) else {}


@lru_cache
def players(settings: str, *, simulate: bool) -> References:
    """What the scripted players achieve on a task, given as JSON; empty if that is not known."""
    task = json.loads(settings)
    if task.get(TARGET) not in BUILDERS["env"]:  # a user's own: nobody has declared it trusted
        return {}
    from hdrqn_torchrl.envs import task_of as stated_by  # takes seconds: it loads torch
    from hdrqn_torchrl.runs.references import references_for
    from hdrqn_torchrl.runs.settings.building import build

    try:
        env = build(task | {"num_envs": 1}, place="env")
    except SettingsError:  # something it needs is missing, or of another version
        return {}
    return references_for(stated_by(env), play=simulate, tell=note)
