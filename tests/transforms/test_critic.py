from functools import partial

import pytest
import torch
from helpers import AGENT, CORRIDOR, OBJECTS, RIGHT, build, collect, small_env
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.transforms import ExcludeTransform, RenameTransform
from torchrl.envs.utils import check_env_specs, step_mdp

from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.learning.legs import LegCounter
from hdrqn_torchrl.transforms import Critic, SubgoalTransform


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
    def test_it_holds_the_verdict(self, make):
        torch.manual_seed(0)
        after = make(16).rollout(40, break_when_any_done=False)["next"]
        assert after["attained"].any() and torch.equal(after["attained"], after["collected"].flip(-1))

    def test_specs(self, make):
        check_env_specs(make())
        check_env_specs(SerialEnv(2, make))

    def test_a_reset_attains_nothing_and_leaves_the_neighbours_alone(self, make):
        env = make(3)
        assert not env.reset()["attained"].any()
        before = step_mdp(env.rollout(3, break_when_any_done=False)[:, -1])
        before["attained"] = torch.ones(3, 2, dtype=torch.bool)
        after = env.reset(before.clone().set("_reset", torch.tensor([[False], [True], [False]])))
        assert after["attained"].tolist() == [[True, True], [False, False], [True, True]]


@pytest.mark.parametrize("transform", [partial(Critic, 2), lambda verdict: SubgoalTransform(2, critic=verdict)])
def test_what_the_environment_has_there_is_replaced(transform):
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


def test_a_critic_needs_subgoals():
    with pytest.raises(ValueError, match="num_subgoals must be >= 1, got 0; "):
        Critic(0, mirrored)
