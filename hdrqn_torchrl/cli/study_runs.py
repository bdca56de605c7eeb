"""The runs that a report is made from, and what each of them stands for in a study."""

from __future__ import annotations

import lzma
import tarfile
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hdrqn_torchrl.analysis.archives import keep, unpack
from hdrqn_torchrl.analysis.grouping import Entry
from hdrqn_torchrl.analysis.results import find_runs
from hdrqn_torchrl.cli.entries import note, read_entries, shortened
from hdrqn_torchrl.cli.studies import STUDIES, Job, is_run_of, jobs_of
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import RunFileError, read_json
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.comparing import NOT_LEARNED_FROM, flat

ARCHIVE = ".tar.xz"
"""Ending of archives."""


@dataclass(frozen=True)
class Found:
    """A run."""

    entry: Entry
    settings: dict[str, Any]
    """By full name, without those that do not affect learning."""
    origin: dict[str, Any]
    """``run.json``"""
    place: int = 0
    """Which of the places that were named it lies in, the last one if several."""
    name: str = ""
    """Its folder, or its archive and the folder in it."""

    @property
    def overridden(self) -> set[str]:
        """Names of the settings that its command line gave values to."""
        words = self.origin.get("overrides")
        return {str(word).lstrip("+").partition("=")[0] for word in (words if isinstance(words, list) else [])}


Runs = list[tuple[Job, Found]]
"""Runs of a study and what each stands for in it; a run may stand for something in several studies."""


@dataclass(frozen=True)
class Matched:
    """What there is of a study."""

    runs: Runs
    """The run of each job that has one."""
    missing: int
    """Jobs that have none."""
    passed_over: list[Found]
    """Others with the settings of a job that has a run already."""


def read_runs(patterns: list[str], stack: ExitStack) -> list[Found]:
    """All runs below folders and in archives; archives are unpacked for as long as ``stack`` lasts."""
    places, unpacked_from = [], {}
    for pattern in patterns:
        if pattern.endswith(ARCHIVE):
            unpacked = stack.enter_context(tempfile.TemporaryDirectory())
            try:
                unpack(Path(pattern), Path(unpacked))
            except (OSError, EOFError, ValueError, lzma.LZMAError, tarfile.TarError) as error:
                raise SettingsError(f"runs must name folders or readable archives, got {pattern}: {error}.") from error
            unpacked_from[Path(unpacked)] = pattern
            pattern = unpacked
        places.append(pattern)
    lies_in = {folder: number for number, place in enumerate(places) for folder in find_runs([place])}
    found = []
    for entry in read_entries(places):
        if entry.settings and (entry.run.folder / layout.ORIGIN).exists():
            try:
                origin = read_json(entry.run.folder / layout.ORIGIN)
            except RunFileError as error:
                note(f"warning: {entry.run.folder} is left out: {error}")
                continue
            origin = origin if isinstance(origin, dict) else {}
            settings = flat(entry.settings, without=NOT_LEARNED_FROM)
            name = _name_of(entry.run.folder, unpacked_from)
            found.append(Found(entry, settings, origin, lies_in[entry.run.folder], name))
    return found


def _name_of(folder: Path, unpacked_from: dict[Path, str]) -> str:
    for place, archive in unpacked_from.items():
        if folder.is_relative_to(place):
            return f"{archive}: {folder.relative_to(place)}"
    return str(folder)


def runs_of_jobs(experiment: str, size: str, runs: list[Found]) -> Matched:
    """The run of each job of an experiment.

    Of several runs of one job the finished one that went furthest counts; of those that went as far, the one in the
    place that was named last.
    """

    def progress(run: Found) -> tuple[bool, float, int]:
        return bool(run.entry.run.summary), run.entry.run.metrics["frames"][-1], run.place

    found: Runs = []
    missing, passed_over = 0, []
    for job in jobs_of(experiment if size == "small" else f"paper/{experiment}"):
        same = sorted((run for run in runs if is_run_of(job, run.settings, run.overridden)), key=progress)
        if same:
            found.append((job, same[-1]))
            passed_over += same[:-1]
        else:
            missing += 1
    return Matched(found, missing, passed_over)


def check_archive(path: str, patterns: list[str]) -> None:
    """Refuses one whose runs would be lost.

    Args:
        path: of the archive to write.
        patterns: where runs are read from.

    Raises:
        SettingsError: if it is no archive, or there and not read.
    """
    if not path.endswith(ARCHIVE):
        raise SettingsError(f"keep must end in {ARCHIVE}, got {path!r}; for example keep=runs{ARCHIVE}.")
    if Path(path).exists() and Path(path).resolve() not in {Path(each).resolve() for each in patterns}:
        named = ",".join([path, *patterns])
        raise SettingsError(
            f"keep must be a new file or an archive that runs names, too, or its runs would be lost, got {path!r}, "
            f"which is there; give 'runs=[{named}]' or another name."
        )


def keep_runs(runs: list[Found], archive: Path) -> None:
    """Puts the runs of all studies into an archive, and names those that are of none now, or replaced by others."""
    used = {
        run.entry.run.folder: run
        for study in STUDIES
        for size in study.sizes
        for _, run in runs_of_jobs(study.name, size, runs).runs
    }
    if others := [run.name for run in runs if run.entry.run.folder not in used]:
        note(f"note: not in {archive} ({len(others)} runs that no study has now): {shortened(others)}")
    ordered = sorted(used.values(), key=lambda run: sorted(map(str, run.settings.items())))
    keep([run.entry.run.folder for run in ordered], archive)
