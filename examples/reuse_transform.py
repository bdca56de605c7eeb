"""The option book and the controllers on another package's environment: MiniGrid's four rooms.

``SubgoalTransform``, the controllers and ``Learner`` know nothing of this project's own tasks. Here the task is a stock
Gymnasium environment: the agent sees the 7x7 cells in front of it and is paid for reaching the green square. Subgoals
are "go through a gap in the walls" and "reach the square"; a short critic says when that has happened. The rest
(``GymWrapper``, ``SerialEnv``, ``Collector``) is TorchRL's.

Run ``pip install minigrid``, then ``python examples/reuse_transform.py [--frames 60000]``.
"""

from __future__ import annotations

import argparse
from collections import Counter
from functools import partial

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete
from tensordict import TensorDictBase
from torch import Tensor
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.envs import Compose, GymWrapper, InitTracker, SerialEnv, TransformedEnv

from hdrqn_torchrl import modules
from hdrqn_torchrl.algorithms import make_recurrent_loss
from hdrqn_torchrl.data import OptionExtractor, StepSelector
from hdrqn_torchrl.learning import Learner, LearnerSettings
from hdrqn_torchrl.transforms import SubgoalTransform

try:
    import minigrid  # noqa: F401 (registers its environments)
except ImportError as error:
    raise SystemExit("This example needs MiniGrid; install it with `pip install minigrid`.") from error

NUM_ENVS, NUM_CODES, MIDDLE = 16, 15, 9


class FourRooms(gymnasium.ObservationWrapper):
    """Gives the agent its partial view (with MiniGrid's compass on its own cell), and the critic what it needs."""

    def __init__(self) -> None:
        super().__init__(gymnasium.make("MiniGrid-FourRooms-v0"))
        self.action_space = Discrete(3)  # turn left, turn right, forward; the others do nothing here
        view, entered = Box(0, NUM_CODES - 1, (7, 7), np.uint8), Box(0, 1, (2,), np.bool_)
        self.observation_space, self._position = Dict(observation=view, entered=entered), None

    def observation(self, observation: dict) -> dict:
        """Object codes of the view, 11 + direction on the agent's cell; whether it just entered a gap or the goal."""
        view, world, position = observation["image"][..., 0].copy(), self.unwrapped, tuple(self.unwrapped.agent_pos)
        view[3, 6] = 11 + observation["direction"]
        moved, self._position = world.step_count > 0 and position != self._position, position
        on_goal = getattr(world.grid.get(*position), "type", None) == "goal"
        return {"observation": view, "entered": np.array([MIDDLE in position, on_goal]) & moved}


def critic(after: TensorDictBase) -> Tensor:
    """Which subgoals the last step reached, ``[N, 2]`` bool; the agent does not read this entry."""
    return after["entered"]


def make_learners(sub: modules.SubController, meta: modules.MetaController) -> dict[str, Learner]:
    """Each level learns from what it needs, under the names that ``SubgoalTransform`` gave them."""
    steps = StepSelector(
        root_keys=["observation", "action", "option_init"],
        next_keys=["intrinsic_reward", "option_done", "option_terminated"],
        subgoal_key="subgoal",
    )
    options = OptionExtractor(input_keys=meta.input_keys, mask_key=None)
    settings = partial(LearnerSettings, frames_per_update=8, warmup_frames=1000, tau=0.01, max_target=1.0)
    sub_settings, meta_settings = settings(slice_len=8), settings(slice_len=4)
    losses = make_recurrent_loss(sub, sub_settings), make_recurrent_loss(meta, meta_settings)
    return {
        "sub": Learner(sub, sub_settings, extract=steps, loss=losses[0], num_envs=NUM_ENVS),
        "meta": Learner(meta, meta_settings, extract=options, loss=losses[1]),
    }


def main() -> None:
    """Trains and prints five lines of progress."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=60_000)
    frames = parser.parse_args().frames
    torch.set_num_threads(1)
    torch.manual_seed(0)
    torchrl_logger.setLevel("WARNING")

    explorations = [modules.EpsilonGreedy(1.0, 0.1, anneal_frames=max(1, frames // 2)) for _ in range(2)]
    network = partial(modules.QNetwork, hidden_size=64)
    view, memory = modules.CellFeatures(7, NUM_CODES), modules.FullyConnectedFeatures(64, (128,))
    act = network(view, num_actions=3, num_conditions=2, gate_features=True)
    choose = network(memory, num_actions=2)  # hDRQNv2: the meta-controller reads the sub-controller's memory
    sub = modules.SubController(act, explorations[0])
    meta = modules.MetaController(choose, explorations[1], input_keys=["sub_hidden"], mask_key=None)
    learners = make_learners(sub, meta)

    # The controllers' actions are indices, so the environment's must not be one-hot.
    env = SerialEnv(NUM_ENVS, lambda: GymWrapper(FourRooms(), categorical_action_encoding=True))
    subgoals = SubgoalTransform(
        2, critic=critic, extrinsic_reward_key="reward", hazard_key=None, repeatable=True, max_option_steps=25
    )
    # Without InitTracker and the primers the LSTMs would start every step from zero, silently.
    primers = sub.make_tensordict_primer(), meta.make_tensordict_primer()
    env = TransformedEnv(env, Compose(InitTracker(), subgoals, *primers))
    env.set_seed(0)
    policy, batch_frames = modules.HierarchicalPolicy(meta, sub), NUM_ENVS * 8
    collector = Collector(env, policy, frames_per_batch=batch_frames, auto_register_policy_transforms=False)

    print("  frames  options  reached  episodes  at goal  sub loss  meta loss")
    counts, losses, batches = Counter(), {"sub": 0.0, "meta": 0.0}, max(5, frames // batch_frames)
    for number, batch in zip(range(1, batches + 1), collector, strict=False):
        counts.update({name: int(batch["next", name].sum()) for name in ("option_done", "subgoal_reached", "done")})
        counts["goal"] += int(batch["next", "entered"][..., 1].sum())
        for name, learner in learners.items():
            learner.store(batch)
            for _ in range(learner.updates_due()):
                losses[name] = learner.learn()["loss"].item()
        for exploration in explorations:
            exploration.step(batch.numel())
        if number % (batches // 5) == 0:
            options, episodes = max(1, counts["option_done"]), max(1, counts["done"])
            print(f"{number * batch_frames:8,} {options:8,} {counts['subgoal_reached'] / options:8.1%}", end=" ")
            print(f"{episodes:9,} {counts['goal'] / episodes:8.1%} {losses['sub']:9.4f} {losses['meta']:10.4f}")
            counts.clear()
    collector.shutdown()


if __name__ == "__main__":
    main()
