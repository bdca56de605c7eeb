"""The choice of events that are subgoals."""

import math

import pytest
import torch
from tensordict import TensorDict

from hdrqn_torchrl.discovery import ChangeDetector, Chosen, EventSelection, RandomSelection
from hdrqn_torchrl.discovery.control import Control
from hdrqn_torchrl.discovery.history import History, Occurrences, events_of
from hdrqn_torchrl.discovery.record import EventRecord

KEY, DOOR, GOAL, NOISE, SHADE = 1, 2, 3, 4, 17
PLACES = 10  # of two codes: tokens 1 to 4 belong to place 0
MOVE, DO = 0, 1
T = 20


def make_selection(**settings):
    detector = ChangeDetector((2,) * PLACES, 2)
    detector.order.copy_(torch.arange(PLACES))
    detector.moves[MOVE] = True
    return EventSelection(detector, **settings)


def episodes(*worlds, hazard=None):
    """Episodes of one length; each is a list of (step, token, action, reward)."""
    count = len(worlds)
    tokens = torch.zeros(count, T, 5, dtype=torch.int64)
    action, reward = torch.zeros(count, T, dtype=torch.int64), torch.zeros(count, T, 1)
    done = torch.zeros(count, T, 1, dtype=torch.bool)
    done[:, -1] = True
    for world, events in enumerate(worlds):
        for step, token, act, paid in events:
            tokens[world, step, int((tokens[world, step] > 0).sum())] = token
            action[world, step], reward[world, step] = act, paid
    after = {"events": tokens, "extrinsic_reward": reward, "done": done}
    if hazard is not None:
        after["hazard"] = hazard
    return TensorDict({"action": action, "next": after}, [count, T])


CHAIN = [(3, KEY, DO, 0.0), (9, DOOR, DO, 0.0), (15, GOAL, MOVE, 1.0)]
KEY_ONLY = [(12, KEY, DO, 0.0)]
LATE_NOISE = [(16, NOISE, MOVE, 0.0)]


def test_the_chain_is_found_backwards_from_what_pays():
    selection = make_selection(deeds=False)
    selection.observe(episodes(*[CHAIN] * 6, *[KEY_ONLY] * 10, *[LATE_NOISE] * 10, *[[]] * 10))
    chosen = selection.update()
    assert chosen.slots == {GOAL: 1, DOOR: 2, KEY: 3}
    assert chosen.once == [1, 2, 3]


def test_what_happens_again_in_many_episodes_is_not_attained_once():
    selection = make_selection()
    selection.observe(episodes(*[[(3, GOAL, MOVE, 1.0), (8, GOAL, MOVE, 1.0)]] * 3, [(5, GOAL, MOVE, 1.0)]))
    assert selection.update().once == []


def test_a_slot_stays_attained_once_when_its_event_has_become_part_of_another():
    selection = make_selection()
    selection.observe(episodes(*[[(5, SHADE, MOVE, 1.0)]] * 10))
    assert selection.update().once == [1]
    selection.observe(episodes(*[[(5, KEY, MOVE, 1.0), (5, SHADE, MOVE, 1.0)]] * 200))
    chosen = selection.update()
    assert chosen.slots == {SHADE: 1, KEY: 2} and chosen.once == [1, 2]


@pytest.mark.parametrize("make", [make_selection, lambda **_: RandomSelection(5, number=4)])
def test_subgoals_that_were_taken_over_keep_their_slots_and_what_is_known_of_them(make):
    selection = make(max_subgoals=4)
    selection.take_over(Chosen({KEY: 3, SHADE: 2}, once=[3, 2]))
    selection.observe(episodes(*[CHAIN] * 6, *[[(3, KEY, DO, 0.0), (9, KEY, DO, 0.0)]] * 6))
    chosen = selection.update()
    assert {token: chosen.slots[token] for token in (KEY, SHADE)} == {KEY: 3, SHADE: 2}
    assert sorted(chosen.slots.values()) == list(range(1, len(chosen.slots) + 1)) and len(chosen.slots) == 4
    assert 2 in chosen.once and 3 not in chosen.once  # nothing was seen of the one; the other came again
    other = make(max_subgoals=4)
    other.load_state_dict(selection.state_dict())
    assert other.update() == chosen


def test_what_costs_is_no_subgoal():
    hazard = torch.zeros(6, T, 1, dtype=torch.bool)
    hazard[:, 4] = True
    selection = make_selection()
    selection.observe(episodes(*[[(4, DOOR, DO, 1.0), (8, KEY, DO, -0.5)]] * 6, hazard=hazard))
    assert selection.update().slots == {}


def test_deeds_fill_what_is_left_and_make_place_for_what_pays():
    selection = make_selection(max_subgoals=2)
    selection.observe(episodes(*[KEY_ONLY] * 5, *[[(7, DOOR, DO, 0.0)]] * 4, *[LATE_NOISE] * 9))
    assert selection.update().slots == {KEY: 1, DOOR: 2}
    selection.observe(episodes(*[[(15, GOAL, MOVE, 1.0)]] * 4))
    assert selection.update().slots == {KEY: 1, GOAL: 2}


def test_a_token_that_comes_with_a_nearer_one_is_no_event_of_its_own():
    selection = make_selection()
    step = [(5, KEY, DO, 0.0), (5, SHADE, DO, 0.0)]
    selection.observe(episodes(*[step] * 9, [(6, SHADE, DO, 0.0)]))
    history = selection._record.history()
    assert events_of(history, selection.detector.precedence(), least=3) == [KEY]
    assert events_of(history, selection.detector.precedence(), least=3, absorbed=0.95) == [KEY, SHADE]
    assert events_of(history, selection.detector.precedence(), least=10) == [SHADE]


