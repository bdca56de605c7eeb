"""Frames per second of collection by workers: ``python benchmarks/workers.py [--kind ray] [--workers 1 2]``.

The worlds are MiniGrid's, through Gymnasium, where stepping is the bottleneck; the flat v3 agent acts, and nobody
learns. Wall time: it means something on idle cores only. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import time
from functools import partial

import torch
from torchrl import torchrl_logger

from hdrqn_torchrl.algorithms import Algorithm, make_v3
from hdrqn_torchrl.algorithms.presets import V3_LEARNER
from hdrqn_torchrl.envs import make_gym
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.runs.workers import ProcessWorkers, Worker, WorkersCollector


def agent_of(worlds: int, seed: int):  # noqa: ANN201
    """The environment and the agent."""
    env = make_gym(
        "MiniGrid-DoorKey-8x8-v0", worlds, entries=["image", "direction"], codes=(11, 6, 4), max_steps=200, seed=seed
    )
    return env, make_v3(env, compact_network(), levels=1, prediction_steps=0, learner=V3_LEARNER)


def part(worlds: int, index: int, seed: int):  # noqa: ANN201
    """A worker's."""
    env, agent = agent_of(worlds, seed)
    return agent.transform(env), agent.policy


def frames_per_second(kind: str, workers: int, *, worlds: int, steps: int, sync: bool, seconds: float) -> int:
    """Of so many workers, after two rounds."""
    make = partial(Worker, partial(part, worlds // workers), steps=steps, all_worlds=worlds, threads=1)
    if kind == "ray":
        from hdrqn_torchrl.runs.workers.ray_workers import RayWorkers

        place = RayWorkers(make, workers=workers)
    else:
        place = ProcessWorkers(make)
    agent: Algorithm
    env, agent = agent_of(worlds, 0)
    collector = WorkersCollector(
        place, agent.transform(env), agent.policy, workers=workers,
        total_frames=10**12, sync=sync,
    )  # fmt: skip
    batches = iter(collector)
    for _ in range(2):
        next(batches)
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        count += next(batches).numel()
        collector.update_policy_weights_()
    rate = count / (time.perf_counter() - started)
    collector.shutdown()
    return round(rate)


def main() -> None:
    """Times, prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", choices=["processes", "ray"], default="processes")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--worlds", type=int, default=32, help="N, of all workers together")
    parser.add_argument("--steps", type=int, default=8, help="T, steps of each world in a batch")
    parser.add_argument("--sync", action="store_true", help="workers wait for new weights")
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torchrl_logger.setLevel("WARNING")
    settings = {"worlds": arguments.worlds, "steps": arguments.steps, "sync": arguments.sync}
    found = {
        workers: frames_per_second(arguments.kind, workers, seconds=arguments.seconds, **settings)
        for workers in arguments.workers
    }
    print(json.dumps({"kind": arguments.kind, **settings, "frames_per_second": found}, indent=2))


if __name__ == "__main__":
    main()
