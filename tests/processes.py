"""Processes that start fast: they are forked from one that has only imported everything."""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import runpy
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

ROOT = Path(__file__).parent.parent
os.environ["RL_LOGGING_LEVEL"], os.environ["OMP_NUM_THREADS"] = "WARNING", "1"
FORK = multiprocessing.get_context("forkserver")
FORK.set_forkserver_preload(["helpers", "processes", "hdrqn_torchrl.cli.train", "hdrqn_torchrl.cli.training"])


def start(target, *arguments) -> BaseProcess:
    """Runs ``target(*arguments)`` in a new process."""
    process = FORK.Process(target=_run, args=(target, arguments), daemon=True)
    process.start()
    return process


def _run(target, arguments) -> None:
    multiprocessing.set_start_method("fork", force=True)  # else a killed process leaks TorchRL's semaphores
    target(*arguments)


def start_script(folder: Path, *arguments: str, prepare: Callable[[], None] | None = None) -> BaseProcess:
    """``python train.py *arguments`` in ``folder``, where ``stdout.txt`` and ``stderr.txt`` get its output.

    Args:
        folder: working directory.
        arguments: of the script.
        prepare: called in the process before the script.
    """
    return start(_run_script, folder, arguments, prepare)


def run_script(folder: Path, *arguments: str, prepare: Callable[[], None] | None = None) -> tuple[int, str, str]:
    """Waits for :func:`start_script`; returns exit code and output."""
    process = start_script(folder, *arguments, prepare=prepare)
    process.join(120)
    assert process.exitcode is not None, "it hangs"
    return process.exitcode, (folder / "stdout.txt").read_text(), (folder / "stderr.txt").read_text()


def _run_script(folder: Path, arguments: tuple[str, ...], prepare: Callable[[], None] | None) -> None:
    os.chdir(folder)
    for name, descriptor in (("stdout.txt", 1), ("stderr.txt", 2)):
        os.dup2(os.open(name, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o644), descriptor)
    multiprocessing.process._parent_process = None  # type: ignore[attr-defined]  # it is no worker of a sweep
    if prepare is not None:
        prepare()
    sys.argv = ["train.py", *arguments]
    runpy.run_path(str(ROOT / "train.py"), run_name="__main__")


def limit_file_size(size: int) -> None:
    """Makes the kernel refuse writes beyond ``size`` bytes of a file, like a full disk."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))


@contextmanager
def limited_file_size(size: int) -> Iterator[None]:
    """:func:`limit_file_size` inside a ``with`` block."""
    before, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    limit_file_size(size)
    try:
        yield
    finally:
        limit_file_size(before)


class Diary:
    """Notes of a process that may be killed at any moment; each is one line, written at once."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def note(self, event: str, **values: float) -> None:
        """Adds a line."""
        line = json.dumps({"event": event, "time": time.monotonic(), **values}) + "\n"
        descriptor = os.open(self.path, os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o644)
        os.write(descriptor, line.encode())
        os.close(descriptor)

    def read(self) -> list[dict]:
        """All notes."""
        return [json.loads(line) for line in self.path.read_text().splitlines()] if self.path.exists() else []

    def size(self) -> int:
        """Grows with every note."""
        return self.path.stat().st_size if self.path.exists() else 0


def leftovers(folder: Path) -> int:
    """Number of bytes in a run folder that belong to no checkpoint or log."""
    stray = [*folder.glob("checkpoints/.*"), *folder.glob("*.partial")]
    files = [file for path in stray for file in (path, *path.rglob("*")) if file.is_file()]
    return sum(file.stat().st_size for file in files) + len(stray)  # an empty file or folder counts, too


def train_with_diary(folder: Path, name: str, seed: int, settings: dict) -> None:
    """What train.py does in an empty run folder or that of a killed process, with a training from helpers.py."""
    from helpers import make_training, seed_everything

    from hdrqn_torchrl.cli import train, training
    from hdrqn_torchrl.cli.resuming import Plan

    diary, orphans, began = Diary(folder / "diary.jsonl"), leftovers(folder), time.monotonic()

    def build_run(run, stop):
        own_seed = 99 if any((folder / "checkpoints").glob("checkpoint-*")) else seed
        seed_everything(own_seed)
        trainer = make_training(folder, name, seed=own_seed, **settings)
        learner = next(iter(trainer.algorithm.learners.values()))
        store, save = learner.store, trainer.checkpoints.save

        def noted_store(batch):
            diary.note("batch", frames=trainer.frames)
            store(batch)

        def noted_save(*args, step, **kwargs):
            path = save(*args, step=step, **kwargs)
            diary.note("saved", frames=step)
            return path

        learner.store, trainer.checkpoints.save = noted_store, noted_save
        return trainer, None, {}

    def noted_begin(run, stop):
        trainer, *rest = begin(run, stop)
        seconds = time.monotonic() - began
        diary.note("start", frames=trainer.frames, orphans=orphans, left=leftovers(folder), seconds=seconds)
        return trainer, *rest

    begin, training.build_run, training.begin = training.begin, build_run, noted_begin
    training.record, training.write_summary = lambda run: None, lambda *_: {"return_mean": 0.0}
    config: Any = SimpleNamespace(
        threads=1,
        init_from=None,
        allowed_targets=[],
        resume_override=False,
        checkpoint=SimpleNamespace(interval_frames=settings["checkpoint_frames"]),
        log_frames=96,  # of helpers.py
    )
    train.train(Plan(folder, config, {}, resumed=True))
    diary.note("done")