def test_evidence_is_the_likelihood_ratio_against_chance():
    """Two of four episodes of 20 steps have DOOR, both after KEY, which is past in 16 + 16 of 80 steps."""
    selection = make_selection()
    selection.observe(episodes(CHAIN, CHAIN, [], []))
    found = Occurrences(selection._record.history(), [KEY, DOOR])
    evidence, share = found.evidence(1, [])
    assert share.tolist() == [1.0, 0.0]
    assert evidence[0].item() == pytest.approx(2 * math.log((4 * T + 1) / (2 * 16 + 1)))
    given, _ = found.evidence(1, [0])
    assert given[0].item() == pytest.approx(0.0, abs=1e-9)


def test_an_episode_that_was_lost_between_two_batches_is_one_of_its_own():
    record, (batch,) = EventRecord(5), episodes([(3, KEY, DO, 0.0)]).split(1)
    batch["next", "done"][:] = False
    record.add(batch.set("is_init", torch.zeros(1, T, 1, dtype=torch.bool)))
    again = batch.clone()
    again["is_init"][:, 0] = True
    record.add(again)
    assert record.history().lengths.tolist() == [T, T]
    assert Occurrences(record.history(), [KEY]).repeated.tolist() == [0]


def test_episodes_go_on_from_batch_to_batch():
    selection = make_selection()
    batch = episodes(CHAIN, [])
    batch["next", "done"][0, :, :] = False
    batch["next", "done"][0, 8] = True
    selection.observe(batch)
    selection.observe(batch)
    history = selection._record.history()
    assert isinstance(history, History)
    assert history.lengths.tolist() == [9, 20, 11, 20, 20]
    assert list(zip(history.episode.tolist(), history.step.tolist(), strict=True)) == [
        (0, 3), (1, 0), (1, 6), (1, 14), (2, 0), (2, 6)
    ]  # fmt: skip


@pytest.mark.parametrize("world", [0, 3])
def test_worlds_without_events_have_episodes_too(world):
    record = EventRecord(5)
    batch = episodes(*[[(5, KEY, DO, 0.0)] if index == world else [] for index in range(4)])
    batch["next", "done"][:] = False
    record.add(batch)
    assert record.history().lengths.tolist() == [20] * 4


def test_a_resumed_selection_goes_on_as_it_was():
    first, second = make_selection(), make_selection()
    first.observe(episodes(*[CHAIN] * 6, *[[]] * 10))
    first.update()
    second.load_state_dict(first.state_dict())
    for selection in (first, second):
        selection.observe(episodes(*[LATE_NOISE] * 3, *[KEY_ONLY] * 13))
    assert first.update() == second.update()
    assert first.reasons == second.reasons


def pursuit(active, attained, subgoals=3):
    count = len(active)
    active, attained = torch.tensor(active), torch.nn.functional.one_hot(torch.tensor(attained), subgoals).bool()
    attained[..., 0] = False
    mask = torch.ones(count, subgoals, dtype=torch.bool)
    return TensorDict({"subgoal_mask": mask, "next": {"active_subgoal": active, "attained": attained}}, [count])


def trial(attained, others, steps=100):
    """As many steps in pursuit of subgoal 1 as of 2, and how often each attained subgoal 1."""
    reached = [1] * attained + [0] * (steps - attained) + [1] * others + [0] * (steps - others)
    return pursuit([1] * steps + [2] * steps, reached)


def test_a_subgoal_fails_if_its_pursuit_does_not_bring_it_about_in_six_trials_in_a_row():
    control = Control(3, trial_steps=100)
    for attained in (30, 30, 40, 30, 30, 30, 30, 30):  # the third one resets the count
        control.observe(trial(attained, 30))
        assert not control.failed.any()
    control.observe(trial(30, 30))
    assert control.failed.tolist() == [False, True, False]
    control.reset(1)
    assert not control.failed.any()


def test_what_comes_too_rarely_to_tell_is_no_failure():
    control = Control(3, trial_steps=100)
    for _ in range(40):
        control.observe(trial(0, 1))  # 20 are expected after twenty of them
    assert control.trials[1] == 2
    for _ in range(40):
        control.observe(trial(0, 0))
    assert not control.failed.any()


def test_a_deed_that_fails_gives_its_slot_away_and_comes_back_only_if_it_pays_or_leads():
    selection = make_selection(max_subgoals=1)
    selection.observe(episodes(*[KEY_ONLY] * 5, *[[(7, DOOR, DO, 0.0)]] * 4))
    assert selection.update().slots == {KEY: 1}
    selection.control.failed[1] = True
    assert selection.update().slots == {DOOR: 1}
    selection.observe(episodes(*[[(12, KEY, DO, 1.0)]] * 9))
    assert selection.update().slots == {KEY: 1}


def test_what_pays_or_leads_is_kept_however_hard_it_is_to_bring_about():
    selection = make_selection(max_subgoals=3)
    selection.observe(episodes(*[CHAIN] * 6, *[KEY_ONLY] * 10, *[LATE_NOISE] * 10, *[[]] * 10))
    chosen = selection.update()
    selection.control.failed[:] = True
    assert selection.update() == chosen and len(chosen.slots) == 3
