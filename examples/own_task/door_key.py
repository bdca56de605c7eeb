"""Your own task: from a Gymnasium id to a trained agent, a picture of how it plays, and a learning curve.

    python examples/own_task/door_key.py [--frames 150000] [--out door_key]

A key opens the door to the goal (MiniGrid's DoorKey-5x5); only the goal pays. Key and door are subgoals.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from torchrl.collectors import Collector

from hdrqn_torchrl.algorithms import make_v3
from hdrqn_torchrl.envs import Subgoals, make_gym
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.rendering import record_episodes, write_video
from hdrqn_torchrl.runs.evaluation import evaluate


class KeyAndDoor(Subgoals):
    """To carry the key, to have opened the door, to have reached the goal."""

    names = ("key", "door", "goal")

    def conditions(self, env, before, after, info):  # noqa: D102, ANN001, ANN201
        world = env.unwrapped
        door = next(cell for cell in world.grid.grid if cell is not None and cell.type == "door")
        return world.carrying is not None, door.is_open, info.get("terminated", False)


def make_env(num_envs: int, seed: int):  # noqa: ANN201, D103
    planes = {"entries": ["image", "direction"], "codes": (11, 6, 4)}  # of cells: object, colour, state
    task = {"success": lambda reward, info: reward > 0, "max_steps": 250, "largest_return": 1.0, "smallest_return": 0.0}
    return make_gym("MiniGrid-DoorKey-5x5-v0", num_envs, subgoals=KeyAndDoor(), **planes, **task, seed=seed)


def main() -> None:  # noqa: D103
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=150_000)
    parser.add_argument("--out", default="door_key")
    options = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)

    env = make_env(32, seed=0)
    agent = make_v3(env, compact_network(), total_frames=options.frames, sub_gamma=0.95, meta_gamma=0.99)
    collector = Collector(
        agent.transform(env), agent.policy, frames_per_batch=256, total_frames=options.frames,
        auto_register_policy_transforms=False,
    )  # fmt: skip
    watched = agent.transform(make_env(100, seed=1))
    curve = []
    for number, batch in enumerate(collector):
        agent.observe(batch)
        for learner in agent.learners.values():
            for _ in range(learner.updates_due()):
                learner.learn()
        if number % 40 == 0:
            success = evaluate(watched, agent.policy, episodes=100)["success_rate"]
            curve.append((number * 256, success))
            print(f"{number * 256:7,} frames: {success:.0%} of 100 greedy episodes", flush=True)

    plt.plot(*zip(*curve, strict=True))
    plt.xlabel("frames")
    plt.ylabel("success, greedy")
    plt.savefig(f"{options.out}.png")
    write_video(record_episodes(agent.transform(make_env(1, seed=2)), agent, episodes=3), Path(f"{options.out}.gif"))


if __name__ == "__main__":
    main()
