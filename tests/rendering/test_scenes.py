import numpy as np
import pytest
import torch
from gym_toys import Counter
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from helpers import AGENT, CORRIDOR, OBJECTS, RIGHT, small_env
from torchrl.envs import GymEnv
from user_envs import Corridor, Pictured

from hdrqn_torchrl.envs import MultiGoalGridEnv, make_gym
from hdrqn_torchrl.envs.grid.cells import palette
from hdrqn_torchrl.rendering import scene_of

CELL = 20  # pixels
FLOOR, WALL, OBSTACLE, GOAL_1, GOAL_2 = palette(5).tolist()


def corridor(**changes):
    """Agent, obstacle, goal 1, goal 2 from left to right; the agent sees one cell around it."""
    settings = {"layout": CORRIDOR, "num_obstacles": 1, "view": 3} | changes
    env = MultiGoalGridEnv(1, **settings)
    env.set_world(AGENT, OBJECTS)
    return env


def pixels(image):
    return np.asarray(image).astype(int)


def cell(picture, row, column, *, size=CELL):
    return picture[row * size : (row + 1) * size, column * size : (column + 1) * size]


def commonest(part):
    colours, counts = np.unique(part.reshape(-1, 3), axis=0, return_counts=True)
    return colours[counts.argmax()].tolist()


def has(part, colour):
    return bool((part == colour).all(-1).any())


