"""Workers as actors of a Ray cluster: one that runs, or one of this machine that begins and ends with the training."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from functools import partial
from typing import Any

from torch import Tensor

from hdrqn_torchrl.runs.workers.handles import WorkerError, WorkerLost
from hdrqn_torchrl.runs.workers.worker import Worker

_LOOPBACK, _OWN_NODE = "127.0.0.1", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_OWN_CLUSTER = {
    _OWN_NODE: "0",  # else Ray takes another address of this machine instead of the loopback one
    "RAY_AUTH_MODE": "disabled",  # else it writes a token to the home folder
    "RAY_USAGE_STATS_ENABLED": "0",
}


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
        RuntimeError: if a cluster started here would listen on other addresses than 127.0.0.1.
    """

    def __init__(self, make: partial[Worker], *, workers: int, address: str | None = None) -> None:
        ray = _ray()
        self._began = not ray.is_initialized()
        if self._began and address is None:
            _start_on_loopback(ray, workers)
        elif self._began:
            ray.init(address=address, configure_logging=False, log_to_driver=False)
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


def _start_on_loopback(ray: Any, workers: int) -> None:
    """A cluster of this machine that nobody else can reach.

    ``ray.init`` would replace 127.0.0.1 by another address of this machine, unless a variable of the environment was
    set when Ray was imported; TorchRL imports it before anyone can set it.
    """
    from ray._private import ray_constants

    before, ray_constants.ENABLE_RAY_CLUSTER = ray_constants.ENABLE_RAY_CLUSTER, False
    environment = dict(os.environ)
    os.environ.update(_OWN_CLUSTER, PYTHONPATH=os.pathsep.join(sys.path))  # workers find what this process finds
    try:
        ray.init(
            _node_ip_address=_LOOPBACK, num_cpus=workers, include_dashboard=False, configure_logging=False,
            log_to_driver=False,
        )  # fmt: skip
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before
        os.environ.clear()
        os.environ.update(environment)
    if (found := {node["NodeManagerAddress"] for node in ray.nodes()}) != {_LOOPBACK}:
        ray.shutdown()
        raise RuntimeError(
            f"Ray must listen on {_LOOPBACK} only, got {sorted(found)} with Ray {ray.__version__}; set {_OWN_NODE}=0 "
            "before Python starts, or start a cluster and give collector.address."
        )


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
