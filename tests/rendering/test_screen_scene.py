import numpy as np
import pytest
from PIL import Image

pytest.importorskip("ale_py")

from hdrqn_torchrl.algorithms import make_hdrqn
from hdrqn_torchrl.envs import make_montezuma
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.rendering import draw_frame, draw_text, record_episodes, scene_of


@pytest.fixture(scope="module")
def frames():
    env = make_montezuma(1, seed=0, max_steps=12)
    agent = make_hdrqn(env, compact_network(8, (8,)))
    return record_episodes(agent.transform(env), agent, epsilon=1.0)


def test_frames_of_the_screen_can_be_drawn(frames):
    assert draw_frame(frames[0]).shape == (456, 760, 3)
    assert frames[-1].outcome in ("died", "time is up")
    assert (draw_frame(frames[0]) != draw_frame(frames[3])).any()
    draw_text(frames[0])


def test_subgoals_and_actions_of_the_screen_have_readable_names(frames):
    scene = frames[0].scene
    assert scene.subgoal_names[:4] == ("middle ladder, foot", "right ladder, foot", "left ladder, foot", "key")
    assert len(scene.action_names) == 18 and scene.action_names[11] == "jump →"
    assert len(set(scene.subgoal_colours)) == 6


def picture(subgoal=None, view=70):
    env = make_montezuma(1, seed=0, view=view)
    env.reset()
    return scene_of(env.base_env, subgoal=subgoal)


def difference(first, second):
    """Box of the pixels in which two pictures differ."""
    changed = (np.asarray(first) != np.asarray(second)).any(-1)
    rows, columns = np.flatnonzero(changed.any(1)), np.flatnonzero(changed.any(0))
    return columns[0], rows[0], columns[-1] + 1, rows[-1] + 1


def test_the_active_subgoal_is_marked_where_it_is():
    plain, marked = (picture(subgoal).draw_world(320) for subgoal in (None, 3))
    assert plain.size == (320, 240)
    left, top, right, bottom = difference(plain, marked)
    assert (left, top, right, bottom) == pytest.approx((20, 100 * 8 / 7, 44, 124 * 8 / 7), abs=4)  # the key's box


def test_the_window_is_outlined_and_shown():
    seen, whole = picture(), picture(view=None)
    left, top, right, bottom = difference(seen.draw_world(320), whole.draw_world(320))
    assert (right - left, bottom - top) == pytest.approx((70 * 2, 70 * 240 / 210), abs=3)
    assert seen.draw_view(88).size == (88, 88)
    assert np.asarray(seen.draw_view(44)).std() > 10


def test_lines_of_text_have_the_stated_width():
    lines = picture().write_world().plain.split("\n")
    assert {len(line) for line in lines} == {53} and 20 < len(lines) < 30
    assert isinstance(picture().draw_world(100), Image.Image)
