"""The option book and the controllers on another package's environment: MiniGrid's four rooms.

``SubgoalTransform``, the controllers and ``Learner`` know nothing of this project's own tasks. Here the task is a
stock Gymnasium environment: the agent sees the 7x7 cells in front of it and is paid for reaching the green square.
Subgoals are "go through a gap" and "reach the square"; a critic of three lines says when that has happened.
Everything else (``GymWrapper``, ``SerialEnv``, ``Collector``) is TorchRL's.

Run ``pip install minigrid``, then ``python examples/reuse_transform.py [--frames 40000]``.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
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

from hdrqn_torchrl.data import OptionExtractor, StepSelector
from hdrqn_torchrl.learner import Learner, LearnerSettings
from hdrqn_torchrl.modules import (
    CellFeatures,
    EpsilonGreedy,
    FullyConnectedFeatures,
    HierarchicalPolicy,
    MetaController,
    QNetwork,
    SubController,
)
from hdrqn_torchrl.transforms import SubgoalTransform

try:
    import minigrid  # noqa: F401 (registers its environments)
except ImportError as error:
    raise SystemExit("This example needs MiniGrid; install it with `pip install minigrid`.") from error

SUBGOALS = ("gap", "goal")
NUM_ENVS, NUM_CODES, MIDDLE, HIDDEN = 16, 15, 9, 64


class FourRooms(gymnasium.ObservationWrapper):
    """Gives the agent its partial view (with MiniGrid's compass on its own cell), and positions to the critic."""

    def __init__(self) -> None:
        super().__init__(gymnasium.make("MiniGrid-FourRooms-v0"))
        self.action_space = Discrete(3)  # turn left, turn right, forward; the others do nothing here
        cells = partial(Box, 0, self.unwrapped.width - 1, dtype=np.int64)
        self.observation_space = Dict(
            observation=Box(0, NUM_CODES - 1, (7, 7), np.uint8),
            position=cells((2,)),
            moved=Box(0, 1, (1,), np.bool_),
            landmarks=cells((5, 2)),
        )

    def observation(self, observation: dict) -> dict:
        """Object codes of the view; 11 + direction stands where the agent is (bottom centre)."""
        view = observation["image"][..., 0].copy()
        view[3, 6] = 11 + observation["direction"]
        position = np.array(self.unwrapped.agent_pos)
        if self.unwrapped.step_count == 0:  # a new map
            grid, side = self.unwrapped.grid, range(1, self.unwrapped.width - 1)
            objects = {(x, y): getattr(grid.get(x, y), "type", None) for x in side for y in side}
            gaps = [cell for cell, kind in objects.items() if MIDDLE in cell and kind != "wall"]
            goal = [cell for cell, kind in objects.items() if kind == "goal"]
            self.landmarks, self.position = np.array(gaps + goal), position
        moved, self.position = (position != self.position).any(keepdims=True), position
        return {"observation": view, "position": position, "moved": moved, "landmarks": self.landmarks}


def critic(after: TensorDictBase) -> Tensor:
    """Which subgoals the last step reached, ``[N, 2]`` bool: a gap or the goal was entered."""
    entered = (after["position"].unsqueeze(-2) == after["landmarks"]).all(-1) & after["moved"]  # [N, 4 gaps + goal]
    return torch.stack([entered[..., :4].any(-1), entered[..., 4]], -1)


def make_agent(anneal_frames: int) -> tuple[HierarchicalPolicy, dict[str, Learner], list[EpsilonGreedy]]:
    """Both controllers (hDRQNv2: the meta-controller reads the sub-controller's memory) and their learners."""
    explorations = [EpsilonGreedy(1.0, 0.1, anneal_frames=anneal_frames) for _ in range(2)]
    sub_network = QNetwork(
        CellFeatures(7, NUM_CODES), num_actions=3, hidden_size=HIDDEN, num_conditions=len(SUBGOALS), gate_features=True
    )
    meta_network = QNetwork(FullyConnectedFeatures(HIDDEN, (128,)), num_actions=len(SUBGOALS), hidden_size=HIDDEN)
    sub = SubController(sub_network, explorations[0])
    meta = MetaController(meta_network, explorations[1], input_keys=["sub_hidden"], mask_key=None)
    ends = {"reward": "intrinsic_reward", "done": "option_done", "terminated": "option_terminated"}
    choice = {"action": "subgoal", "reward": "option_return", "steps": "option_steps"}
    settings = partial(LearnerSettings, frames_per_update=8, warmup_frames=1000, tau=0.01, max_grad_norm=10.0)
    learners = {
        "sub": Learner(
            sub,
            settings(slice_len=12),
            extract=StepSelector(
                root_keys=["observation", "action", "option_init"],
                next_keys=["observation", *ends.values()],
                subgoal_key="subgoal",
            ),
            loss_keys={**ends, "init": "option_init"},
            num_envs=NUM_ENVS,
        ),
        "meta": Learner(
            meta,
            settings(slice_len=4),
            extract=OptionExtractor(input_keys=["sub_hidden"], mask_key=None),
            loss_keys=choice,
        ),
    }
    return HierarchicalPolicy(meta, sub), learners, explorations


def main() -> None:
    """Trains and prints ten lines of progress."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=40_000)
    frames = parser.parse_args().frames
    torch.set_num_threads(1)
    torch.manual_seed(0)
    torchrl_logger.setLevel("WARNING")
    policy, learners, explorations = make_agent(anneal_frames=max(1, frames // 2))
    # SubController's actions are indices, so the specs must not be one-hot.
    env = SerialEnv(NUM_ENVS, lambda: GymWrapper(FourRooms(), categorical_action_encoding=True))
    subgoals = SubgoalTransform(
        len(SUBGOALS),
        critic=critic,
        repeatable=True,
        extrinsic_reward_key="reward",
        hazard_key=None,
        max_option_steps=25,
    )
    # Without InitTracker and the primers the LSTMs would start every step from zero, silently.
    primers = [controller.make_tensordict_primer() for controller in (policy.sub_controller, policy.meta_controller)]
    env = TransformedEnv(env, Compose(InitTracker(), subgoals, *primers))
    env.set_seed(0)
    collector = Collector(
        env, policy, frames_per_batch=NUM_ENVS * 8, total_frames=frames, auto_register_policy_transforms=False
    )
    print(f"{'frames':>8} {'options':>8} {'reached':>8} {'episodes':>9} {'goal':>6} {'sub loss':>9} {'meta loss':>10}")
    counts, seen, losses = defaultdict(int), 0, {"sub": float("nan"), "meta": float("nan")}
    for batch in collector:
        after, before, seen = batch["next"], seen, seen + batch.numel()
        for name in ("option_done", "subgoal_reached", "done", "terminated"):
            counts[name] += int(after[name].sum())
        for name, learner in learners.items():
            learner.store(batch)
            for _ in range(learner.updates_due()):
                losses[name] = learner.update(learner.sample())["loss"].item()
        for exploration in explorations:
            exploration.step(batch.numel())
        if before * 10 // frames < seen * 10 // frames:
            options, episodes = max(counts["option_done"], 1), max(counts["done"], 1)
            print(
                f"{seen:8,} {counts['option_done']:8,} {counts['subgoal_reached'] / options:8.1%} {counts['done']:9,} "
                f"{counts['terminated'] / episodes:6.1%} {losses['sub']:9.4f} {losses['meta']:10.4f}"
            )
            counts.clear()
    collector.shutdown()


if __name__ == "__main__":
    main()
