"""Agents that solve a small task within a minute."""

from dataclasses import replace

import pytest
import torch
from helpers import build, make_collector, small_env, tiny_settings
from test_docs import PARTS, python_blocks
from torchrl.envs import ExplorationType

from hdrqn_torchrl.algorithms import make_hdrqn, make_v3, presets
from hdrqn_torchrl.modules import EpsilonGreedy, RepeatingEpsilonGreedy, compact_network
from hdrqn_torchrl.runs.evaluation import evaluate

TASK = {"num_obstacles": 0, "max_steps": 16, "view": 3}


def learned(name, total_frames, **options):
    """Success of the greedy policy after training, and before it."""
    torch.manual_seed(0)
    env = small_env(32, **TASK)
    settings = tiny_settings(
        slice_len=8,
        batch_size=32,
        capacity=50_000,
        frames_per_update=20,
        warmup_frames=2_000,
        learning_rate=2e-3,
        tau=0.01,
    )
    algorithm = build(name, env, compact_network(32, (64,)), settings=settings, gamma=0.9, **options)
    return train(algorithm, env, total_frames)


def train(algorithm, env, total_frames):
    """Success of the greedy policy after training, and before it."""
    before = success(algorithm)
    behaviour(algorithm, env, total_frames)
    return success(algorithm), before


def success(algorithm, exploration_type=ExplorationType.DETERMINISTIC):
    """Share of 200 episodes with both goals in order."""
    env = algorithm.transform(small_env(200, **TASK))
    return evaluate(env, algorithm.policy, episodes=200, exploration_type=exploration_type)["success_rate"]


def behaviour(algorithm, env, total_frames, last_batches=16):
    """Trains; returns the success of the episodes that ended in the last batches, exploration included."""
    succeeded, ended = [], []
    for batch in make_collector(algorithm, env, 8, total_frames):
        algorithm.observe(batch)
        succeeded.append(batch["next", "success"].sum().item())
        ended.append(batch["next", "done"].sum().item())
        for learner in algorithm.learners.values():
            for _ in range(learner.updates_due()):
                learner.learn()
    return sum(succeeded[-last_batches:]) / sum(ended[-last_batches:])


def success_with_random_subgoals(algorithm):
    """What the greedy sub-controller makes of them."""
    for level, epsilon in (("sub", 0.0), ("meta", 1.0)):
        algorithm.explorations[level].epsilon.fill_(epsilon)
    return success(algorithm, ExplorationType.RANDOM)


def schedule():
    return EpsilonGreedy(1.0, 0.1, anneal_frames=20_000)


QUICK = {"warmup_frames": 2_000, "frames_per_update": 20}
SOON = {"anneal_frames": 10_000}


def quick_v2(env):
    settings = QUICK | {"learning_rate": 2e-3, "tau": 0.01}
    return make_hdrqn(
        env,
        compact_network(32, (64,)),
        version="v2",
        gamma=0.9,
        wrong_subgoal_reward=-1.0,  # without it the agent walks over the other goal in one episode out of six
        sub=replace(presets.SUB_LEARNER, **settings),
        meta=replace(presets.META_LEARNER, **settings),
        sub_exploration=EpsilonGreedy(1.0, 0.1, **SOON),
        meta_exploration=EpsilonGreedy(1.0, 0.1, **SOON),
    )


def quick_v3(env, **options):
    settings = QUICK | {"learning_rate": 3e-3, "tau": 0.02, "batch_size": 16}
    return make_v3(
        env,
        compact_network(32, (64,)),
        learner=replace(presets.V3_LEARNER, **settings),
        memory_size=32,
        head_size=32,
        wrong_subgoal_reward=-0.5,
        sub_exploration=RepeatingEpsilonGreedy(1.0, 0.1, max_repeats=4, **SOON),
        meta_exploration=EpsilonGreedy(1.0, 0.1, **SOON),
        **options,
    )


@pytest.mark.parametrize(
    ("make", "frames", "threshold"), [(quick_v2, 14_336, 0.7), (quick_v3, 12_288, 0.8)], ids=["v2", "v3"]
)
def test_agents_learn_to_reach_two_goals_in_order(make, frames, threshold):
    """Share of greedy episodes with both goals in order, in a room of 3x3 cells with a 3x3 view, within 16 steps.

    Seeds 0 to 4: v2 0.945, 0.945, 0.895, 0.86, 0.955; v3 0.95, 0.945, 0.925, 0.975, 0.965. They take 13 and 9 seconds
    of one core. Broken on purpose (seed 0): with rewards of the wrong sign v2 reaches 0.0, and v3 0.29 with the wrong
    sign of the task's reward alone; with a target network that never follows v2 reaches 0.305. (v3 learns this task
    without one: test_algorithms.py looks at its target network.)

    Agents choose subgoals better than at random, at the end of training too, where one choice in ten is random.
    """
    env = small_env(32, **TASK)
    algorithm = make(env)
    before, while_training, after = success(algorithm), behaviour(algorithm, env, frames), success(algorithm)
    assert before < 0.1 and after > threshold
    assert while_training > 0.65 and success_with_random_subgoals(algorithm) < 0.55


@pytest.mark.slow
def test_the_training_of_the_page_on_parts_learns(capsys):
    """Unchanged; a random agent's return is about 0.1."""
    exec(python_blocks(PARTS)[0], {"__name__": "parts"})
    assert float(capsys.readouterr().out.split()[-1]) > 0.6


@pytest.mark.slow
def test_drqn_learns_a_task_that_needs_memory():
    """The window shows a part of the room: an agent that forgets what was behind it finds the second goal by luck."""
    (with_memory, before), (without, _) = (learned(name, 45_000, exploration=schedule()) for name in ("drqn", "dqn"))
    assert before < 0.5 and with_memory >= 0.8 > 0.7 >= without


@pytest.mark.slow
@pytest.mark.parametrize(
    "sequences",
    [
        {"sampling": "episode_starts", "slice_len": 16, "batch_size": 16},
        {"sampling": "episode_starts", "slice_len": 16, "batch_size": 16, "precision": "bf16"},
        {"sampling": "steps", "slice_len": 8, "stored_state": True, "burn_in": 0.25, "priority_exponent": 0.9},
    ],
    ids=["exact states", "bf16", "R2D2"],
)
def test_v3_solves_a_small_room(sequences):
    """In two thirds of v2's frames; with view 3 it has to remember what it has passed."""
    torch.manual_seed(0)
    env = small_env(32, **TASK)
    usual = {"capacity": 50_000, "warmup_frames": 2_000, "learning_rate": 3e-3, "tau": 0.02, "max_grad_norm": 10.0}
    learner = tiny_settings(**({"batch_size": 32} | usual | sequences))
    algorithm = make_v3(
        env,
        compact_network(32, (64,)),
        learner=learner,
        memory_size=32,
        head_size=32,
        sub_gamma=0.9,
        wrong_subgoal_reward=-0.5,
        sub_exploration=RepeatingEpsilonGreedy(1.0, 0.1, anneal_frames=10_000, max_repeats=4),
        meta_exploration=EpsilonGreedy(1.0, 0.1, anneal_frames=10_000),
    )
    after, before = train(algorithm, env, 16_384)
    assert before < 0.5 and after >= 0.95
