"""Workers as actors of a Ray cluster: one that runs, or one of this machine that begins and ends with the training."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from typing import Any

from torch import Tensor

from hdrqn_torchrl.runs.workers.handles import WorkerError, WorkerLost
from hdrqn_torchrl.runs.workers.worker import Worker


class RayWorkers:
    """Starts workers in a Ray cluster, one core for each.

    Args:
        make: makes a worker when it is called with its number and seed: ``partial(Worker, make, steps=8)``.
        workers: number of cores of a cluster that is started here.
        address: of a running cluster, or ``"auto"`` for the one of this machine; ``None``: one is started on 127.0.0.1,
            without dashboard.

    Raises:
        ImportError: if Ray is missing.
        ConnectionError: if there is no cluster at the address.
    """

    def __init__(self, make: partial[Worker], *, workers: int, address: str | None = None) -> None:
        ray = _ray()
        self._began = not ray.is_initialized()
        if self._began:
            if address is None:
                os.environ.setdefault("RAY_AUTH_MODE", "disabled")  # else a token is written to the home folder
                os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
                where: dict[str, Any] = {"_node_ip_address": "127.0.0.1", "num_cpus": workers}
            else:
                where = {"address": address}
            ray.init(include_dashboard=False, configure_logging=False, log_to_driver=False, **where)
        self._actor = ray.remote(num_cpus=1, max_restarts=0)(Worker)
        self.make = make

    def start(self, index: int, *, seed: int) -> RayWorker:
        """See :class:`WorkerPlace`."""
        return RayWorker(self._actor.remote(*self.make.args, index, seed=seed, **self.make.keywords))

    def share(self, weights: Mapping[str, Tensor]) -> Any:
        """A reference to the weights in Ray's object store, where each machine gets them once."""
        return _ray().put(dict(weights))

    def close(self) -> None:
        """Ends the cluster, or the connection to it, if it began here."""
        if self._began and _ray().is_initialized():
            _ray().shutdown()


class RayWorker:
    """A worker in a Ray actor."""

    def __init__(self, actor: Any) -> None:
        self.actor, self._answer = actor, None

    def send(self, method: str, *args: Any) -> None:
        """See :class:`WorkerHandle`."""
        self._answer = getattr(self.actor, method).remote(*args)

    def receive(self, seconds: float) -> Any:
        """See :class:`WorkerHandle`."""
        errors = _ray().exceptions
        try:
            return _ray().get(self._answer, timeout=seconds)
        except errors.GetTimeoutError as error:
            raise WorkerLost(f"did not answer for {seconds:g} seconds") from error
        except errors.RayTaskError as error:
            raise WorkerError(str(error)) from error
        except errors.RayError as error:
            if "creation task" in str(error):  # it never came to be
                raise WorkerError(str(error)) from error
            raise WorkerLost(f"ended ({type(error).__name__})") from error

    def stop(self) -> None:
        """See :class:`WorkerHandle`."""
        _ray().kill(self.actor)


def _ray() -> Any:
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise ImportError("collector=ray needs Ray; install it: pip install 'hdrqn_torchrl[ray]'.") from error
    return ray
