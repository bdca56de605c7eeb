from functools import partial

import pytest
import torch
from gym_toys import Counter, Milestones
from helpers import AGENT, CORRIDOR, OBJECTS, RIGHT, build, collect, small_env
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.transforms import ExcludeTransform, RenameTransform
from torchrl.envs.utils import check_env_specs, step_mdp

from hdrqn_torchrl.envs import MultiGoalGridEnv, make_gym, task_of
from hdrqn_torchrl.learning.legs import LegCounter
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.transforms import Critic, SubgoalTransform

GOALS = task_of(small_env()).subgoals[-1].names


def mirrored(after):
    """The goals in the other order, from an entry that no part of an agent reads."""
    return after["collected"].flip(-1)


def bare_env(num_envs=4, **settings):
    """The small room without ``attained``."""
    return TransformedEnv(small_env(num_envs, **settings), RenameTransform(["attained"], ["collected"]))


def critic_env(num_envs=4, **settings):
    return TransformedEnv(bare_env(num_envs, **settings), Critic(2, mirrored))


def book_env(num_envs=4):
    return TransformedEnv(bare_env(num_envs), SubgoalTransform(2, critic=mirrored))


@pytest.mark.parametrize("make", [critic_env, book_env])
class TestAttained:
    def test_attained_holds_the_verdict_of_the_critic(self, make):
        torch.manual_seed(0)
        after = make(16).rollout(40, break_when_any_done=False)["next"]
        assert after["attained"].any() and torch.equal(after["attained"], after["collected"].flip(-1))

    def test_the_specs_of_a_critic_are_right(self, make):
        check_env_specs(make())
        check_env_specs(SerialEnv(2, make))

    def test_a_reset_attains_nothing_and_leaves_the_neighbours_alone(self, make):
        env = make(3)
        assert not env.reset()["attained"].any()
        before = step_mdp(env.rollout(3, break_when_any_done=False)[:, -1])
        before["attained"] = torch.ones(3, 2, dtype=torch.bool)
        after = env.reset(before.clone().set("_reset", torch.tensor([[False], [True], [False]])))
        assert after["attained"].tolist() == [[True, True], [False, False], [True, True]]


@pytest.mark.parametrize("number", [2, 3])
def test_what_the_environment_says_of_its_own_subgoals_does_not_hold_for_those_of_a_critic(number):
    def counted(after):
        return torch.stack([after["observation"][..., 0] == count for count in (6, 7, 8)[:number]], -1)

    env = TransformedEnv(make_gym(Counter, 4, subgoals=Milestones(), seed=0), Critic(number, counted))
    check_env_specs(env)
    assert "available" in env.base_env.rollout(2) and "available" not in env.rollout(2)
    agent = build("v3", env, compact_network(8, (8,)))
    steps = agent.transform(env).rollout(30, agent.policy, break_when_any_done=False)
    left = steps["subgoal_mask"][:, :-1] & ~steps["next", "attained"][:, :-1]
    goes_on = ~steps["next", "done"][:, :-1]
    assert left.any() and torch.equal(left & goes_on, steps["subgoal_mask"][:, 1:] & goes_on)
    critic = Critic(number, counted, keeps_available=True)
    assert "available" in TransformedEnv(make_gym(Counter, 4, subgoals=Milestones(), seed=0), critic).rollout(2)


@pytest.mark.parametrize("transform", [partial(Critic, 2), lambda verdict: SubgoalTransform(2, critic=verdict)])
def test_the_critic_replaces_the_entry_of_the_environment(transform):
    base = MultiGoalGridEnv(1, layout=CORRIDOR, num_obstacles=1, seed=0)
    env = TransformedEnv(base, transform(lambda after: after["attained"].flip(-1)))
    td = env.reset().set("subgoal", torch.zeros(1, dtype=torch.int64)).set("action", torch.tensor([RIGHT]))
    base.set_world(AGENT, OBJECTS[:, [1, 0, 2]])  # goal 0 is next to the agent
    assert env.step(td)["next", "attained"].tolist() == [[False, True]]