class TestWorldPicture:
    def test_every_cell_has_its_colour_and_unseen_cells_are_faded(self):
        picture = pixels(scene_of(corridor()).draw_world(6 * CELL))
        assert picture.shape == (3 * CELL, 6 * CELL, 3)
        assert commonest(cell(picture, 0, 1)) == WALL
        assert commonest(cell(picture, 1, 2)) == OBSTACLE
        for column, colour in ((3, GOAL_1), (4, GOAL_2)):
            assert commonest(cell(picture, 1, column)) == [(part + 150) // 2 for part in colour]
        assert commonest(cell(picture, 0, 5)) == [(part + 150) // 2 for part in WALL]

    def test_the_view_is_outlined(self):
        picture = pixels(scene_of(corridor()).draw_world(6 * CELL))
        black = (picture == 0).all(-1)
        assert black[:, 0].all() and black[0, : 3 * CELL].all() and black[:, 3 * CELL - 1].all()
        assert not black[:, 3 * CELL :].any()

    def test_a_goal_carries_its_number(self):
        world = scene_of(corridor(view=None)).draw_world(6 * CELL)
        one, two = (cell(pixels(world), 1, column) for column in (3, 4))
        assert has(one, [255] * 3) and has(two, [255] * 3)
        assert ((one == 255).all(-1) != (two == 255).all(-1)).any()

    def test_only_the_active_subgoal_has_a_ring(self):
        plain, first, second = (
            pixels(scene_of(corridor(), subgoal=each).draw_world(6 * CELL)) for each in (None, 0, 1)
        )
        below_first, below_second = (
            (slice(2 * CELL, 2 * CELL + 4), slice(at, at + CELL)) for at in (3 * CELL, 4 * CELL)
        )
        assert has(first[below_first], GOAL_1) and not has(plain[below_first], GOAL_1)
        assert has(second[below_second], GOAL_2) and not has(first[below_second], GOAL_2)

    def test_the_ring_vanishes_with_its_goal(self):
        env = corridor()
        env.state = env.rules.place(AGENT, torch.tensor([[8, env.rules.nowhere, 10]]))
        with_subgoal, without = (pixels(scene_of(env, subgoal=each).draw_world(6 * CELL)) for each in (0, None))
        assert (with_subgoal == without).all()

    @pytest.mark.parametrize(("action", "axis", "side"), [(0, 0, -1), (1, 0, 1), (2, 1, -1), (3, 1, 1)])
    def test_the_agent_points_where_it_goes(self, action, axis, side):
        agent = cell(pixels(scene_of(corridor(), action=action).draw_world(6 * 40)), 1, 1, size=40)
        arrow = np.argwhere((agent[10:30, 10:30] == 255).all(-1))
        widths = [np.ptp(arrow[arrow[:, axis] == at][:, 1 - axis]) for at in np.unique(arrow[:, axis])]
        assert np.sign(widths[0] - widths[-1]) == side  # the thin end is ahead
        at_rest = cell(pixels(scene_of(corridor()).draw_world(6 * 40)), 1, 1, size=40)
        assert not has(at_rest[10:30, 10:30], [255] * 3)


def test_the_view_is_the_observation_with_the_agent_in_its_centre():
    env = corridor()
    picture = pixels(scene_of(env).draw_view(60))
    assert picture.shape == (60, 60, 3)
    assert commonest(cell(picture, 1, 2)) == OBSTACLE and commonest(cell(picture, 1, 0)) == WALL
    assert has(cell(picture, 1, 1), [0, 0, 0])


def test_the_subgoal_is_marked_in_the_view_where_it_is_seen():
    env = corridor(view=5)
    seen, unseen, plain = (pixels(scene_of(env, subgoal=each).draw_view(100)) for each in (0, 1, None))
    assert (seen != plain).any() and (unseen == plain).all()


def test_text_shows_the_same_world_as_the_picture():
    scene = scene_of(corridor(), subgoal=1)
    assert scene.write_world().plain == "████████████\n██ @ x 1>2██\n████████████"
    assert scene.write_view().plain == "██████\n██ @ x\n██████"
    room = small_env(1, num_obstacles=0, num_goals=1, view=3)
    room.set_world(torch.tensor([6]), torch.tensor([[18]]))
    assert scene_of(room).write_world().plain.splitlines()[1:4] == ["██ @ ·  ██", "██ · ·  ██", "██     1██"]


def test_choices_and_ends_of_episodes_have_names():
    scene = scene_of(corridor())
    assert scene.subgoal_names == ("goal 1", "goal 2")
    assert [list(colour) for colour in scene.subgoal_colours] == [GOAL_1, GOAL_2]
    assert scene.action_names[RIGHT] == "→ right" and len(scene.action_names) == 4
    ends = [scene.outcome(*each) for each in ((True, True), (False, True), (False, False))]
    assert ends == ["both goals in order", "all goals, but not in order", "time is up"]
    others = [scene_of(small_env(1, num_goals=goals)).outcome(True, True) for goals in (1, 3)]
    assert others == ["goal reached", "all 3 goals in order"]


def test_an_environment_without_a_scene_shows_what_it_renders_and_sees():
    env = GymEnv("CartPole-v1", render_mode="rgb_array", categorical_action_encoding=True)
    env.reset()
    observation = torch.tensor([-2.4e-05, -0.038, 0.02, -0.036])
    scene = scene_of(env, observation=observation)
    assert scene.draw_world(300).size == (300, 200) and scene.draw_view(100).size == (100, 100)
    assert scene.action_names == ("action 0", "action 1") and scene.subgoal_names == ()
    assert scene.write_view().plain.replace(" ", "") == "[-0.-0.040.02-0.04]"  # the smallest does not change the others
    ends = [scene.outcome(*each) for each in ((True, True), (False, True), (False, False))]
    assert ends == ["success", "over", "time is up"]


def test_an_environment_that_renders_nothing_is_shown_in_numbers():
    scene = scene_of(Corridor(1), observation=torch.tensor([[2]], dtype=torch.uint8))
    assert scene.write_world().plain == scene.write_view().plain == "[[2]]"
    assert len(np.unique(pixels(scene.draw_world(120)).reshape(-1, 3), axis=0)) > 1
    assert scene.subgoal_names == ("subgoal 0", "subgoal 1")
    assert scene_of(Corridor(1)).write_view().plain == "no picture"


def test_the_world_of_an_environment_is_what_it_renders():
    scene = scene_of(Pictured(1))
    picture = pixels(scene.draw_world(100))
    assert picture.shape == (40, 100, 3) and (picture[0, 45] == [255, 0, 0]).all() and (picture[0, 5] == 255).all()
    assert scene.subgoal_names == ("west", "east") and scene.action_names == ("go west", "go east")


@pytest.mark.parametrize(
    ("clock", "shown"), [(spaces.Discrete(3), "clock [0. 1. 0.]"), (spaces.Box(-9, 9, (2,)), "clock [1. 1.]")]
)
def test_entries_of_a_dict_are_shown_by_their_names(clock, shown):
    time = 1 if isinstance(clock, spaces.Discrete) else np.ones(2, np.float32)
    space = spaces.Dict({"clock": clock, "count": Counter.observation_space})
    env = make_gym(
        lambda: TransformObservation(Counter(), lambda count: {"clock": time, "count": count}, space), 1, seed=0
    )
    observation = env.reset()["observation"][0]
    first, second = scene_of(env, observation=observation).write_view().plain.splitlines()
    assert first == shown and second == f"count [{observation[-2]:.0f}. 0.]"


def test_codes_of_a_dict_are_shown_by_the_names_of_its_entries():
    space = spaces.Dict({"room": spaces.Discrete(9), "keys": spaces.MultiBinary(2)})
    told = {"room": 7, "keys": np.array([0, 1])}
    env = make_gym(lambda: TransformObservation(Counter(), lambda _: told, space), 1, seed=0)
    text = scene_of(env, observation=env.reset()["observation"][0]).write_view().plain
    assert set(text.splitlines()) == {"room [7]", "keys [0 1]"}
