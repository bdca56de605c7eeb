"""What the learner holds of a worker that runs elsewhere."""

from __future__ import annotations

from typing import Any, Protocol


class WorkerLost(RuntimeError):
    """A worker has ended or does not answer; another one can take its place."""


class PlaceLost(WorkerLost):
    """Where workers run has gone, and with it all of them; none can take their place."""


class WorkerError(RuntimeError):
    """A worker's own code has failed, with its traceback; another one would fail alike."""


class WorkerHandle(Protocol):
    """A worker that runs elsewhere. One request at a time: what is sent must be received before the next."""

    def send(self, method: str, *args: Any) -> None:
        """Calls a method of :class:`~hdrqn_torchrl.runs.collectors.workers.Worker`, without waiting.

        Raises:
            WorkerLost: if it has ended.
        """

    def receive(self, seconds: float) -> Any:
        """What the call returned.

        Raises:
            WorkerLost: if it has ended, or does not answer in time.
            WorkerError: if the call failed.
        """

    def stop(self) -> None:
        """Ends it at once."""


class WorkerPlace(Protocol):
    """Where workers run."""

    def start(self, index: int, *, seed: int) -> WorkerHandle:
        """Starts a worker, without waiting until it is ready."""

    def share(self, weights: bytes) -> Any:
        """What is sent to all workers in place of the packed ``weights``."""

    def close(self) -> None:
        """Leaves nothing behind."""
