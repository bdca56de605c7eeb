"""Workers in a Ray cluster of this machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from programs import ROOT, TINY, TINY_HDRQN, wait_until
from stamped_worlds import AGENTS, StampedWorlds, make_failing_part, make_part

from hdrqn_torchrl.runs.collectors.workers import PlaceLost, Worker, WorkerError, WorkersCollector

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
    from hdrqn_torchrl.runs.collectors.workers.ray_workers import RayWorkers

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
    from hdrqn_torchrl.runs.collectors.workers.ray_workers import RayWorkers

    place = RayWorkers(partial(Worker, make_failing_part, steps=8), workers=1)
    with pytest.raises(WorkerError, match="no such world"):
        next(iter(collector_at(place)))


def test_a_cluster_that_has_gone_ends_the_collection_and_the_state_can_be_saved(cluster):
    """The last test of this cluster."""
    import ray

    collector = collector_at(cluster[0])
    batches = iter(collector)
    next(batches)
    (server,) = ray._private.worker._global_node.all_processes["gcs_server"]
    server.process.kill()
    with pytest.raises(PlaceLost, match=r"the Ray cluster at 127\.0\.0\.1:\d+ must answer until the end, got nothing"):
        for _ in range(10**6):
            next(batches)
    collector.give_up(collector.frames)
    assert collector.state_dict()["workers"] == [None, None]


def training_whose_cluster_goes(folder, killed):
    """What a training tells when a process of its cluster is killed, and the frames of its newest checkpoint."""
    long = ["collector=ray", "hydra.run.dir=run", "total_frames=40000", "evaluation.ceilings=false"]
    long += ["checkpoint.interval_frames=1000"]
    command = [sys.executable, str(ROOT / "train.py"), "algo=hdqn", "logger=csv", *TINY, *TINY_HDRQN, *long]
    with (folder / "told.txt").open("w") as told:
        process = subprocess.Popen(command, cwd=folder, stderr=told)
    metrics = folder / "run/metrics.csv"
    try:
        wait_until(lambda: process.poll() is not None or (metrics.exists() and "\n2" in metrics.read_text()), 600)
        os.kill(descendant(process.pid, killed), signal.SIGKILL)
        assert process.wait(120) == 1
    finally:
        process.kill()
    newest = max(int(path.name.rpartition("-")[2]) for path in folder.glob("run/checkpoints/checkpoint-*"))
    return (folder / "told.txt").read_text(), newest


@pytest.mark.slow
def test_a_training_whose_cluster_goes_saves_all_that_was_learned(tmp_path):
    told, newest = training_whose_cluster_goes(tmp_path, "gcs_server")
    assert "must answer until the end, got nothing from 127.0.0.1:" in told
    assert "; start it again (after frame 2" in told
    assert "when that is fixed, `" in told and f"train.py resume={tmp_path}/run` goes on" in told
    logged = int((tmp_path / "run/metrics.csv").read_text().splitlines()[-1].partition(",")[0])
    assert 0 <= newest - logged < 500  # a row comes every 500 frames


@pytest.mark.slow
def test_ray_ends_a_training_whose_own_node_is_lost_which_keeps_its_last_checkpoint(tmp_path):
    told, newest = training_whose_cluster_goes(tmp_path, "raylet/raylet")
    assert "Raylet is terminated" in told
    assert newest >= 1000


def descendant(pid: int, program: str) -> int:
    """The process that runs a program, among those that another one has started."""
    rows = subprocess.run(["ps", "-ewwo", "ppid=,pid=,args="], capture_output=True, text=True, check=True).stdout
    for parent, child, *words in (line.split() for line in rows.splitlines()):
        if int(parent) == pid and words and words[0].endswith(program):
            return int(child)
    raise AssertionError(rows)
