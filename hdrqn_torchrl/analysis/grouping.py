"""Which runs are compared: tasks by the settings of the environment, groups by any setting.

Settings are plain nested dicts, as a run's ``config.yaml`` has them.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hdrqn_torchrl.analysis.results import Run
from hdrqn_torchrl.runs.settings.comparing import NOT_COMPARED, NOT_THE_TASK, NOT_THE_WORLDS, flat

NONE = "none"
"""Label of a setting that a run does not have."""


@dataclass(frozen=True)
class Entry:
    """A run and what it was started with."""

    run: Run
    settings: dict[str, Any] = field(default_factory=dict)
    choices: dict[str, str] = field(default_factory=dict)
    """The file of each group of conf/ that the settings were composed from."""


@dataclass(frozen=True)
class Row:
    """Groups of one task."""

    title: str
    groups: dict[str, list[Entry]]
    """By label."""


def rows_of(entries: Sequence[Entry], by: Sequence[str] = ("algo",), *, pool: bool = False) -> list[Row]:
    """Sorts runs into tasks and groups.

    Args:
        entries: the runs.
        by: what makes a group: a group of conf/ (``algo``, ``env``, ``network``), a setting (``algo.gamma``), or
            ``run``. None: all runs are one group. Settings of the environment that are named here do not make a
            task, so that their groups share a row.
        pool: all tasks in one row.

    Raises:
        ValueError: if no run has what ``by`` names, or it is not a single setting.
    """
    labels = _labels(entries, by)
    compared = {key.removeprefix("env.") for key in by if key.startswith("env.")}
    tasks: dict[str, list[int]] = {}
    for index, entry in enumerate(entries):
        tasks.setdefault("" if pool or "env" in by else task_key(entry, compared), []).append(index)
    titles = _titles([[entries[index] for index in members] for members in tasks.values()], compared)
    rows = []
    for title, members in zip(titles, tasks.values(), strict=True):
        row = Row(title, {})
        for index in sorted(members, key=lambda index: _natural(labels[index])):
            row.groups.setdefault(labels[index], []).append(entries[index])
        rows.append(row)
    return sorted(rows, key=lambda row: _natural(row.title))


def task_of(entry: Entry) -> dict[str, Any]:
    """The settings of the environment that make a run's task."""
    env = entry.settings.get("env") or {}
    without = NOT_THE_TASK if id_of(entry.settings) is None else (*NOT_THE_TASK, *NOT_THE_WORLDS)
    return {key: value for key, value in env.items() if key not in without}


def id_of(settings: dict[str, Any]) -> str | None:
    """The id that names the task of ``env=gym`` and ``env=minigrid``; ``None`` for tasks that have none."""
    env = settings.get("env")
    found = env.get("id") if isinstance(env, dict) else None
    return found if isinstance(found, str) else None


def task_key(entry: Entry, without: Set[str] = frozenset()) -> str:
    """A text that is the same for runs of the same task, apart from the settings in ``without``."""
    task = {key: value for key, value in task_of(entry).items() if key not in without}
    return json.dumps(task, sort_keys=True, default=str)


def value_of(entry: Entry, key: str) -> str:
    """Value of a setting, or name of the chosen file of conf/, as text; of ``env`` the task's id, if it has one.

    Examples:
        >>> from pathlib import Path
        >>> entry = Entry(Run(Path("a"), {}), {"algo": {"sub": {"slice_len": 8}}}, {"algo": "v2"})
        >>> [value_of(entry, key) for key in ("algo", "algo.sub.slice_len", "algo.nothing")]
        ['v2', '8', 'none']
    """
    if key == "env" and (id := id_of(entry.settings)) is not None:
        return id
    if key in entry.choices:
        return _text(entry.choices[key])
    value: Any = entry.settings
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    if not isinstance(value, dict):
        return _text(value)
    if "." not in key and "_target_" in value:
        return _guessed_choice(key, value)
    raise ValueError(f"by must name single settings, got {key!r}; name one below it: {', '.join(map(str, value))}.")


def differences(entries: Sequence[Entry]) -> list[str]:
    """Settings besides task and seed in which runs differ, outermost first."""
    found = [_compared(entry.settings) for entry in entries]
    keys = dict.fromkeys(key for each in found for key in each)
    return sorted(
        (key for key in keys if len({_text(each.get(key)) for each in found}) > 1), key=lambda key: key.count(".")
    )


