"""Small worlds, small learners and plain loops that several tests share."""

from __future__ import annotations

import csv
import io
import json
import random
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy
import torch
from rich.console import Console
from safetensors.torch import load_file
from tensordict import TensorDictBase
from torchrl.checkpoint import Checkpoint
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, InitTracker, TransformedEnv

from hdrqn_torchrl.algorithms import Algorithm, make_dqn, make_drqn, make_hdqn, make_hdrqn, make_v3
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.learning import LearnerSettings
from hdrqn_torchrl.modules import EpsilonGreedy, RepeatingEpsilonGreedy, compact_network
from hdrqn_torchrl.runs.collectors.resumable import ResumableCollector
from hdrqn_torchrl.runs.evaluation import evaluate
from hdrqn_torchrl.runs.interruption import StopRequest
from hdrqn_torchrl.runs.logging import RunLogger
from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints
from hdrqn_torchrl.runs.trainer import Trainer
from hdrqn_torchrl.transforms import SubgoalTransform

torch.set_num_threads(1)

ROOM = ("#####", "#   #", "#   #", "#   #", "#####")
# Agent, obstacle, goal 0 and goal 1 side by side: walking right meets them in this order.
CORRIDOR = ("######", "#    #", "######")
AGENT, OBJECTS = torch.tensor([7]), torch.tensor([[8, 9, 10]])
LEFT, RIGHT = 2, 3

ALGORITHMS = ("dqn", "drqn", "hdqn", "v1", "v2")
CLOCK = ("wall_seconds", "processor_seconds", "frames_per_second", "updates_per_second")


def small_env(num_envs: int = 4, **settings) -> MultiGoalGridEnv:
    """A 3x3 room with one obstacle and two goals; its episodes are short."""
    defaults = {"layout": ROOM, "num_obstacles": 1, "max_steps": 7, "view": 3, "seed": 0}
    return MultiGoalGridEnv(num_envs, **(defaults | settings))


def house(num_envs: int = 4, **settings) -> MultiGoalGridEnv:
    """Two rooms with a door between them, which are nearer subgoals than the two goals."""
    rows = ["#########", "#...#...#", "#.......#", "#...#...#", "#########"]
    defaults = {"layout": rows, "places": True, "num_obstacles": 1, "max_steps": 7, "view": 3, "seed": 0}
    return MultiGoalGridEnv(num_envs, **(defaults | settings))


def subgoal_env(num_envs: int = 4, *, env_settings: dict | None = None, **settings) -> TransformedEnv:
    """The small room with the option book."""
    book = SubgoalTransform(num_subgoals=2, **settings)
    return TransformedEnv(small_env(num_envs, **(env_settings or {})), Compose(InitTracker(), book))


def tiny_settings(**changes) -> LearnerSettings:
    """Settings of a learner that starts updating at once, and often."""
    defaults = {"slice_len": 4, "batch_size": 4, "capacity": 2_000, "frames_per_update": 16, "warmup_frames": 0}
    return LearnerSettings(**(defaults | changes))


def build(name: str, env: MultiGoalGridEnv, architecture=None, *, settings=None, **options) -> Algorithm:
    """One of the algorithms with small networks and quick learners."""
    architecture = architecture or compact_network(8, (8,))
    settings = settings or tiny_settings()
    if name in ("dqn", "drqn"):
        return {"dqn": make_dqn, "drqn": make_drqn}[name](env, architecture, learner=settings, **options)
    if name == "hdqn":
        return make_hdqn(env, architecture, sub=settings, meta=settings, **options)
    if name == "v3":
        if settings.sampling == "steps" and not settings.stored_state:
            settings = replace(settings, sampling="episode_starts")
        return make_v3(env, architecture, learner=settings, memory_size=8, head_size=8, **options)
    return make_hdrqn(env, architecture, version=name, sub=settings, meta=settings, **options)


