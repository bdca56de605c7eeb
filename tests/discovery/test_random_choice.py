"""Controls: subgoals at random."""

from functools import cache, partial

import pytest
import torch
from helpers import build, small_env, tiny_settings
from test_agents_that_discover import bare_env, trained
from test_events import CHAIN, DOOR, GOAL, KEY, KEY_ONLY, LATE_NOISE, NOISE, episodes
from torchrl.data import Unbounded

from hdrqn_torchrl.discovery import DiscoverySettings, EventSelection, RandomChanges, RandomSelection

LEARNER = tiny_settings(slice_len=7, frames_per_update=160)
ALL = episodes(*[CHAIN] * 3, *[KEY_ONLY] * 3, *[LATE_NOISE] * 3)


def drawn(seed, number=2):
    torch.manual_seed(seed)
    selection = RandomSelection(5, number=number)
    selection.observe(ALL)
    return selection.update()


def test_the_seed_decides_which_events_are_drawn_and_all_can_be():
    assert drawn(0) == drawn(0)
    sets = [frozenset(drawn(seed).slots) for seed in range(40)]
    assert len(set(sets)) == 6  # of four events two
    assert all(set(drawn(seed).slots.values()) == {1, 2} for seed in range(4))


def test_only_what_was_seen_often_enough_is_drawn():
    selection = RandomSelection(5, number=8)
    selection.observe(episodes(*[KEY_ONLY] * 3, *[LATE_NOISE] * 2))
    assert selection.update().slots == {KEY: 1}


def test_free_slots_are_filled_later_and_then_nothing_changes():
    selection = RandomSelection(5, number=2)
    selection.observe(episodes(*[KEY_ONLY] * 3))
    assert selection.update().slots == {KEY: 1}
    selection.observe(episodes(*[LATE_NOISE] * 3))
    assert selection.update().slots == {KEY: 1, NOISE: 2}
    selection.observe(episodes(*[CHAIN] * 9))
    assert selection.update().slots == {KEY: 1, NOISE: 2}


def test_drawn_events_that_happen_again_are_not_attained_once():
    selection = RandomSelection(5, number=2)
    selection.observe(episodes(*[[(3, GOAL, 0, 1.0), (5, GOAL, 0, 1.0), (7, DOOR, 1, 0.0)]] * 3))
    chosen = selection.update()
    assert chosen.once == [chosen.slots[DOOR]]


def test_a_resumed_selection_draws_the_same():
    first, second = RandomSelection(5, number=3), RandomSelection(5, number=3)
    first.observe(episodes(*[KEY_ONLY] * 3))
    first.update()
    second.load_state_dict(first.state_dict())
    results = []
    for selection in (first, second):
        torch.manual_seed(1)
        selection.observe(ALL)
        results.append(selection.update())
    assert results[0] == results[1] and len(results[0].slots) == 3


@cache
def play(steps=200, seed=0):
    """Random play in the small room."""
    env = small_env(16, num_obstacles=0, seed=seed)
    torch.manual_seed(seed)
    return env.rollout(steps, break_when_any_done=False)


@cache
def taught(seed, number=3):
    torch.manual_seed(seed)
    detector, steps = RandomChanges((5,) * 9, number=number, num_dims=2, warmup_frames=1_600), play()
    torch.manual_seed(seed)
    for batch in steps.split(20, 1):
        detector.observe(batch["observation"], batch["action"], batch["next", "observation"])
    return detector


def test_changes_are_drawn_among_all_that_are_seen():
    detectors = [taught(seed) for seed in range(5)]
    assert all(detector.ready and (detector.drawn > 0).all() for detector in detectors)
    assert len({tuple(detector.drawn.tolist()) for detector in detectors}) > 3
    assert torch.equal(taught.__wrapped__(0).drawn, detectors[0].drawn)


def test_a_drawn_change_is_told_in_each_step_that_has_it_and_no_other():
    detector, steps = taught(0), play(seed=3)
    before, after = steps["observation"], steps["next", "observation"]
    tokens = detector(before, steps["action"], after)
    for slot, token in enumerate(detector.drawn.tolist()):
        place, change = detector.name(token).split(": ")
        row, column = map(int, place.strip("()").split(", "))
        was, now = map(int, change.split(" -> "))
        expected = (before[..., row, column] == was) & (after[..., row, column] == now)
        assert expected.any() and torch.equal(tokens[..., slot] == token, expected)
    assert not RandomChanges((5,) * 9, number=3, num_dims=2)(before, steps["action"], after).any()


def test_drawn_changes_travel_with_weights():
    detector, fresh = taught(0), RandomChanges((5,) * 9, number=3, num_dims=2, warmup_frames=1_600)
    fresh.load_state_dict(detector.state_dict())
    assert fresh.ready and torch.equal(fresh.drawn, detector.drawn)


def test_a_control_reads_nothing_that_the_environment_says_about_subgoals():
    """The same agents with and without it."""
    settings = DiscoverySettings(
        choice="random_changes", max_subgoals=2, random_subgoals=1, warmup_frames=128, discovery_frames=64
    )
    policies = []
    for make in (partial(small_env, 8, num_obstacles=0), partial(bare_env, 8, num_obstacles=0)):
        env = make()
        torch.manual_seed(0)
        agent = build("v3", env, settings=LEARNER, subgoals="discovered", discovery=settings)
        trained(agent, env, batches=9)
        assert agent.monitors["discovery"].metrics()["discovery/subgoals"] == 1
        policies.append(agent.policy.state_dict())
    assert all(torch.equal(value, policies[1][name]) for name, value in policies[0].items())


def test_settings_choose_between_what_is_useful_and_controls():
    spec = small_env().observation_spec["observation"]
    made = [DiscoverySettings(choice=choice).make(spec, 4) for choice in ("useful", "random_events", "random_changes")]
    assert [type(selection) for _, selection in made] == [EventSelection, RandomSelection, RandomSelection]
    assert [type(critic.detector) is RandomChanges for critic, _ in made] == [False, False, True]
    critic, selection = DiscoverySettings(choice="random_changes", random_subgoals=3).make(spec, 4)
    assert (selection.number, critic.detector.num_tokens, critic.table.num_subgoals) == (3, 3, 9)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"choice": "random"}, "choice must be one of useful, random_events, random_changes, got 'random'"),
        ({"random_subgoals": 2}, "random_subgoals must be None, or with .*, got 2 with choice=useful"),
        ({"random_subgoals": 9, "choice": "random_events"}, r"in \[1, 8\] \(max_subgoals\), got 9"),
    ],
)
def test_settings_that_mean_nothing_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        DiscoverySettings(**settings)


def test_changes_can_be_drawn_only_where_there_are_cells_of_codes():
    with pytest.raises(ValueError, match="num_codes must be those of cells of codes"):
        DiscoverySettings(choice="random_changes").make(Unbounded(shape=(2, 4)), 2)