@pytest.mark.parametrize(("name", "settings"), [("v2", {"sub_hindsight": True}), ("v3", {})])
def test_agents_learn_on_an_environment_whose_subgoals_come_from_a_critic_only(name, settings):
    torch.manual_seed(0)
    env = critic_env(8)
    agent, legs = build(name, env, **settings), LegCounter(2)
    for batch in collect(agent, env, 12, batches=4):
        agent.observe(batch)
        legs.observe(batch)
        for learner in agent.learners.values():
            for _ in range(learner.updates_due()):
                assert torch.isfinite(learner.learn()["loss"])
    assert all(learner.updates for learner in agent.learners.values())
    attained = batch["next", "attained"]
    reached = attained.gather(-1, batch["next", "active_subgoal"].unsqueeze(-1))
    assert torch.equal(reached, batch["next", "subgoal_reached"]) and legs.options.sum() > 0


def test_without_a_critic_such_an_environment_is_refused():
    env = TransformedEnv(small_env(), Compose(ExcludeTransform("attained")))
    with pytest.raises(ValueError, match=r"'attained' must be .* bool, it is missing"):
        build("v3", env)


@pytest.mark.parametrize(
    ("settings", "sets"),
    [
        ({}, [("", ("subgoal 0", "subgoal 1", "subgoal 2"))]),
        ({"names": ("left", "right", "obstacle")}, [("", ("left", "right", "obstacle"))]),
        ({"prefix": "places"}, [("places", ("subgoal 0", "subgoal 1", "subgoal 2")), ("", GOALS)]),
    ],
)
def test_the_task_has_the_critics_subgoals(settings, sets):
    """Another number of them than the environment's own, or one set more, for an agent of three levels."""
    critic = Critic(3, lambda after: torch.cat([after["collected"], after["hazard"]], -1), **settings)
    base = small_env(4)
    renamed = TransformedEnv(base, RenameTransform(["attained"], ["collected"], create_copy="prefix" in settings))
    env = TransformedEnv(renamed, critic)
    assert [(each.prefix, each.names) for each in task_of(env).subgoals] == sets
    agent = build("v3", env, levels=len(sets) + 1)
    assert [view.choice_names for view in agent.levels[1:]] == [names for _, names in sets]
    steps = agent.transform(env).rollout(10, agent.policy, break_when_any_done=False)
    assert steps["next", critic.attained_key].shape[-1] == 3


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_subgoals": 0}, "num_subgoals must be a whole number >= 1, got 0; "),
        ({"num_subgoals": 2, "names": ("a",)}, "names must be one for each of 2 subgoals, got 1"),
    ],
)
def test_wrong_settings_of_a_critic_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Critic(verdict=mirrored, **settings)


@pytest.mark.parametrize(
    ("verdict", "got"),
    [
        (lambda after: after["collected"][:, :1], r"got \[4, 1\] torch.bool"),
        (lambda after: after["collected"].float(), r"got \[4, 2\] torch.float32"),
        (lambda after: after["collected"].T, r"got \[2, 4\] torch.bool"),
        (lambda after: after["collected"].numpy(), r"got array\("),
        (lambda after: None, "got None"),
    ],
    ids=["one column", "numbers", "transposed", "numpy", "nothing"],
)
def test_a_verdict_of_another_kind_is_refused_in_its_first_step(verdict, got):
    env = TransformedEnv(bare_env(), Critic(2, verdict))
    with pytest.raises(ValueError, match=rf"verdict must return .*num_subgoals=2 .*\[4, 2\] torch.bool, {got}"):
        env.rollout(2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("2", mirrored), "num_subgoals must be a whole number >= 1, got '2'"),
        ((0, mirrored), "num_subgoals must be a whole number >= 1, got 0"),
        ((2, "mirrored"), "verdict must be a function of what followed a step, got 'mirrored'"),
    ],
)
def test_a_critic_without_columns_or_function_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Critic(*arguments)