def make_collector(
    algorithm: Algorithm, env: MultiGoalGridEnv, steps: int, total_frames: int = -1, kind: type = Collector
) -> Collector:
    """Collects batches ``[N, steps]``."""
    return kind(
        algorithm.transform(env),
        algorithm.policy,
        frames_per_batch=env.batch_size[0] * steps,
        total_frames=total_frames,
        auto_register_policy_transforms=False,
    )


def collect(algorithm: Algorithm, env: MultiGoalGridEnv, steps: int, batches: int = 1) -> list[TensorDictBase]:
    """The first batches of a collector."""
    collector = make_collector(algorithm, env, steps)
    taken = [batch.clone() for batch, _ in zip(collector, range(batches), strict=False)]
    collector.shutdown()
    return taken


def make_training(
    folder: Path,
    name: str = "v2",
    *,
    seed: int = 0,
    learner: dict | None = None,
    options: dict | None = None,
    worlds: Callable[..., EnvBase] = small_env,
    **settings,
) -> Trainer:
    """A complete training, so small that its memories wrap and dozens of episodes end within 256 frames.

    Args:
        folder: run folder.
        name: the algorithm.
        seed: of its networks and worlds.
        learner: changes to the learners' settings.
        options: more arguments of the algorithm.
        worlds: makes its environments.
        settings: changes to the trainer's settings.
    """
    torch.manual_seed(seed)
    folder.mkdir(parents=True, exist_ok=True)
    env = worlds(4, seed=seed)
    levels = ("exploration",) if name in ("dqn", "drqn") else ("sub_exploration", "meta_exploration")
    parts: dict = {level: EpsilonGreedy(1.0, 0.1, anneal_frames=300) for level in levels}
    quick = {"capacity": 40, "frames_per_update": 8, "warmup_frames": 64, "learning_rate": 1e-2}
    if name == "v3":
        parts["sub_exploration"] = RepeatingEpsilonGreedy(1.0, 0.1, anneal_frames=300)
        quick["slice_len"] = 2  # so that the ten steps of an environment always hold the start of a sequence
    if len(levels) > 1:
        parts["max_option_steps"] = 3  # several options an episode
    algorithm = build(name, env, settings=tiny_settings(**(quick | (learner or {}))), **parts, **(options or {}))
    evaluation_env = algorithm.transform(worlds(8))
    defaults = {"total_frames": 256, "log_frames": 96, "evaluation_frames": 128, "checkpoint_frames": 1_000_000}
    settings = defaults | {"checkpoints": Checkpoints(folder / "checkpoints")} | settings
    total_frames, stop = settings["total_frames"], settings.setdefault("stop", StopRequest())
    return Trainer(
        algorithm,
        make_collector(algorithm, env, 8, total_frames, ResumableCollector),
        logger=RunLogger(folder, total_frames=total_frames, console=Console(file=io.StringIO())),
        evaluate=lambda: evaluate(evaluation_env, algorithm.policy, episodes=8, check=stop.check),
        **settings,
    )


def table(folder: Path) -> list[dict[str, str]]:
    """Rows of a run's ``metrics.csv`` without the columns that depend on the clock."""
    with (folder / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{name: value for name, value in row.items() if not name.endswith(CLOCK)} for row in rows]


def contents(folder: Path) -> dict:
    """Everything in the newest checkpoint of a run except clock times: the structure, and the bytes of tensors."""
    newest = max((folder / "checkpoints").iterdir())
    found: dict = {"step": newest.name, "score": Checkpoint.manifest(newest)["metadata"]}
    for part in (newest / "components").iterdir():
        found[part.name] = _without_clock(json.loads((part / "structure.json").read_text()))
        for name, tensor in load_file(part / "tensors.safetensors").items():
            found[part.name, name] = tensor.dtype, tuple(tensor.shape), tensor.numpy().tobytes()
    return found


