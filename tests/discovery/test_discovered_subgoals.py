"""The transform that writes what a step attained, with a detector by hand."""

from copy import deepcopy

import pytest
import torch
from hand_given import BOTH_GOALS, GoalsUnderTheAgent
from helpers import small_env
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose, ExcludeTransform, RenameTransform
from torchrl.envs.utils import check_env_specs, step_mdp

from hdrqn_torchrl.discovery import DiscoveredSubgoals, EventCritic, SubgoalTable
from hdrqn_torchrl.envs import task_of


def make_critic(*, warmup_frames=0):
    critic = EventCritic(GoalsUnderTheAgent(warmup_frames), SubgoalTable(2))
    critic.table.assign(BOTH_GOALS.slots, once=BOTH_GOALS.once)
    return critic


def make_env(critic, num_envs=4, **settings):
    told = RenameTransform(["attained"], ["told"])  # what the environment says itself
    return TransformedEnv(small_env(num_envs, **settings), Compose(told, DiscoveredSubgoals(critic)))


def test_a_step_attains_what_the_table_has_for_its_events():
    after = make_env(make_critic(), 16).rollout(60, break_when_any_done=False)["next"]
    assert after["told"].any() and torch.equal(after["attained"][..., 1:], after["told"])
    assert not after["attained"][..., 0].any()
    assert torch.equal((after["events"] > 0).any(-1), after["told"].any(-1))


def test_a_subgoal_that_was_attained_can_be_chosen_again_in_the_next_episode():
    steps = make_env(make_critic(), 16, max_steps=12).rollout(60, break_when_any_done=False)
    spent = torch.zeros(16, 2, dtype=torch.bool)
    seen = set()
    for step in steps.unbind(1):
        assert torch.equal(step["available"][:, 1:], ~spent)
        assert torch.equal(step["available"][:, 0], spent.all(-1))
        spent = (spent | step["next", "told"]) & ~step["next", "done"]
        seen |= set(map(tuple, spent.tolist()))
    assert len(seen) > 2


def test_before_anything_is_known_an_agent_can_only_explore():
    critic = make_critic(warmup_frames=1)
    assert not make_env(critic).rollout(20, break_when_any_done=False)["next", "events"].any()
    critic.table.assign({})
    available = make_env(critic).rollout(20, break_when_any_done=False)["available"]
    assert available[..., 0].all() and not available[..., 1:].any()


def test_what_the_environment_says_about_subgoals_is_not_needed_and_replaced():
    env = TransformedEnv(small_env(), DiscoveredSubgoals(make_critic()))
    assert env.reset()["attained"].shape == (4, 3)
    bare = TransformedEnv(small_env(), ExcludeTransform("attained"))
    check_env_specs(TransformedEnv(bare, DiscoveredSubgoals(make_critic())))


def test_the_specs_are_right():
    check_env_specs(make_env(make_critic()))
    specs = make_env(make_critic()).observation_spec
    assert {key: list(specs[key].shape) for key in ("events", "attained", "available")} == {
        "events": [4, 2], "attained": [4, 3], "available": [4, 3]
    }  # fmt: skip


def test_a_reset_leaves_the_neighbours_alone():
    env = make_env(make_critic(), 3)
    before = step_mdp(env.rollout(3, break_when_any_done=False)[:, -1])
    before["available"] = torch.tensor([[True, False, False]]).repeat(3, 1)
    before["attained"], before["events"] = torch.ones(3, 3, dtype=torch.bool), torch.ones(3, 2, dtype=torch.int64)
    after = env.reset(before.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    assert after["available"].long().tolist() == [[1, 0, 0], [0, 1, 1], [1, 0, 0]]
    assert after["attained"].all(-1).tolist() == [True, False, True]
    assert after["events"].tolist() == [[1, 1], [0, 0], [1, 1]]


def test_copies_share_the_critic():
    critic = make_critic()
    copy = deepcopy(Compose(DiscoveredSubgoals(critic)))[0]
    assert copy.critic is critic and not list(copy.parameters()) and not list(copy.buffers())


def test_the_task_has_the_discovered_subgoals_in_no_order():
    assert task_of(small_env()).ordered
    task = task_of(TransformedEnv(small_env(), DiscoveredSubgoals(make_critic())))
    assert not task.ordered and task.subgoals[0].names == ("explore", "event 1", "event 2")
    assert task.max_steps == 7


def test_names_follow_what_is_found():
    critic = make_critic()
    names = critic.names
    assert list(names) == ["explore", "goal 1 is gone", "goal 2 is gone"] and names[1:] == tuple(names)[1:]
    critic.table.assign({2: 1})
    assert list(names) == ["explore", "goal 2 is gone", "free 2"]


def test_it_is_no_transform_of_stored_data():
    with pytest.raises(RuntimeError, match="append it to an environment"):
        DiscoveredSubgoals(make_critic())(small_env().rollout(2))
