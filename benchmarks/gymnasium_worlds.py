"""Frames per second with MiniGrid's worlds: ``python benchmarks/gymnasium_worlds.py [--backend envpool]``.

The worlds are stepped in this process, in processes of their own (``--processes``), or in C++ by EnvPool; by random
actions, by the flat v3 agent, and while it learns, with the settings that ``conf/`` has for MiniGrid. EnvPool has no
subgoals of MiniGrid's, so nobody has any here. Wall time, as worlds of other processes and threads count, too: it means
something on a machine without other work. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace

import torch
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.envs.utils import RandomPolicy

from hdrqn_torchrl.algorithms import make_v3
from hdrqn_torchrl.algorithms.presets import V3_LEARNER
from hdrqn_torchrl.envs import make_gym
from hdrqn_torchrl.modules import compact_network

SEQUENCES = replace(
    V3_LEARNER,
    slice_len=32,
    sampling="steps",
    stored_state=True,
    burn_in=0.25,
    frames_per_update=32,
    warmup_frames=2000,
)
STEPS = 8  # of each world in a batch


def frames_per_second(batches: Iterator, frames: int, *, seconds: float) -> int:
    """Of what yields batches of so many frames."""
    for _ in range(3):
        next(batches)
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        next(batches)
        count += frames
    return round(count / (time.perf_counter() - started))


def main() -> None:
    """Times, prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--id", default="MiniGrid-DoorKey-8x8-v0")
    parser.add_argument("--envs", type=int, default=32, help="N")
    parser.add_argument("--backend", choices=["gymnasium", "envpool"], default="gymnasium")
    parser.add_argument("--processes", action="store_true", help="one for each world")
    parser.add_argument("--seconds", type=float, default=15.0, help="of each measurement")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torchrl_logger.setLevel("WARNING")  # it writes to standard output

    env = make_gym(
        arguments.id, arguments.envs, entries=["image", "direction"], codes=(11, 6, 4), backend=arguments.backend,
        processes=arguments.processes, seed=0,
    )  # fmt: skip
    agent = make_v3(env, compact_network(), levels=1, learner=SEQUENCES, prediction_steps=1)
    transformed, frames = agent.transform(env), STEPS * arguments.envs

    def collect(policy) -> Iterator:  # noqa: ANN001
        collector = Collector(
            transformed, policy, frames_per_batch=frames, total_frames=-1, auto_register_policy_transforms=False
        )
        return iter(collector)

    def learn() -> Iterator:
        for batch in collect(agent.policy):
            agent.observe(batch)
            for learner in agent.learners.values():
                for _ in range(learner.updates_due()):
                    learner.learn()
            yield batch

    found = {
        "random": frames_per_second(collect(RandomPolicy(env.full_action_spec)), frames, seconds=arguments.seconds),
        "acting": frames_per_second(collect(agent.policy), frames, seconds=arguments.seconds),
    }
    training = learn()
    for _ in range(2 + SEQUENCES.warmup_frames // frames):
        next(training)
    found["training"] = frames_per_second(training, frames, seconds=arguments.seconds)
    settings = {name: value for name, value in vars(arguments).items() if name != "seconds"}
    print(json.dumps({**settings, "frames_per_second": found}, indent=2))


if __name__ == "__main__":
    main()
