"""Small worlds, small learners and plain loops that several tests share."""

from __future__ import annotations

from functools import cache

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, TransformedEnv

from hdrqn_torchrl.algorithms import Algorithm, make_dqn, make_drqn, make_hdqn, make_hdrqn
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.learner import LearnerSettings
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.transforms import SubgoalTransform

torch.set_num_threads(1)

ROOM = ("#####", "#   #", "#   #", "#   #", "#####")
# Agent, obstacle, goal 0 and goal 1 side by side: walking right meets them in this order.
CORRIDOR = ("######", "#    #", "######")
AGENT, OBJECTS = torch.tensor([7]), torch.tensor([[8, 9, 10]])
LEFT, RIGHT = 2, 3

ALGORITHMS = ("dqn", "drqn", "hdqn", "v1", "v2")


def small_env(num_envs: int = 4, **settings) -> MultiGoalGridEnv:
    """A 3x3 room with one obstacle and two goals; its episodes are short."""
    defaults = {"layout": ROOM, "num_obstacles": 1, "max_steps": 7, "view": 3, "seed": 0}
    return MultiGoalGridEnv(num_envs, **(defaults | settings))


def subgoal_env(num_envs: int = 4, *, env_settings: dict | None = None, **settings) -> TransformedEnv:
    """The small room with the option book."""
    book = SubgoalTransform(num_subgoals=2, **settings)
    return TransformedEnv(small_env(num_envs, **(env_settings or {})), Compose(InitTracker(), book))


def tiny_settings(**changes) -> LearnerSettings:
    """A learner that updates at once and often."""
    defaults = {"slice_len": 4, "batch_size": 4, "capacity": 2_000, "frames_per_update": 16, "warmup_frames": 0}
    return LearnerSettings(**(defaults | changes))


def build(name: str, env: MultiGoalGridEnv, architecture=None, *, settings=None, **options) -> Algorithm:
    """One of the five algorithms with small networks and quick learners."""
    architecture = architecture or compact_network(8, (8,))
    settings = settings or tiny_settings()
    if name in ("dqn", "drqn"):
        return {"dqn": make_dqn, "drqn": make_drqn}[name](env, architecture, learner=settings, **options)
    if name == "hdqn":
        return make_hdqn(env, architecture, sub=settings, meta=settings, **options)
    return make_hdrqn(env, architecture, version=name, sub=settings, meta=settings, **options)


def make_collector(algorithm: Algorithm, env: MultiGoalGridEnv, steps: int, total_frames: int = -1) -> Collector:
    """Collects batches ``[N, steps]``."""
    return Collector(
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


def unroll_by_steps(network, observation, condition=None, init=None):
    """What ``QNetwork.unroll`` computes, as a plain loop over single decisions: ``[B, T, A]``."""
    rows = []
    for b in range(len(observation)):
        state, values = network.initial_state(1), []
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
