"""A training whose workers are killed, once or twenty times, checked from what the worlds themselves showed."""

from __future__ import annotations

import os
import signal
from functools import partial
from importlib.util import find_spec

import pytest
import torch
from stamped_worlds import AGENTS, EPISODE, StampedWorlds, make_part
from world_logs import check_options, check_sequences, options_by_hand

from hdrqn_torchrl.runs.collectors.workers import ProcessWorkers, Worker, WorkersCollector

WORLDS, WORKERS, ROUNDS = 8, 2, 110


def place_of(kind, make):
    if kind == "processes":
        return ProcessWorkers(make)
    from hdrqn_torchrl.runs.collectors.workers.ray_workers import RayWorkers

    return RayWorkers(make, workers=WORKERS)


def process_of(kind, worker) -> int:
    """Its number."""
    if kind == "processes":
        return worker.process.pid
    import ray

    return ray.get(worker.actor.__ray_call__.remote(lambda _: os.getpid()))


NEEDS_RAY = pytest.mark.skipif(find_spec("ray") is None, reason="needs Ray")
KINDS = {"processes": (), "ray": (NEEDS_RAY,)}


@pytest.mark.parametrize(
    ("agent", "kind", "kills"),
    [
        ("v2", "processes", 1),
        pytest.param("v3", "ray", 1, marks=NEEDS_RAY),
        *(
            pytest.param(agent, kind, 20, marks=[pytest.mark.slow, *marks])
            for agent in ("v2", "v3")
            for kind, marks in KINDS.items()
        ),
    ],
)
def test_each_kill_costs_only_the_episodes_in_progress(agent, kind, kills):
    torch.manual_seed(0)
    algorithm = AGENTS[agent](StampedWorlds(WORLDS, seed=0))
    make = partial(Worker, partial(make_part, agent, WORLDS // WORKERS), steps=8, all_worlds=WORLDS, threads=1)
    collector = WorkersCollector(
        place_of(kind, make), algorithm.transform(StampedWorlds(WORLDS, seed=0)), algorithm.policy, workers=WORKERS,
        total_frames=10**9, sync=False,
    )  # fmt: skip
    seen, batches, killed = [], iter(collector), set()
    for index in range(ROUNDS):
        seen.append(next(batches).clone())
        algorithm.observe(seen[-1])
        for learner in algorithm.learners.values():
            if learner.updates_due():
                learner.learn()
        collector.update_policy_weights_()
        if index % 5 == 1:
            pid = process_of(kind, collector._workers[index // 5 % WORKERS])
        if index % 5 == 2 and len(killed) < kills:  # it is collecting
            os.kill(pid, signal.SIGKILL)
            killed.add(pid)
    assert collector.metrics()["collector/lost_workers"] == len(killed) == kills
    assert collector.metrics()["collector/lost_episodes"] == kills * WORLDS // WORKERS
    collector.shutdown()
    whole = torch.cat(seen, 1)
    assert whole.numel() == ROUNDS * WORLDS * 8  # no row is missing
    sequences = check_sequences(algorithm)
    options = check_options(algorithm, seen) if agent == "v2" else len(options_by_hand(seen))
    ended, cut = episodes_of(whole)
    print(f"{agent}, {kind}: {sequences} sequences, {options} options, {ended} episodes whole, {cut} cut")
    assert sequences >= 300 and options >= 1_000
    assert cut <= kills * WORLDS // WORKERS


def episodes_of(whole) -> tuple[int, int]:
    """Episodes that were seen to their end, and those that another one followed before; the last of a row is open."""
    ended = cut = 0
    for row in whole["observation"].unbind(0):
        stamps, lengths = torch.unique_consecutive(row[:, :3], dim=0, return_counts=True)
        assert len(stamps) == len(stamps.unique(dim=0)), "an episode goes on after another one"
        ended += int((lengths[:-1] == EPISODE).sum())
        cut += int((lengths[:-1] < EPISODE).sum())
    return ended, cut
