"""Values learned by hindsight in worlds so small that the true ones are known."""

import itertools

import pytest
import torch
from helpers import RIGHT, small_env, tiny_settings

from hdrqn_torchrl.algorithms import make_hdqn, make_hdrqn
from hdrqn_torchrl.modules import compact_network

CORRIDOR = {"layout": ("#####", "#   #", "#####"), "num_obstacles": 0, "view": 5, "max_steps": 20}  # all is seen
CELLS, MOVES, GAMMA = (6, 7, 8), (0, 0, -1, 1), 0.5  # up and down meet a wall


def make(builder, env, **settings):
    """An algorithm in the corridor that learns fast."""
    torch.manual_seed(0)
    usual = {"slice_len": 1, "batch_size": 64, "learning_rate": 5e-3, "tau": 0.05, "burn_in": 0.0}
    learners = {level: tiny_settings(**(usual | settings.pop(level, {}))) for level in ("sub", "meta")}
    return builder(env, compact_network(32, (32,)), gamma=GAMMA, **learners, **settings)


def play(algorithm, env, steps, decide, world=None):
    """Steps ``[N, T]``; ``decide()`` gives action and proposed subgoal ``[N]``."""
    transformed = algorithm.transform(env)
    start = transformed.reset()
    if world is not None:
        start["observation"] = env.set_world(*world)["observation"]
    played = transformed.rollout(
        steps, lambda td: td.update(decide()), tensordict=start, auto_reset=False, break_when_any_done=False
    )
    number = played["is_init"].squeeze(-1).cumsum(1) + 1_000 * torch.arange(len(played))[:, None]
    return played.set(("collector", "traj_ids"), number)


def train(learner, batch, updates):
    learner.store(batch)
    for _ in range(updates):
        learner.learn()


def largest_errors(sub):
    """For each goal, over all worlds and actions: a way of k steps to a goal is worth gamma to the k - 1."""
    places = torch.tensor(list(itertools.permutations(CELLS)))
    agent, goals = places[:, 0], places[:, 1:]
    observation = small_env(6, **CORRIDOR).set_world(agent, goals)["observation"].unsqueeze(1)
    after = (agent[:, None] + torch.tensor(MOVES)).clamp(CELLS[0], CELLS[-1])
    errors = []
    for goal in range(2):
        right = GAMMA ** (after - goals[:, goal, None]).abs()
        with torch.no_grad():
            value = sub.network.network.unroll(observation, torch.full((6, 1), goal)).squeeze(1)
        errors.append((value - right).abs().max().item())
    return errors


@pytest.mark.parametrize(
    ("builder", "settings"),
    [
        pytest.param(make_hdqn, {}, id="hdqn"),
        pytest.param(
            make_hdrqn,
            {"slice_len": 4, "trace_decay": 0.8, "batch_size": 32},
            id="v2-lambda",
            marks=pytest.mark.slow,  # tests/data/test_hindsight.py compares its sequences with plain loops
        ),
    ],
)
def test_hindsight_learns_the_values_of_a_subgoal_that_was_never_pursued(builder, settings):
    """From random play in which every option was sent to goal 0."""
    errors, goal_0 = {}, torch.zeros(64, dtype=torch.int64)
    for hindsight in (True, False):
        env = small_env(64, **CORRIDOR)
        algorithm = make(builder, env, sub=settings, sub_hindsight=hindsight)
        batch = play(algorithm, env, 30, lambda: {"action": torch.randint(4, (64,)), "subgoal": goal_0})
        train(algorithm.learners["sub"], batch, updates=400)
        errors[hindsight] = largest_errors(algorithm.learners["sub"])
    assert max(errors[True]) < 0.1 and errors[False][0] < 0.1 < 0.3 < errors[False][1]


@pytest.mark.parametrize("hindsight", [True, False])
def test_hindsight_learns_the_value_of_a_choice_that_was_never_made(hindsight):
    """Every option was sent to goal 1 and walked over goal 0 first: 1 now, and 1 a step later."""
    env = small_env(1, **CORRIDOR)
    algorithm = make(make_hdqn, env, meta={"slice_len": 1}, meta_hindsight=hindsight)
    meta, goal_1 = algorithm.learners["meta"], torch.ones(1, dtype=torch.int64)
    world = torch.tensor([6]), torch.tensor([[7, 8]])
    batch = play(algorithm, env, 2, lambda: {"action": torch.tensor([RIGHT]), "subgoal": goal_1}, world)
    assert batch["next", "done"].flatten().tolist() == [False, True]
    train(meta, batch, updates=150)
    with torch.no_grad():
        first, second = meta.network.network.evaluate(batch["observation"][0])
    assert first[1].item() == pytest.approx(1 + GAMMA * 1, abs=0.05)
    assert (abs(first[0].item() - (1 + GAMMA * 1)) < 0.05) == hindsight
    assert (abs(second[1].item() - 1) < 0.05) == hindsight