def _without_clock(node):
    if isinstance(node, list):
        is_clock = len(node) == 2 and node[0] in ("wall_seconds", "processor_seconds", "seconds")
        return node[:1] if is_clock else [_without_clock(item) for item in node]
    return {key: _without_clock(item) for key, item in node.items()} if isinstance(node, dict) else node


def check_same(folder: Path, reference: Path) -> None:
    """Compares two complete runs, without tolerance."""
    check_same_checkpoint(folder, reference)
    assert table(folder) == table(reference)


def check_same_checkpoint(folder: Path, reference: Path) -> None:
    """Compares the complete newest checkpoints of two runs, without tolerance."""
    found, expected = contents(folder), contents(reference)
    assert found.keys() == expected.keys() and len(found) > 50
    assert [key for key in found if found[key] != expected[key]] == []


def seed_everything(seed: int) -> None:
    """Seeds all global random generators."""
    random.seed(seed)
    numpy.random.seed(seed)
    torch.manual_seed(seed)


@cache
def random_play(num_envs, length, seed=0, first_traj=0):
    """Consecutive steps ``[N, length]`` of random play; episodes last up to 5 steps."""
    torch.manual_seed(seed)
    env = subgoal_env(num_envs, env_settings={"max_steps": 5, "seed": seed}, max_option_steps=3)
    steps = env.rollout(length, break_when_any_done=False)
    episode = steps["is_init"].squeeze(-1).cumsum(-1) - 1
    steps["collector", "traj_ids"] = first_traj + episode + 1_000 * torch.arange(num_envs)[:, None]
    steps["extra"], steps["next", "extra"] = torch.rand(2, num_envs, length)
    return steps


def batches_of(steps: TensorDictBase, length: int) -> list[TensorDictBase]:
    """Cuts steps ``[N, T]`` into whole batches ``[N, length]``."""
    return [steps[:, start : start + length] for start in range(0, steps.shape[1] - length + 1, length)]


def options_of(rows: TensorDictBase, *inputs: str) -> tuple[TensorDictBase, torch.Tensor]:
    """Options among stored rows ``[M]``, with their outcomes under ``"next"``, taken from the following row.

    Final rows are taken out, and the options before them are done. Returns with the options where what they led to is
    known, ``[M]`` bool.
    """
    after, behind = rows["next"], rows.roll(-1, 0)
    final = (after["done"] & ~after["terminated"]).squeeze(-1)
    known = rows["collector", "traj_ids"] == behind["collector", "traj_ids"]
    known[-1] = False
    options = rows.clone()
    for key in inputs:
        options["next", key] = behind[key]
    options["next", "done"] = after["done"] | (final.roll(-1, 0) & known).unsqueeze(-1)
    return options[~final], known[~final]


def unroll_by_steps(network, observation, condition=None, init=None, first=None):
    """What ``QNetwork.unroll`` computes, as a plain loop over single decisions: ``[B, T, A]``."""
    rows = []
    for b in range(len(observation)):
        state, values = network.initial_state(1) if first is None else [part[b : b + 1] for part in first], []
        for t in range(observation.shape[1]):
            if init is not None and init[b, t]:
                state = network.initial_state(1)
            subgoal = None if condition is None else condition[b : b + 1, t]
            if network.recurrent:
                value, state = network.step(observation[b : b + 1, t], subgoal, state)
            else:
                value = network.evaluate(observation[b : b + 1, t], subgoal)
            values.append(value[0])
        rows.append(torch.stack(values))
    return torch.stack(rows)


def parameter_distance(first: TensorDictBase, second: TensorDictBase) -> float:
    """Largest absolute difference between two sets of parameters."""
    first, second = (dict(params.items(True, True)) for params in (first, second))
    assert first.keys() == second.keys()
    return max((first[key] - second[key]).abs().max().item() for key in first if first[key].numel())


class State:
    """A component that consists of its state only."""

    def __init__(self, state=None):
        self.state = state

    def state_dict(self):
        return self.state

    def load_state_dict(self, state):
        self.state = state
