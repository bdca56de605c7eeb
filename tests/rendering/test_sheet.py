"""A sheet of subgoals is read from recorded episodes."""

import math
from itertools import pairwise

import numpy as np
import pytest
from gym_toys import Counter
from gymnasium.wrappers import TimeLimit
from hand_given import BOTH_GOALS, HandGiven
from helpers import build, small_env

from hdrqn_torchrl.envs import Subgoals, make_gym
from hdrqn_torchrl.rendering import draw_sheet, record_episodes, subgoal_records


@pytest.fixture(scope="module")
def agent():
    """One that has found both goals of the small room, and plays at random."""
    agent = build("v3", small_env(1, max_steps=12), subgoals="discovered", discovery=HandGiven(max_subgoals=3))
    agent.policy.critic.detector.frames.fill_(10**6)
    agent.policy.critic.table.assign(BOTH_GOALS.slots, once=BOTH_GOALS.once, frames=640)
    return agent


@pytest.fixture(scope="module")
def frames(agent):
    return record_episodes(agent.transform(small_env(1, max_steps=12)), agent, episodes=20, epsilon=1.0)


def test_records_count_options_and_the_episodes_that_attained_each_subgoal(frames):
    explore, *goals, free = subgoal_records(frames)
    assert [each.name for each in goals] == ["goal 1 is gone", "goal 2 is gone"]
    ends = [frame for frame in frames if frame.outcome]
    for subgoal, record in enumerate(goals, 1):
        assert record.episodes == sum(end.score.reached[subgoal] for end in ends) / 20 > 0
        assert record.options > 0 and 0 < record.reached < 1 and math.isfinite(record.value)
        assert len(record.moments) == round(20 * record.episodes)
    started = [frame for frame in frames if frame.starts_option and not frame.outcome]
    assert sum(each.options for each in (explore, *goals, free)) == len(started)
    assert (free.episodes, free.options, free.moments) == (0.0, 0, ()) and math.isnan(free.value)
    assert not explore.moments


def test_every_option_that_attained_its_subgoal_counts_where_it_can_be_attained_again():
    class Steps(Subgoals):
        names = ("one", "two")
        repeatable = True

        def conditions(self, env, before, after, info):
            return [before is not None and after[0] - before[0] == size for size in (1, 2)]

    env = make_gym(lambda: TimeLimit(Counter(ends=False), 30), 1, subgoals=Steps(), seed=0)
    agent = build("v2", env)
    frames = record_episodes(agent.transform(env), agent, episodes=2, epsilon=1.0)
    pairs = [(before, after) for before, after in pairwise(frames) if not before.outcome]
    attained = sum(after.attained[before.pursuits[-1].decision.choice] for before, after in pairs)
    records = subgoal_records(frames)
    assert attained > 8 and sum(record.reached * record.options for record in records) == pytest.approx(attained)


def test_moments_are_frames_before_and_after_the_step(frames):
    for subgoal, record in enumerate(subgoal_records(frames)):
        for before, after in record.moments:
            assert not before.score.reached[subgoal] and after.score.reached[subgoal]
            assert (after.episode, after.score.steps) == (before.episode, before.score.steps + 1)


def test_a_sheet_has_a_row_for_each_subgoal_that_was_pursued_or_attained(agent, frames):
    records = subgoal_records(frames)
    sheet = draw_sheet(records, found=agent.found)
    assert agent.found == [0, 640, 640, 0]
    assert sheet.dtype == np.uint8 and sheet.shape[-1] == 3
    assert len(draw_sheet(records[:2])) < len(sheet) == len(draw_sheet(records[:3]))
    assert not np.array_equal(sheet, draw_sheet(records))  # it tells when they were found


def test_a_flat_agent_has_no_sheet():
    flat = build("v3", small_env(1), levels=1)
    frames = record_episodes(flat.transform(small_env(1)), flat)
    with pytest.raises(ValueError, match="an agent that pursues subgoals"):
        subgoal_records(frames)
