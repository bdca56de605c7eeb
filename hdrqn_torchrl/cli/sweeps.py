"""Sweeps: a failed job does not end the others, what is unfinished is listed at the end, Ctrl-C reaches every worker.

Hydra calls :class:`Sweep` around the jobs of ``python train.py -m ...`` (``hydra.callbacks`` in conf/config.yaml). They
run in this process, with ``sweep=parallel`` in worker processes that take one job after the other, or elsewhere
(:mod:`~hdrqn_torchrl.cli.launchers`).
"""

from __future__ import annotations

import atexit
import contextlib
import io
import multiprocessing
import os
import signal
import sys
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, open_dict, read_write

from hdrqn_torchrl.cli.command_line import check_folder
from hdrqn_torchrl.cli.ledger import DONE, STARTED, ledger_of, read_ledger, report, unfinished, write_note
from hdrqn_torchrl.runs.settings.arguments import SettingsError

SIGNALS = (signal.SIGINT, signal.SIGTERM)
POLL_SECONDS = 1.0
PATIENCE_SECONDS = 120.0
"""How long a job waits for another process in its folder: one of a killed sweep may still be saving itself."""
JOBS_ON_A_GPU = 4
"""Jobs that ``sweep=parallel`` runs at once on a GPU unless told how many: each has a context of its own there."""
NOT_STARTED = "not started, as the sweep was stopped"


class JobStopped(RuntimeError):
    """A job in a worker process was stopped on request. Unlike ``SystemExit`` this leaves the other workers alive."""


def share_gpu(config: DictConfig) -> None:
    """Lets fewer jobs run at once than there are cores, if they run on a GPU and nobody said how many."""
    if config.hydra.launcher.get("n_jobs") != -1 or config.device == "cpu":
        return
    import torch

    if torch.cuda.is_available():
        with read_write(config.hydra), open_dict(config.hydra):
            config.hydra.launcher.n_jobs = min(JOBS_ON_A_GPU, os.cpu_count() or 1)


class Sweep(Callback):
    """Notes in ``jobs.jsonl`` of the sweep's folder when a job starts and how it ends."""

    def __init__(self) -> None:
        self.ledger: Path | None = None  # None: not a sweep

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Before the folder of a single training is made."""
        HydraConfig.instance().set_config(config)  # which the folder's name refers to
        _check_folder(config.hydra.run.dir, "hydra.run.dir (in output_root, unless it is given)")

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """In the main process, before all jobs."""
        _check_folder(config.hydra.sweep.dir, "hydra.sweep.dir (in output_root, unless it is given)")
        ledger = ledger_of(config.hydra)
        self.ledger = ledger.absolute()  # jobs may have other working directories
        self.ledger.unlink(missing_ok=True)
        share_gpu(config)
        atexit.register(report, ledger)  # Hydra leaves out on_multirun_end when a sweep ends with an exception
        if not config.hydra.launcher._target_.endswith(".BasicLauncher"):
            for number in SIGNALS:
                signal.signal(number, _stop.pass_on)

    def on_job_start(self, config: DictConfig, **_: Any) -> None:
        """In the process of the job."""
        if self.ledger is not None:
            if in_worker():
                _stop.watch_job()
                os.environ["TTY_COMPATIBLE"] = "0"  # progress bars of several processes would overwrite each other
            self._note(config, STARTED)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **_: Any) -> None:
        """In the process of the job; left out if it was killed, or stopped in the main process."""
        if self.ledger is None:
            return
        _stop.in_job = False  # before the note: an orphan has none to make
        try:
            with contextlib.redirect_stderr(io.StringIO()):  # a failed job's result prints its overrides and raises
                _ = job_return.return_value
        except Exception as error:
            reason = one_line(error)
            sys.stderr.write(f"job {config.hydra.job.num}: {reason}\n")
            self._note(config, reason)
            _fail(job_return, config, reason)
        else:
            self._note(config, DONE)

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """In the main process, after all jobs."""
        if _stop.number is not None:
            sys.exit(128 + _stop.number)
        if self.ledger is not None and unfinished(read_ledger(self.ledger)):
            sys.exit(1)

    def _note(self, config: DictConfig, state: str) -> None:
        assert self.ledger is not None
        if not _stop.orphaned:  # else the same command may have been started again: the ledger belongs to that sweep
            write_note(self.ledger, config.hydra, state)


def _check_folder(folder: str, key: str) -> None:
    try:
        check_folder(Path(folder), key)
    except SettingsError as error:
        sys.exit(f"error: {error}")  # Hydra goes on after exceptions of callbacks


def note_folder(folder: Path) -> None:
    """Notes where this process's job of a sweep is done, as it may go on with a run of an earlier sweep."""
    if is_sweep():
        write_note(ledger_of(HydraConfig.get()), HydraConfig.get(), STARTED, folder)


