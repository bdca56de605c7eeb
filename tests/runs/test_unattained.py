"""Warnings of subgoals that nobody attains."""

import warnings

import pytest
import torch
from helpers import build, house, make_collector, small_env
from tensordict import TensorDict

from hdrqn_torchrl.envs import SubgoalSet
from hdrqn_torchrl.runs.unattained import EPISODES, UnattainedSubgoals

ROOMS, GOALS = SubgoalSet(names=("hall", "attic"), prefix="rooms"), SubgoalSet(names=("key", "door"))


def batch(rooms, goals, episodes=EPISODES):
    """One step of as many worlds, all of which end; the first one attained these subgoals."""
    done, attained = torch.ones(episodes, 1, 1, dtype=torch.bool), torch.zeros(2, episodes, 1, 2, dtype=torch.bool)
    attained[:, 0, 0] = torch.tensor([rooms, goals], dtype=torch.bool)
    return TensorDict({"next": {"done": done, "rooms_attained": attained[0], "attained": attained[1]}}, [episodes, 1])


def told(watch, share=0.5):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        watch.warn(share)
    return [str(each.message) for each in found]


def test_those_that_nobody_attained_are_named_once():
    watch = UnattainedSubgoals([ROOMS, GOALS])
    watch.observe(batch([1, 0], [0, 0]))
    watch.observe(batch([0, 0], [0, 1]))
    (message,) = told(watch)
    assert message.startswith("subgoals should be attained now and then while an agent explores, got none of ")
    assert f"['attic', 'key'] in {2 * EPISODES} episodes" in message
    watch.observe(batch([0, 0], [0, 0]))
    assert told(watch) == []


def test_nothing_is_said_where_all_are_attained():
    watch = UnattainedSubgoals([GOALS])
    watch.observe(batch([0, 0], [1, 1]))
    assert told(watch) == []


def test_a_resumed_training_knows_what_was_seen_before():
    first, second, third = (UnattainedSubgoals([ROOMS, GOALS]) for _ in range(3))
    first.observe(batch([1, 1], [0, 1]))
    second.load_state_dict(first.state_dict())
    second.observe(batch([0, 0], [0, 0]))
    (message,) = told(second)
    assert f"['key'] in {2 * EPISODES} episodes" in message
    third.load_state_dict(second.state_dict())
    assert told(third) == []  # once for each training


@pytest.mark.parametrize(("episodes", "share"), [(EPISODES - 1, 0.5), (EPISODES, 0.09)])
def test_it_waits_until_there_was_time_enough(episodes, share):
    watch = UnattainedSubgoals([GOALS])
    watch.observe(batch([0, 0], [0, 0], episodes))
    assert told(watch, share) == []
    watch.observe(batch([0, 0], [0, 0]))
    assert len(told(watch)) == 1


@pytest.mark.parametrize(
    ("name", "worlds", "options", "pursued"),
    [
        ("v2", small_env, {}, [""]),
        ("v3", small_env, {}, [""]),
        ("v3", house, {"levels": 3}, ["rooms", ""]),
        ("v3", house, {"levels": 1}, []),
        ("drqn", house, {}, []),
        ("v3", small_env, {"subgoals": "discovered"}, []),
    ],
)
def test_an_agent_is_watched_for_the_subgoals_that_it_was_given(name, worlds, options, pursued):
    env = worlds(4)
    algorithm = build(name, env, **options)
    assert [each.prefix for each in algorithm.pursued] == pursued
    watch = UnattainedSubgoals(algorithm.pursued)
    collector = make_collector(algorithm, env, 30)
    watch.observe(next(iter(collector)))
    collector.shutdown()
    assert len(watch.names()) < sum(map(len, algorithm.pursued)) or not pursued
