"""A model of collection by workers, frames per second against their number: ``python benchmarks/scaling.py``.

Discrete events: each worker acts for a round, its batch travels, the first process takes the batches of all workers in
their order, stores them, and makes the updates that are owed. Each worker gets its next order as soon as its batch has
been taken, or (``sync``) all of them after the updates. Workers that share cores slow down, and no more is done than
all cores can. The times are those of one machine (``benchmarks/workers.py``, which also checks this model); a
cluster's network is assumed. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import random
from dataclasses import dataclass, replace


@dataclass(frozen=True, kw_only=True)
class Times:
    """What a training costs, in seconds.

    Args:
        act: of a worker, to act and to step one world once (``benchmarks/workers.py``: ``worker_us``).
        jitter: standard deviation of a worker's round, as a share of it.
        order: to send one worker its weights and its order.
        receive: to take a batch, for each frame in it.
        latency: until a message has arrived.
        store: to unpack one frame and to store it.
        update: of one update (``benchmarks/updates_v3.py``).
        frames_per_update: collected for each.
    """

    act: float
    jitter: float = 0.05
    order: float = 0.0005
    receive: float = 2e-6
    latency: float = 0.0005
    store: float = 3e-5
    update: float = 0.0
    frames_per_update: int = 32

    def first(self) -> float:
        """Of the first process, for each frame that it has."""
        return self.store + self.update / self.frames_per_update


def frames_per_second(
    times: Times, *, workers: int, cores: int, worlds: int, steps: int, sync: bool, rounds: int = 200, seed: int = 0
) -> float:
    """Of so many workers.

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
    draw, own = random.Random(seed), worlds * steps
    crowding = max(1.0, workers / cores)
    now, arrivals = 0.0, [0.0] * workers  # in the first process; of the workers' next batches

    def order(index: int, now: float) -> float:
        """Sends a worker its order; returns when that is done."""
        length = own * times.act * crowding * max(0.2, draw.gauss(1.0, times.jitter))
        arrivals[index] = now + times.order + 2 * times.latency + length
        return now + times.order

    for index in range(workers):
        now = order(index, now)
    for _ in range(rounds):
        for index in range(workers):
            now = max(now, arrivals[index]) + own * times.receive
            if not sync:
                now = order(index, now)
        now += workers * own * times.first()
        for index in range(workers if sync else 0):
            now = order(index, now)
    cost = times.act + times.first() + times.receive + times.order / own
    return min(rounds * workers * own / now, cores / cost)


def main() -> None:
    """Predicts, prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--act", type=float, default=1 / 4_764, help="seconds; of one process alone")
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
