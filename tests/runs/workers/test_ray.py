"""Workers in a Ray cluster of this machine."""

from __future__ import annotations

import os
import signal
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from stamped_worlds import AGENTS, StampedWorlds, make_failing_part, make_part

from hdrqn_torchrl.runs.workers import Worker, WorkerError, WorkersCollector

if find_spec("ray") is None:
    pytest.skip("Ray is not installed", allow_module_level=True)
WORLDS = 4


def listeners() -> set[tuple[str, str]]:
    """Addresses and ports on which this machine listens."""
    found = set()
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A":
                found.add(tuple(fields[1].split(":")))
    return found


@pytest.fixture(scope="module")
def cluster():
    from hdrqn_torchrl.runs.workers.ray_workers import RayWorkers

    before = listeners()
    place = RayWorkers(partial(Worker, partial(make_part, "v3", 2), steps=8, all_worlds=WORLDS, threads=1), workers=2)
    yield place, before
    import ray

    place.close()
    assert not ray.is_initialized()


def collector_at(place):
    torch.manual_seed(0)
    algorithm = AGENTS["v3"](StampedWorlds(WORLDS, seed=0))
    env = algorithm.transform(StampedWorlds(WORLDS, seed=0))
    return WorkersCollector(place, env, algorithm.policy, workers=2, total_frames=10**9, sync=False)


def test_a_killed_worker_is_replaced_and_only_loopback_listens(cluster):
    import ray

    place, before = cluster
    collector = collector_at(place)
    batches = iter(collector)
    whole = [next(batches).clone()]
    assert all(address.endswith("0100007F") for address, _ in listeners() - before)
    pid = ray.get(collector._workers[1].actor.__ray_call__.remote(lambda _: os.getpid()))
    os.kill(pid, signal.SIGKILL)
    whole = torch.cat([*whole, *(next(batches).clone() for _ in range(4))], 1)
    assert collector.metrics()["collector/lost_workers"] == 1
    stamps = whole["observation"][..., 0]  # of the worker's seed
    assert len(stamps[0].unique()) == len(stamps[1].unique()) == 1
    assert len(stamps[2].unique_consecutive()) == len(stamps[3].unique_consecutive()) == 2
    for worker in collector._workers:
        worker.stop()


def test_an_error_in_a_worker_is_told(cluster):
    from hdrqn_torchrl.runs.workers.ray_workers import RayWorkers

    place = RayWorkers(partial(Worker, make_failing_part, steps=8), workers=1)
    with pytest.raises(WorkerError, match="no such world"):
        next(iter(collector_at(place)))
