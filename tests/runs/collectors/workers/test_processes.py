"""Workers in processes: real ones, killed, failing and hanging."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from functools import partial

import pytest
import torch
from processes import FORK
from stamped_worlds import (
    AGENTS,
    StampedWorlds,
    make_dying_part,
    make_failing_part,
    make_part,
    make_slow_part,
)

from hdrqn_torchrl.runs.collectors.workers import ProcessWorkers, Worker, WorkerError, WorkerLost, WorkersCollector

WORLDS = 4


def collector_of(make, *, workers=2, **arguments):
    torch.manual_seed(0)
    env = StampedWorlds(WORLDS, seed=0)
    algorithm = AGENTS["v3"](env)
    place = ProcessWorkers(partial(Worker, make, steps=8, all_worlds=WORLDS, threads=1))
    return WorkersCollector(
        place, algorithm.transform(env), algorithm.policy, workers=workers,
        **{"total_frames": 10**9, "sync": False, **arguments},
    )  # fmt: skip


@pytest.fixture
def forked(monkeypatch):
    """Workers start fast: they are forked from a process that has imported everything."""
    monkeypatch.setattr(multiprocessing, "get_context", lambda _: FORK)


@pytest.mark.usefixtures("forked")
def test_a_killed_worker_is_replaced_and_none_is_left_behind(capsys):
    collector = collector_of(partial(make_part, "v3", WORLDS // 2))
    batches = iter(collector)
    before = next(batches).clone()
    collector._workers[1].process.kill()
    later = [next(batches).clone() for _ in range(3)]
    assert collector.metrics()["collector/lost_workers"] == 1
    assert "worker 1 ended by SIGKILL; it is replaced, and new episodes begin" in capsys.readouterr().err
    whole = torch.cat([before, *later], 1)
    assert (whole["observation"][:2, 1:, 0] == whole["observation"][:2, :-1, 0]).all()  # worker 0: the same world
    seeds = whole["observation"][2:, :, 0]
    assert len(seeds.unique()) == 2 and len(seeds.unique_consecutive(dim=1)[0]) == 2
    pids = [worker.process.pid for worker in collector._workers]
    for pid in pids:
        os.kill(pid, signal.SIGTERM)  # as Slurm does, to all processes of a job
    next(batches)
    assert collector.metrics()["collector/lost_workers"] == 1
    collector.shutdown()
    for pid in pids:
        with pytest.raises(OSError):
            os.kill(pid, 0)


def test_what_is_sent_is_a_copy():
    collector = collector_of(partial(make_part, "v3", WORLDS), workers=1)
    batch = next(iter(collector))
    assert not any(parameter.is_shared() for parameter in collector.policy.parameters())
    assert not batch["observation"].is_shared()
    collector.shutdown()


@pytest.mark.usefixtures("forked")
def test_an_error_in_a_worker_ends_the_collection_and_is_told():
    collector = collector_of(make_failing_part, workers=1)
    with pytest.raises(WorkerError, match="RuntimeError: no such world"):
        next(iter(collector))
    collector.shutdown()


@pytest.mark.slow
def test_a_worker_that_ends_again_and_again_ends_the_collection():
    collector = collector_of(make_dying_part, workers=1)
    with pytest.raises(WorkerLost, match="worker 0 ended by SIGKILL, 3 times in a row"):
        next(iter(collector))
    collector.shutdown()


@pytest.mark.slow
def test_a_worker_that_hangs_is_replaced(tmp_path):
    collector = collector_of(partial(make_slow_part, tmp_path), workers=2, patience_seconds=45.0)
    started = time.monotonic()
    assert next(iter(collector)).shape == (WORLDS, 8)
    assert collector.metrics()["collector/lost_workers"] == 2
    assert time.monotonic() - started < 300
    collector.shutdown()
