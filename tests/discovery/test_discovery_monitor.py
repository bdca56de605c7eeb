"""When subgoals are looked for, and what happens to memories."""

from itertools import islice

import pytest
import torch
from hand_given import BOTH_GOALS, HandGiven
from helpers import build, make_collector, small_env, tiny_settings

from hdrqn_torchrl.discovery import Chosen
from hdrqn_torchrl.modules import SuccessEpsilonGreedy

FRAMES = 32  # of a batch: four worlds, eight steps


def agent_and_batches(batches=8, learner=None, name="v3", sub_exploration=None, **settings):
    """An agent that has seen nothing yet, and what it goes on to see."""
    env = small_env()
    discovery = HandGiven(max_subgoals=2, **({"warmup_frames": 1, "discovery_frames": 64} | settings))
    settings = tiny_settings(slice_len=7, **(learner or {}))
    options = {"sub_exploration": sub_exploration} | ({} if name == "v3" else {"sub_hindsight": True})
    agent = build(name, env, settings=settings, subgoals="discovered", discovery=discovery, **options)
    return agent, islice(make_collector(agent, env, 8), batches)


def test_memories_forget_the_steps_whose_events_are_unknown():
    agent, batches = agent_and_batches(4, warmup_frames=2 * FRAMES, learner={"warmup_frames": 40})
    learner, stored = agent.learners["joint"], []
    for batch in batches:
        agent.observe(batch)
        stored.append(len(learner.buffer))
    assert stored == [FRAMES, 0, FRAMES, 2 * FRAMES]
    assert agent.monitors["discovery"].selection.steps == 2 * FRAMES
    assert learner.schedule.frames_owed == 4 * FRAMES - 2 * FRAMES - 40


def test_subgoals_are_looked_for_every_discovery_frames_until_until_frames():
    agent, batches = agent_and_batches(8, discovery_frames=50, until_frames=160)
    discovery, asked = agent.monitors["discovery"], []
    for batch in batches:
        agent.observe(batch)
        asked.append(discovery.selection.asked)
    assert asked == [0, 1, 1, 2, 3, 3, 3, 3]  # where 50, 100 and 150 frames were passed


def test_the_look_that_is_due_at_until_frames_is_taken_though_the_batch_ends_later():
    agent, batches = agent_and_batches(6, discovery_frames=50, until_frames=100)
    for batch in batches:
        agent.observe(batch)
    assert agent.monitors["discovery"].selection.asked == 2


def test_stored_steps_are_told_anew_and_minibatches_drawn_before_are_forgotten():
    agent, batches = agent_and_batches(4, chosen=(Chosen({}), BOTH_GOALS))
    learner = agent.learners["joint"]
    for batch in islice(batches, 3):
        agent.observe(batch)
    learner.sample()
    assert learner.replay._drawn and not learner.buffer.storage[:]["next", "attained"].any()
    agent.observe(next(batches))
    stored = learner.buffer.storage[:]
    assert not learner.replay._drawn and torch.equal(
        stored["next", "attained"].any(-1), (stored["next", "events"] > 0).any(-1)
    )
    assert stored["next", "attained"].any() and stored["subgoal_mask"][..., 1:].any()


def test_v2_relabels_steps_and_forgets_options_whose_subgoal_has_another_meaning_now():
    agent, batches = agent_and_batches(6, name="v2", chosen=(Chosen({1: 1}), BOTH_GOALS, Chosen({2: 1})))
    stored = {name: [] for name in agent.learners}
    for batch in batches:
        agent.observe(batch)
        for name, learner in agent.learners.items():
            stored[name].append(len(learner.buffer))
            if len(stored["sub"]) == 4:  # the second goal is new: options could not choose it
                assert not len(agent.learners["meta"].buffer)
                steps = agent.learners["sub"].buffer.storage[:]
                assert torch.equal(steps["next", "attained"].any(-1), (steps["next", "events"] > 0).any(-1))
                assert steps["subgoal_mask"][..., 2].any()
    assert [rows // FRAMES for rows in stored["sub"]] == [0, 1, 2, 3, 4, 0]  # the first batch taught the detector
    assert all(bool(rows) == has for rows, has in zip(stored["meta"], [0, 0, 1, 0, 1, 0], strict=True))


@pytest.mark.parametrize("name", ["v2", "v3"])
def test_exploration_by_success_begins_again_where_a_subgoal_has_another_meaning_now(name):
    exploration = SuccessEpsilonGreedy(1.0, 0.05)
    chosen = Chosen({1: 1, 2: 2}), Chosen({2: 2}), Chosen({5: 1, 2: 2})
    agent, batches = agent_and_batches(6, name=name, chosen=chosen, sub_exploration=exploration)
    success = agent.explorations["sub"].success
    assert success is exploration.success
    for number, batch in enumerate(batches):
        agent.observe(batch)
        if number == 2:
            success.rates[1:], success.options[1:] = 0.9, 500
    assert success.options[1] < 100 <= success.options[2] and success.rates[2] > 0 == success.rates[1]


def test_options_that_wait_for_the_end_of_their_episode_are_forgotten_too():
    agent, batches = agent_and_batches(8, name="v2", chosen=(Chosen({1: 1}), BOTH_GOALS, Chosen({2: 1})))
    for batch in islice(batches, 5):
        agent.observe(batch)
    assert len(agent.learners["meta"].extract.state_dict()["held"])
    last = next(batches)
    agent.observe(last)
    assert agent.learners["meta"].extract.state_dict()["held"] is None
    for batch in batches:
        agent.observe(batch)
    options = agent.learners["meta"].buffer.storage[:]
    steps = agent.learners["sub"].buffer.storage[:]
    begun = steps["option_init"].sum()
    assert len(options) > 0 and options["next", "option_steps"].bool().sum() <= begun


def test_each_subgoal_reports_when_it_was_found():
    chosen = (Chosen({1: 1}), BOTH_GOALS, Chosen({2: 1}), Chosen({2: 1, 5: 1}))
    agent, batches = agent_and_batches(8, chosen=chosen)
    discovery, rows = agent.monitors["discovery"], []
    assert discovery.metrics() == {"discovery/subgoals": 0, "discovery/found_1": 0, "discovery/found_2": 0}
    for batch in batches:
        agent.observe(batch)
        rows.append(tuple(discovery.metrics().values()))
    assert rows[1::2] == [(1, 64, 0), (2, 64, 128), (1, 192, 0), (1, 192, 0)]


def test_its_state_is_all_that_it_goes_on_with():
    agent, batches = agent_and_batches(4)
    for batch in batches:
        agent.observe(batch)
    other, _ = agent_and_batches(0)
    discovery, copy = agent.monitors["discovery"], other.monitors["discovery"]
    copy.load_state_dict(discovery.state_dict())
    other.policy.load_state_dict(agent.policy.state_dict())
    assert copy.state_dict() == discovery.state_dict() and copy.frames == 4 * FRAMES
    assert copy.critic.detector.ready and copy.critic.table.tokens_of(2) == [2]


@pytest.mark.parametrize("name", ["max_subgoals", "warmup_frames", "discovery_frames", "until_frames"])
def test_settings_below_1_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be >= 1, got 0"):
        HandGiven(**{name: 0})
