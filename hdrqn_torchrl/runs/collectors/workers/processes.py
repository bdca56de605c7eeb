"""Workers in processes of this machine, behind pipes: nothing listens anywhere."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import traceback
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from typing import Any

from hdrqn_torchrl.runs.collectors.workers.handles import WorkerError, WorkerLost
from hdrqn_torchrl.runs.collectors.workers.worker import Worker


class ProcessWorkers:
    """Starts workers in processes of this machine.

    Args:
        make: makes a worker when it is called with its number and seed: ``partial(Worker, make, steps=8)``.
    """

    def __init__(self, make: partial[Worker]) -> None:
        self.make = make

    def start(self, index: int, *, seed: int) -> ProcessWorker:
        """See :class:`WorkerPlace`."""
        return ProcessWorker(partial(self.make, index, seed=seed))

    def share(self, weights: bytes) -> bytes:
        """The weights; a pipe copies them."""
        return weights

    def close(self) -> None:
        """Nothing is left when the workers have ended."""


class ProcessWorker:
    """A worker in a process, which ends with this one, however this one ends: its pipe is then closed."""

    def __init__(self, make: partial[Worker]) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, make), daemon=True)
        self.process.start()
        theirs.close()
        self._kill = Finalize(None, self.process.kill, exitpriority=10)  # else Python waits for it when it ends

    def send(self, method: str, *args: Any) -> None:
        """See :class:`WorkerHandle`."""
        try:
            _put(self._pipe, (method, args))
        except OSError as error:
            raise WorkerLost(self._how()) from error

    def receive(self, seconds: float) -> Any:
        """See :class:`WorkerHandle`."""
        try:
            if not self._pipe.poll(seconds):
                raise WorkerLost(f"did not answer for {seconds:g} seconds")
            went_well, result = _get(self._pipe)
        except (EOFError, OSError) as error:
            raise WorkerLost(self._how()) from error
        if not went_well:
            raise WorkerError(result)
        return result

    def stop(self) -> None:
        """See :class:`WorkerHandle`."""
        self._pipe.close()
        self._kill()
        self.process.join()
        self.process.close()

    def _how(self) -> str:
        self.process.join(1.0)
        code = self.process.exitcode
        return f"ended by {signal.Signals(-code).name}" if code and code < 0 else f"ended with exit code {code}"


def _put(pipe: Connection, message: Any) -> None:
    """Sends a copy. ``Connection.send`` would share the memory of tensors, which the learner changes in place."""
    pipe.send_bytes(pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL))


def _get(pipe: Connection) -> Any:
    return pickle.loads(pipe.recv_bytes())


def _serve(pipe: Connection, make: partial[Worker]) -> None:
    """Answers until the other side is gone."""
    for number in (signal.SIGINT, signal.SIGTERM):  # of the terminal, of Slurm: they reach all processes of a job, and
        signal.signal(number, signal.SIG_IGN)  # the first saves what the workers have begun
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    worker: Worker | None = None
    while True:
        try:
            method, args = _get(pipe)
        except (EOFError, OSError):
            return
        try:
            worker = make() if worker is None else worker
            answer = (True, getattr(worker, method)(*args))
        except Exception:  # whatever it is, the learner tells it
            answer = (False, traceback.format_exc())
        try:
            _put(pipe, answer)
        except OSError:
            return
