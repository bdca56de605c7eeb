"""Workers as actors of a Ray cluster."""

from __future__ import annotations

import sys
import time
from functools import partial
from typing import Any

from hdrqn_torchrl.runs.collectors.workers.handles import WorkerError, WorkerLost
from hdrqn_torchrl.runs.collectors.workers.ray_cluster import RayCluster, load_ray
from hdrqn_torchrl.runs.collectors.workers.worker import Worker

_WAIT_SECONDS = 2.0  # between two looks at the cluster


class RayWorkers:
    """Starts workers in a Ray cluster, one core for each.

    Args:
        make: makes a worker when it is called with its number and seed: ``partial(Worker, make, steps=8)``.
        workers: number of cores of a cluster that is started here.
        address: see :class:`~hdrqn_torchrl.runs.collectors.workers.ray_cluster.RayCluster`, as what is raised.
    """

    def __init__(self, make: partial[Worker], *, workers: int, address: str | None = None) -> None:
        self.cluster = RayCluster(cores=workers, address=address, setting="collector.address")
        _warn_of_few_cores(workers)
        self._actor = load_ray().remote(num_cpus=1, max_restarts=0)(make.func)
        self.make = make

    def start(self, index: int, *, seed: int) -> RayWorker:
        """See :class:`WorkerPlace`."""
        self.cluster.check()
        return RayWorker(self._actor.remote(*self.make.args, index, seed=seed, **self.make.keywords), self.cluster)

    def share(self, weights: bytes) -> Any:
        """A reference to the weights in Ray's object store, where each machine gets them once."""
        self.cluster.check()
        return load_ray().put(weights)

    def close(self) -> None:
        """Ends the cluster, or the connection to it, if it began here."""
        self.cluster.close()


def _warn_of_few_cores(workers: int) -> None:
    """A worker without a core waits without a word."""
    cores = int(load_ray().cluster_resources().get("CPU", 0))
    if cores < workers:
        print(
            f"warning: collector.workers should be at most the Ray cluster's number of cores, {cores}, got {workers}; "
            "workers wait until machines join it",
            file=sys.stderr, flush=True,
        )  # fmt: skip


class RayWorker:
    """A worker in a Ray actor."""

    def __init__(self, actor: Any, cluster: RayCluster) -> None:
        self.actor, self.cluster, self._answer = actor, cluster, None

    def send(self, method: str, *args: Any) -> None:
        """See :class:`WorkerHandle`."""
        self._answer = getattr(self.actor, method).remote(*args)

    def receive(self, seconds: float) -> Any:
        """See :class:`WorkerHandle`."""
        ray, until = load_ray(), time.monotonic() + seconds
        self.cluster.check()
        while not ray.wait([self._answer], timeout=min(seconds, _WAIT_SECONDS))[0]:
            self.cluster.check()
            if time.monotonic() >= until:
                raise WorkerLost(f"did not answer for {seconds:g} seconds")
        try:
            return ray.get(self._answer)
        except ray.exceptions.RayTaskError as error:
            raise WorkerError(str(error)) from error
        except ray.exceptions.RayError as error:
            if "creation task" in str(error):  # it never came to be
                raise WorkerError(str(error)) from error
            self.cluster.check()
            raise WorkerLost(f"ended ({type(error).__name__})") from error

    def stop(self) -> None:
        """See :class:`WorkerHandle`."""
        load_ray().kill(self.actor)