def note_lost(config: DictConfig, error: Exception) -> JobReturn:
    """The result of a job that left none, which is noted unless it could tell itself how it ended."""
    ledger, reason = ledger_of(config.hydra), one_line(error)
    states = {note["job"]: note["state"] for note in read_ledger(ledger)}
    state = states.get(config.hydra.job.num, STARTED)
    if state == STARTED:
        if was_stopped() and config.hydra.job.num not in states:
            reason = NOT_STARTED
        write_note(ledger, config.hydra, reason)
        sys.stderr.write(f"job {config.hydra.job.num}: {reason}\n")
    return _fail(JobReturn(status=JobStatus.FAILED), config, reason)


def _fail(result: JobReturn, config: DictConfig, reason: str) -> JobReturn:
    result.return_value = RuntimeError(reason)  # it can be pickled, whatever the error was
    if config.hydra.sweeper._target_.endswith(".BasicSweeper"):
        result.status = JobStatus.COMPLETED  # that sweeper would raise the first error and show no other
    return result


def one_line(error: Exception) -> str:
    """Kind and first line of an error.

    Examples:
        >>> one_line(KeyError("x"))
        "KeyError: 'x'"
    """
    kind = "" if isinstance(error, JobStopped) else f"{type(error).__name__}: "
    return kind + str(error).partition("\n")[0]


class _Stop:
    """A stop request by signal, in the main process of a parallel sweep or in a worker outside training.

    In training, :class:`~hdrqn_torchrl.runs.interruption.StopRequest` takes the signals and the job saves itself.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.in_job = False
        self.orphaned = False
        self._watching = False
        self.elsewhere = False

    def pass_on(self, number: int, _: FrameType | None) -> None:
        """In the main process, which goes on waiting for its workers; a second signal ends all of them at once."""
        self.number = number
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        print("stopping the jobs of the sweep; once more: without saving them", file=sys.stderr)
        for worker in multiprocessing.active_children():
            if worker.pid is not None:
                os.kill(worker.pid, number)

    def watch_job(self) -> None:
        """In a worker, at the start of a job."""
        for number in SIGNALS:
            signal.signal(number, self._leave_job)
        self.in_job = self.number is None
        if not self._watching:
            self._watching = True
            threading.Thread(target=self._watch_parent, args=(os.getppid(),), daemon=True).start()

    def _watch_parent(self, parent: int) -> None:
        """Ends this worker when the sweep's main process has been killed (kill -9), after its job has saved itself."""
        while os.getppid() == parent:
            time.sleep(POLL_SECONDS)
        self.orphaned = True
        os.kill(os.getpid(), signal.SIGTERM)
        while self.in_job:
            time.sleep(0.1)
        os._exit(128 + signal.SIGTERM)

    def _leave_job(self, number: int, _: FrameType | None) -> None:
        """An idle worker only takes note: if one dies, joblib kills all others."""
        from hdrqn_torchrl.runs.interruption import Interrupted

        self.number = number
        if self.in_job:
            self.in_job = False
            raise Interrupted(number)


_stop = _Stop()


def is_sweep() -> bool:
    """Whether this process does jobs of ``train.py -m``."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def in_worker() -> bool:
    """Whether this process belongs to a parallel launcher."""
    return _stop.elsewhere or multiprocessing.parent_process() is not None


def begin_elsewhere() -> None:
    """This process does one job, as a launcher's worker."""
    _stop.elsewhere = True


def was_stopped() -> bool:
    """Whether this sweep, or the job of this process, was asked to stop."""
    return _stop.number is not None


def refuse_if_stopped() -> None:
    """At the start of a job: raises :class:`JobStopped` if this worker was told to stop."""
    if in_worker() and _stop.number is not None:
        raise JobStopped(NOT_STARTED)


def end_stopped_job(exit_code: int) -> NoReturn:
    """At the end of a job that was stopped by a signal: ends the program, or in a worker this job and those to come.

    Args:
        exit_code: 130 or 143.
    """
    if not in_worker():
        sys.exit(exit_code)
    _stop.number, _stop.in_job = exit_code - 128, False
    raise JobStopped(f"stopped by {signal.Signals(_stop.number).name}")
