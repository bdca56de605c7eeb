from dataclasses import replace

import pytest
from helpers import RIGHT
from walk import FIRST_GOAL, SECOND_GOAL, walk, with_values

from hdrqn_torchrl.rendering import BarSpans, Decision, bar_spans
from hdrqn_torchrl.rendering.levels import caption, levels_of


def pursuing(frame, decision):
    """The frame with another decision for its subgoal."""
    return replace(frame, pursuits=(replace(frame.pursuits[0], decision=decision),))


def test_spans_are_round_numbers_just_above_the_median_distance_from_best_to_worst():
    frames = walk("v2")
    # 0.5 - -0.125 and 1.0 - 0.5; a single goal left has no distance
    assert bar_spans(frames) == BarSpans(action=1.0, subgoal=0.5)
    worst = (0.886, 0.887, -0.1, 9.0)
    close = [with_values(frame, (0.9, 0.89, 0.895, value)) for frame, value in zip(frames, worst, strict=True)]
    assert bar_spans(close).action == pytest.approx(0.02)  # the last frame of an episode repeats a decision
    assert bar_spans([with_values(frames[0], (0.5,) * 4)]).action == pytest.approx(1e-3)
    assert bar_spans(walk("dqn")) == BarSpans(action=1.0, subgoal=1.0)


def test_a_long_option_counts_once():
    start, on, *_ = walk("v2")
    options = [replace(start.subgoal, values=(best, 0.0)) for best in (0.4, 0.6)]
    frames = [pursuing(start, option) for option in options] + [pursuing(on, options[1])] * 5
    assert bar_spans(frames).subgoal == pytest.approx(0.5)


def test_bars_show_the_distance_to_the_best():
    meta, sub = levels_of(walk("v2")[0], BarSpans(action=0.5, subgoal=1.0))
    assert [meta.bar(0), meta.bar(1)] == [1.0, 0.5]
    assert [sub.bar(index) for index in range(4)] == [0.0, 0.0, 0.5, 1.0]
    assert sub.decision.choice == RIGHT


def test_masked_choices_have_no_bar_and_are_never_the_best():
    decision = Decision(values=(3.0, 1.0, 0.5), allowed=(False, True, True), choice=1)
    assert decision.best == 1 and not decision.explores
    level = replace(levels_of(walk("v2")[0], BarSpans())[0], decision=decision)
    assert [level.bar(index) for index in range(3)] == [0.0, 1.0, 0.5]
    assert [level.remark(index) for index in range(3)] == ["not now", "", ""]


def test_if_nothing_is_allowed_anything_may_be_the_best():
    assert Decision(values=(1.0, 2.0), allowed=(False, False), choice=1).best == 1


def test_levels_have_names_and_notes_on_duration_and_random_choice():
    started, on, *_ = walk("v2")
    assert [level.note for level in levels_of(started, BarSpans())] == ["just chosen", ""]
    assert [level.note for level in levels_of(on, BarSpans())] == ["for 1 step", ""]
    assert [level.note for level in levels_of(walk("v2", wants=SECOND_GOAL)[2], BarSpans())] == ["for 2 steps", ""]
    by_chance = pursuing(with_values(on, (1.0, 0.0), choice=1), replace(on.subgoal, choice=1))
    assert [level.note for level in levels_of(by_chance, BarSpans())] == ["at random for 1 step", "at random"]
    assert [level.symbol for level in levels_of(on, BarSpans())] == ["Qᴹ", "Qˢ"]
    assert [level.symbol for level in levels_of(walk("drqn")[0], BarSpans())] == ["Q"]


def test_captions_say_what_happened_in_a_step():
    assert [caption(frame) for frame in walk("v2", wants=FIRST_GOAL)] == [
        "chooses goal 1",
        "obstacle hit",
        "goal 1 reached, rᵉˣ +1.00; chooses goal 2",
        "goal 2 reached, rᵉˣ +1.00; both goals in order, return 1.00",
    ]
    assert [caption(frame) for frame in walk("drqn", max_steps=1)] == ["", "obstacle hit; time is up, return -1.00"]
