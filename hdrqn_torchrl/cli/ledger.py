"""The ledger of a sweep, ``jobs.jsonl``: a line when a job starts and one when it ends, and the list of what is left.

Jobs write to it from many processes and machines; it is read while they do.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from hydra.conf import HydraConf

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

STARTED, DONE = "started", "done"
REMEDY = "the same command with resume=auto goes on, with jobs that were not started, too"
Note = dict[str, Any]


def write_note(ledger: Path, hydra: HydraConf, state: str, folder: Path | None = None) -> None:
    """Adds a line about a job.

    Args:
        ledger: the file.
        hydra: what Hydra knows of the job.
        state: :data:`STARTED`, :data:`DONE`, or why it ended.
        folder: of its run; by default what the last note about the job says, or else what Hydra made for it.
    """
    job, cwd = hydra.job.num, hydra.runtime.cwd
    if folder is None:
        known = [note["folder"] for note in read_ledger(ledger) if note["job"] == job]
        folder = Path(known[0]) if known else Path(hydra.sweep.dir, hydra.sweep.subdir)
    note = {
        "job": job,
        "folder": as_told(Path(cwd, folder), Path(cwd)),
        "overrides": list(hydra.overrides.task),
        "state": state,
    }
    with ledger.open("a+b") as file, _alone(file):
        file.seek(max(file.seek(0, os.SEEK_END) - 1, 0))
        torn = file.read() not in (b"", b"\n")  # by a full disk, or a process that was killed
        file.write(b"\n" * torn + json.dumps(note).encode() + b"\n")  # in one piece: other processes write here, too
        file.flush()


def as_told(folder: Path, cwd: Path) -> str:
    """A folder as its reader names it: from the working directory if it is below it.

    Examples:
        >>> as_told(Path("/project/outputs/a"), Path("/project")), as_told(Path("/data/a"), Path("/project"))
        ('outputs/a', '/data/a')
    """
    whole = Path(os.path.normpath(folder))
    return str(whole.relative_to(cwd) if whole.is_relative_to(cwd) else whole)


def ledger_of(hydra: HydraConf) -> Path:
    """Where the notes of a sweep are."""
    return Path(hydra.sweep.dir) / "jobs.jsonl"


def was_started(hydra: HydraConf, job: int) -> bool:
    """Whether this sweep began a job before."""
    return any(note["job"] == job for note in read_ledger(ledger_of(hydra)))


def read_ledger(ledger: Path) -> list[Note]:
    """The last note about each job that was started, in the order of the jobs."""
    lines = ledger.read_bytes().splitlines() if ledger.exists() else []
    last = {note["job"]: note for line in lines if (note := _read(line))}
    return [last[job] for job in sorted(last)]


def _read(line: bytes) -> Note | None:
    """A note, or ``None`` of a line that was not written to its end."""
    try:
        return json.loads(line)
    except ValueError:
        return None


def unfinished(notes: list[Note]) -> list[Note]:
    """Notes of the jobs that were not done."""
    return [note for note in notes if note["state"] != DONE]


def report(ledger: Path) -> None:
    """Lists the unfinished jobs on stderr, each with the overrides that it does not share with all jobs, if any."""
    notes = read_ledger(ledger)
    shared = set.intersection(*(set(note["overrides"]) for note in notes)) if len(notes) > 1 else set()
    if missing := unfinished(notes):
        print(f"\nunfinished: {len(missing)} of {len(notes)} started jobs in {ledger.parent}", file=sys.stderr)
    for note in missing:
        own = " ".join(override for override in note["overrides"] if override not in shared)
        reason = "stopped or killed" if note["state"] == STARTED else note["state"]
        print(f"  {note['folder']} ({own})\n    {reason}", file=sys.stderr)
    if missing:
        print(REMEDY, file=sys.stderr)


@contextlib.contextmanager
def _alone(file: BinaryIO) -> Iterator[None]:
    """Locks a file that processes of other machines write to as well, where the operating system can."""
    if fcntl is not None:
        with contextlib.suppress(OSError):  # not every file system can
            fcntl.lockf(file, fcntl.LOCK_EX)  # closing gives it back
    yield
