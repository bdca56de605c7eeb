"""Frames per second of collection by workers: ``python benchmarks/workers.py [--kind ray] [--workers 0 1 2 4]``.

The worlds are MiniGrid's, through Gymnasium, where stepping is the bottleneck; the flat v3 agent acts, and nobody
learns. Wall time means something on idle cores only; processor time, of a worker and of the first process for each
frame, nearly does on others, too. With it the model of scaling.py predicts the rate. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from scaling import Times
from scaling import frames_per_second as predicted
from torchrl import torchrl_logger

from hdrqn_torchrl.algorithms import make_v3
from hdrqn_torchrl.algorithms.presets import V3_LEARNER
from hdrqn_torchrl.envs import make_gym
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.runs.collectors.resumable import ResumableCollector
from hdrqn_torchrl.runs.collectors.workers import ProcessWorkers, Worker, WorkersCollector


class TimedWorker(Worker):
    """Tells what it has cost."""

    def seconds(self) -> float:
        """Of its processor, so far."""
        return time.process_time()


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


def collected(batches: Iterator, seconds: float, done: Any = lambda: None) -> tuple[int, float]:
    """Frames, and the seconds that they took."""
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        count += next(batches).numel()
        done()
    return count, time.perf_counter() - started


def alone(worlds: int, steps: int, seconds: float) -> dict[str, float]:
    """This process, without workers."""
    env, agent = agent_of(worlds, 0)
    collector = ResumableCollector(
        agent.transform(env), agent.policy, frames_per_batch=worlds * steps, total_frames=-1,
        auto_register_policy_transforms=False,
    )  # fmt: skip
    batches = iter(collector)
    for _ in range(2):
        next(batches)
    before = time.process_time()
    count, wall = collected(batches, seconds)
    own = (time.process_time() - before) / count
    collector.shutdown()
    return {"frames_per_second": round(count / wall), "first_process_us": round(1e6 * own, 1)}


def by_workers(kind: str, workers: int, *, worlds: int, steps: int, sync: bool, seconds: float) -> dict[str, float]:
    """So many workers, after two rounds."""
    make = partial(TimedWorker, partial(part, worlds // workers), steps=steps, all_worlds=worlds, threads=1)
    if kind == "ray":
        from hdrqn_torchrl.runs.collectors.workers.ray_workers import RayWorkers

        place = RayWorkers(make, workers=workers)
    else:
        place = ProcessWorkers(make)
    env, agent = agent_of(worlds, 0)
    collector = WorkersCollector(
        place, agent.transform(env), agent.policy, workers=workers,
        total_frames=10**12, sync=sync,
    )  # fmt: skip
    batches = iter(collector)
    for _ in range(2):
        next(batches)
    before, own = cost(collector), time.process_time()
    count, wall = collected(batches, seconds, collector.update_policy_weights_)
    own = (time.process_time() - own) / count
    theirs = (cost(collector) - before) / (count + (0 if sync else worlds * steps))  # the last round is not counted
    collector.shutdown()
    return {
        "frames_per_second": round(count / wall), "worker_us": round(1e6 * theirs, 1),
        "first_process_us": round(1e6 * own, 1),
    }  # fmt: skip


def cost(collector: WorkersCollector) -> float:
    """Seconds of all workers' processors."""
    if collector._ordered:
        collector._gather()
    return sum(collector._ask_all("seconds"))


def main() -> None:
    """Times, predicts, prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", choices=["processes", "ray"], default="processes")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 1, 2, 4], help="0: this process alone")
    parser.add_argument("--worlds", type=int, default=32, help="N, of all workers together")
    parser.add_argument("--steps", type=int, default=8, help="T, steps of each world in a batch")
    parser.add_argument("--sync", action="store_true", help="workers wait for new weights")
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torchrl_logger.setLevel("WARNING")
    shape = {"worlds": arguments.worlds, "steps": arguments.steps}
    found: dict[int, dict[str, float]] = {}
    times: Times | None = None  # of the fewest workers
    for workers in sorted(arguments.workers):
        if workers == 0:
            found[0] = alone(**shape, seconds=arguments.seconds)
            continue
        row = found[workers] = by_workers(
            arguments.kind, workers, **shape, sync=arguments.sync, seconds=arguments.seconds
        )
        times = times or Times(
            act=1e-6 * row["worker_us"], store=1e-6 * row["first_process_us"], order=0.0, receive=0.0
        )
        row["predicted"] = round(
            predicted(
                times, workers=workers, cores=os.cpu_count() or 1, worlds=arguments.worlds // workers,
                steps=arguments.steps, sync=arguments.sync,
            )
        )  # fmt: skip
    print(json.dumps({"kind": arguments.kind, **shape, "sync": arguments.sync, "workers": found}, indent=2))


if __name__ == "__main__":
    main()
