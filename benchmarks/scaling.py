"""A model of collection by workers, frames per second against their number: ``python benchmarks/scaling.py``.

Discrete events: each worker acts for a round, its batch travels, the learner takes in the batches of all workers,
stores them, and makes the updates that are owed; then (``sync``), or as soon as the last batch has arrived, the next
round is ordered. The times are those of one machine (below, with what measures them); a cluster's network is assumed.
Workers that share cores, with each other or with a learner that learns, slow down. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import heapq
import json
import random
from dataclasses import dataclass, replace


@dataclass(frozen=True, kw_only=True)
class Times:
    """What a training costs, in seconds.

    Args:
        act: to act and to step one world once, on a core of its own (``benchmarks/gymnasium_worlds.py``, "acting").
        jitter: standard deviation of a worker's round, as a share of it.
        order: to send one worker its weights and its order.
        receive: to take in a batch, for each frame in it.
        latency: until a message has arrived.
        store: to store one frame.
        update: of one update (``benchmarks/updates_v3.py``).
        frames_per_update: collected for each.
    """

    act: float
    jitter: float = 0.05
    order: float = 0.002
    receive: float = 5e-6
    latency: float = 0.0005
    store: float = 2e-5
    update: float = 0.0
    frames_per_update: int = 32


def frames_per_second(
    times: Times, *, workers: int, cores: int, worlds: int, steps: int, sync: bool, rounds: int = 200, seed: int = 0
) -> float:
    """Of so many workers, one core being the learner's.

    Args:
        times: what everything costs.
        workers: W.
        cores: of all machines together.
        worlds: of each worker.
        steps: of each world in a batch.
        sync: whether workers wait for new weights.
        rounds: that are simulated.
        seed: of the jitter.
    """
    draw = random.Random(seed)
    frames = workers * worlds * steps
    crowding = max(1.0, (workers + (times.update > 0)) / cores)
    learner = 0.0  # when it is free
    updates = frames * (times.store + times.update / times.frames_per_update)
    arrivals: list[float] = []

    def order(now: float) -> float:
        """Sends all workers their orders; returns when the last is sent."""
        for _ in range(workers):
            now += times.order
            length = worlds * steps * times.act * crowding * max(0.2, draw.gauss(1.0, times.jitter))
            heapq.heappush(arrivals, now + 2 * times.latency + length)
        return now

    learner = order(learner)
    for _ in range(rounds):
        for _ in range(workers):
            learner = max(learner, heapq.heappop(arrivals)) + worlds * steps * times.receive
        learner = order(learner + updates) if sync else order(learner) + updates
    return rounds * frames / learner


def main() -> None:
    """Predicts, prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--act", type=float, default=1 / 1_900, help="seconds")
    parser.add_argument("--update", type=float, default=0.04, help="seconds; 0: nobody learns")
    parser.add_argument("--worlds", type=int, default=16, help="of each worker")
    parser.add_argument("--steps", type=int, default=8)
    arguments = parser.parse_args()
    times = Times(act=arguments.act, update=arguments.update)
    shape = {"worlds": arguments.worlds, "steps": arguments.steps}
    found = {}
    for name, cores in {"2 cores": 2, "16 cores": 16, "8 x 16 cores": 128, "64 x 16 cores": 1024}.items():
        numbers = [1 << power for power in range(11) if 1 << power <= cores]
        remote = times if cores <= 16 else replace(times, latency=0.002)
        found[name] = {
            "sync" if sync else "ahead": {
                workers: round(frames_per_second(remote, workers=workers, cores=cores, sync=sync, **shape))
                for workers in numbers
            }
            for sync in (True, False)
        }
    print(json.dumps({**vars(arguments), "frames_per_second": found}, indent=2))


if __name__ == "__main__":
    main()