def _compared(settings: dict[str, Any]) -> dict[str, Any]:
    """By full names; of the environment only what does not belong to the task, such as how many worlds there are, and
    of evaluations what changes what they measure."""
    found, evaluation = flat(settings, without=NOT_COMPARED), settings.get("evaluation") or {}
    for name in ("env", "max_steps"):
        if evaluation.get(name):
            found |= flat(evaluation[name], path=f"evaluation.{name}")
    kept = ["env.num_envs", *(f"env.{name}" for name in NOT_THE_WORLDS if id_of(settings) is not None)]
    return {key: value for key, value in found.items() if not key.startswith("env.") or key in kept}


def _labels(entries: Sequence[Entry], by: Sequence[str]) -> list[str]:
    """Label of each run's group: names of files of conf/ as they are, settings with the shortest unambiguous name."""
    if not by:
        return ["all"] * len(entries)
    short = Counter(key.rpartition(".")[2] for key in by)
    columns = []
    for key in by:
        values = [value_of(entry, key) for entry in entries] if key != "run" else _run_names(entries)
        if key == "env":
            values = _task_names(entries, values, by)
        if set(values) == {NONE} and any(entry.settings for entry in entries):
            raise ValueError(
                f"by must name algo, env, network, run or a setting of the runs, got {key!r}, which none of them has; "
                "config.yaml in a run folder shows its settings."
            )
        last = key.rpartition(".")[2]
        name = last if short[last] == 1 else key
        columns.append(values if _names_a_file(key, entries) else [f"{name}={value}" for value in values])
    return [", ".join(parts) for parts in zip(*columns, strict=True)]


def _run_names(entries: Sequence[Entry]) -> list[str]:
    """Run folders, without what all of them have in common."""
    parent = Path(os.path.commonpath([entry.run.folder.parent for entry in entries]))
    return [str(entry.run.folder.relative_to(parent)) for entry in entries]


def _task_names(entries: Sequence[Entry], names: Sequence[str], by: Sequence[str]) -> list[str]:
    """Names of tasks, with what tells those of one name apart, but for the settings that stand in ``by`` themselves."""
    compared = {key.removeprefix("env.") for key in by if key.startswith("env.")}
    tasks: dict[str, list[Entry]] = {}
    for entry in entries:
        tasks.setdefault(task_key(entry, compared), []).append(entry)
    titles = dict(zip(tasks, _titles(list(tasks.values()), compared), strict=True))
    found = [titles[task_key(entry, compared)] for entry in entries]
    return [name if name == NONE else title for name, title in zip(names, found, strict=True)]


def _names_a_file(key: str, entries: Sequence[Entry]) -> bool:
    return "." not in key and all(isinstance(entry.settings.get(key, {}), dict) for entry in entries)


def _titles(tasks: Sequence[Sequence[Entry]], without: Set[str]) -> list[str]:
    """The environment's name, and the settings that tell tasks of the same name apart."""
    names = [" + ".join(dict.fromkeys(value_of(entry, "env") for entry in entries)) for entries in tasks]
    names = ["unknown task" if name == NONE else name for name in names]
    titles = []
    for name, (first, *_) in zip(names, tasks, strict=True):
        same = [task_of(other) for (other, *_), its_name in zip(tasks, names, strict=True) if its_name == name]
        keys = dict.fromkeys(key for task in same for key in task if key not in without)
        telling = [key for key in keys if len({_text(task.get(key)) for task in same}) > 1]
        titles.append(", ".join([name, *(f"{key}={_text(task_of(first).get(key))}" for key in telling)]))
    return titles


def _guessed_choice(group: str, settings: dict[str, Any]) -> str:
    """A name for a part of the settings where a run folder does not say which file of conf/ it came from."""
    builder = str(settings["_target_"]).rpartition(".")[2]
    if group == "env" and isinstance(layout := settings.get("layout"), str):
        return {"open": "gridworld"}.get(layout, layout)
    if group != "algo":
        return builder.removesuffix("_network")
    name = builder.removeprefix("make_")
    if settings.get("recurrent") is False:
        return {"drqn": "dqn", "hdrqn": "hdqn"}.get(name, name)
    return _text(settings.get("version", name))


def _text(value: Any) -> str:
    """A setting as it stands in YAML."""
    if value is None:
        return NONE
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def _natural(label: str) -> list[tuple[int, float, str]]:
    """Sort key that orders numbers in a string by value."""
    parts = re.split(r"(\d+(?:\.\d+)?)", label)
    return [(1, float(part), "") if index % 2 else (0, 0.0, part) for index, part in enumerate(parts)]
