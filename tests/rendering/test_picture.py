from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from walk import FLAT, TWO_LEVELS, make_agent, walk, with_values

from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.rendering import BarSpans, Decision, bar_spans, draw_frame, record_episodes
from hdrqn_torchrl.rendering.levels import ACTION_COLOUR

BLUE, GREEN, PALE, EMPTY = (31, 119, 180), (44, 160, 44), (200, 200, 200), (242, 242, 242)
RIGHT_COLUMN = np.s_[:, 400:]
CAPTION = np.s_[416:]


def bars(picture, colour, least=4):
    """Lengths of the horizontal bars of a colour in the right-hand column, from top to bottom."""
    lengths = [run(row) for row in (picture[210:416, 470:692] == colour).all(-1)]
    starts = [at for at in range(1, len(lengths)) if lengths[at] >= least and lengths[at - 1] < least]
    return [lengths[at + 2] for at in starts]


def run(row):
    """Longest run of ``True``."""
    longest = length = 0
    for value in row:
        length = length + 1 if value else 0
        longest = max(longest, length)
    return longest


@pytest.mark.parametrize(
    "task",
    [{}, {"layout": "four_rooms", "view": 3, "num_goals": 3}, {"num_goals": 6, "view": None, "max_steps": 4}],
    ids=str,
)
@pytest.mark.parametrize("name", [*FLAT, *TWO_LEVELS])
def test_every_algorithm_and_task_is_drawn(name, task):
    env = MultiGoalGridEnv(1, **({"max_steps": 3} | task))
    agent = make_agent(name, env)
    frames = record_episodes(agent.transform(env), agent, epsilon=0.5)
    pictures = [draw_frame(frame, bar_spans(frames)) for frame in frames]
    assert {(picture.shape, picture.dtype) for picture in pictures} == {((456, 760, 3), np.dtype(np.uint8))}
    assert all((first != second).any() for first, second in pairwise(pictures))


def test_lengths_of_bars_follow_the_values():
    frame = with_values(walk("drqn")[0], (0.5, 0.4, 0.25, -9.0))
    picture = draw_frame(frame, BarSpans(action=0.5))
    best, (second, third) = bars(picture, ACTION_COLOUR)[-1], bars(picture, PALE)
    assert best == max(bars(picture, EMPTY)) > 180
    assert (second / best, third / best) == pytest.approx((0.8, 0.5), abs=0.02)


def test_the_chosen_bar_has_the_colour_of_its_subgoal():
    picture = draw_frame(walk("v2")[0], BarSpans(subgoal=1.0))
    (chosen,) = bars(picture, BLUE)[-1:]
    assert bars(picture, PALE)[0] / chosen == pytest.approx(0.5, abs=0.02)
    second = draw_frame(walk("v2")[2], BarSpans(subgoal=1.0))  # goal 1 is reached and has no bar any more
    assert not bars(second, BLUE) and bars(second, GREEN)[-1] == chosen
    assert len(bars(second, PALE)) == len(bars(picture, PALE)) - 1


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"score": {"extrinsic": 0.5}}, RIGHT_COLUMN),
        ({"score": {"intrinsic": 0.5}}, RIGHT_COLUMN),
        ({"score": {"option_intrinsic": 0.5}}, RIGHT_COLUMN),
        ({"score": {"steps": 7}}, np.s_[:40, :400]),
        ({"pursuits": {"steps": 7}}, RIGHT_COLUMN),
        ({"scene": {"subgoal": 1}}, np.s_[40:416]),
        ({"scene": {"action": 0}}, np.s_[40:416]),
        ({"pursuits": {"decision": Decision((1.0, 0.5), (True, True), 1)}}, RIGHT_COLUMN),
        ({"action": {"choice": 1}}, RIGHT_COLUMN),
        ({"episode": 2}, np.s_[:40, :400]),
        ({"max_steps": None}, np.s_[:40, :400]),
        ({"event": "something else"}, CAPTION),
        ({"outcome": "the end"}, CAPTION),
    ],
    ids=str,
)
def test_every_fact_is_drawn_in_its_place(change, where):
    frame = walk("v2")[1]
    (name, value), *_ = change.items()
    if isinstance(value, dict):
        kept = getattr(frame, name)
        value = (replace(kept[0], **value),) if name == "pursuits" else replace(kept, **value)
    changed = replace(frame, **{name: value})
    differs = (draw_frame(frame) != draw_frame(changed)).any(-1)
    elsewhere = differs.copy()
    elsewhere[where] = False
    assert differs.any() and not elsewhere.any()


def test_the_end_of_an_episode_is_a_banner_in_the_colour_of_success():
    end = walk("v2")[-1]
    for success, colour in ((True, GREEN), (False, (112, 112, 112))):
        picture = draw_frame(replace(end, success=success))
        assert (picture[CAPTION] == colour).all(-1).mean() > 0.4
