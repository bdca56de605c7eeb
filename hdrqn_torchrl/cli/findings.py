"""The runs that a report is made from, and what each of them stands for in a study."""

from __future__ import annotations

import lzma
import tarfile
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hdrqn_torchrl.analysis.archives import unpack
from hdrqn_torchrl.analysis.grouping import Entry
from hdrqn_torchrl.cli.entries import note, read_entries
from hdrqn_torchrl.cli.studies import Job, is_run_of, jobs_of
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import RunFileError, read_json
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.comparing import NOT_LEARNED_FROM, flat


@dataclass(frozen=True)
class Found:
    """A run."""

    entry: Entry
    settings: dict[str, Any]
    """By full name, without those that do not affect learning."""
    origin: dict[str, Any]
    """``run.json``"""


Runs = list[tuple[Job, Found]]
"""Runs of a study and what each stands for in it; a run may stand for something in several studies."""


def read_runs(patterns: list[str], stack: ExitStack) -> list[Found]:
    """All runs below folders and in archives; archives are unpacked for as long as ``stack`` lasts."""
    places = []
    for pattern in patterns:
        if pattern.endswith(".tar.xz"):
            unpacked = stack.enter_context(tempfile.TemporaryDirectory())
            try:
                unpack(Path(pattern), Path(unpacked))
            except (OSError, EOFError, ValueError, lzma.LZMAError, tarfile.TarError) as error:
                raise SettingsError(f"runs must name folders or readable archives, got {pattern}: {error}.") from error
            pattern = unpacked
        places.append(pattern)
    found = []
    for entry in read_entries(places):
        if entry.settings and (entry.run.folder / layout.ORIGIN).exists():
            try:
                origin = read_json(entry.run.folder / layout.ORIGIN)
            except RunFileError as error:
                note(f"warning: {entry.run.folder} is left out: {error}")
                continue
            found.append(
                Found(entry, flat(entry.settings, without=NOT_LEARNED_FROM), origin if isinstance(origin, dict) else {})
            )
    return found


def runs_of_jobs(experiment: str, size: str, runs: list[Found]) -> tuple[Runs, int]:
    """The run of each job of an experiment that has one, and the number of jobs that have none.

    Of several runs of one job the finished one that went furthest counts.
    """
    found, missing = [], 0
    for job in jobs_of(experiment if size == "small" else f"paper/{experiment}"):
        same = [run for run in runs if is_run_of(job, run.settings)]
        if same:
            furthest = max(same, key=lambda run: (bool(run.entry.run.summary), run.entry.run.metrics["frames"][-1]))
            found.append((job, furthest))
        else:
            missing += 1
    return found, missing
