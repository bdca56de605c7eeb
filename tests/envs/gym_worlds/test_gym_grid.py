import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.envs.grid.cells import AGENT_COLOUR, palette
from hdrqn_torchrl.envs.grid.drawing import draw_worlds
from hdrqn_torchrl.envs.gym import MultiGoalGymEnv

IDS = {"hdrqn/Gridworld-v0": "open", "hdrqn/FourRooms-v0": "four_rooms", "hdrqn/NineRooms-v0": "nine_rooms"}
CORRIDOR = {"layout": ("######", "#    #", "######"), "num_obstacles": 1, "num_goals": 2}  # cells 7 to 10
RIGHT = 3


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("settings", [{}, {"num_goals": 3, "view": None, "obstacle": "teleport", "max_steps": 100}])
def test_gymnasiums_checker_gives_no_warning(env_id, settings):
    env = gymnasium.make(env_id, render_mode="rgb_array", **settings)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


@pytest.mark.parametrize("obstacle", ["stay", "teleport"])
@pytest.mark.parametrize(
    "settings",
    [
        {"layout": "open", "num_goals": 2, "view": 5},
        {"layout": "four_rooms", "num_goals": 3, "view": None},
        {"layout": ("    ", " #  ", "    "), "num_goals": 3, "view": 3, "max_steps": 30},
        {"layout": "nine_rooms", "max_steps": 150},
    ],
    ids=["open", "rooms", "small", "nine_rooms"],
)
def test_the_gymnasium_environment_equals_the_batched_one_step_for_step(settings, obstacle):
    batched = MultiGoalGridEnv(1, seed=0, obstacle=obstacle, **settings)
    single = MultiGoalGymEnv(obstacle=obstacle, **settings)
    actions, steps = np.random.default_rng(0), 0
    while steps < 600:
        batched.reset()
        world = batched.state
        tensordict = batched.set_world(world.agent, world.objects)
        options = {"agent": world.agent.item(), "objects": world.objects[0].tolist()}
        observation, info = single.reset(options=options)
        single._generator.set_state(batched._generator.get_state())  # hit obstacles go to the same places
        assert (observation == tensordict["observation"][0].numpy()).all()
        done = False
        while not done:
            action = actions.integers(4)
            tensordict = batched.step(tensordict.set("action", torch.tensor([action])))["next"]
            observation, reward, terminated, truncated, info = single.step(action)
            done, steps = terminated or truncated, steps + 1
            assert (observation == tensordict["observation"][0].numpy()).all()
            for key in ("attained", "rooms_attained", "rooms_available"):
                assert (key in info) == (key in tensordict)
                assert key not in info or (info[key] == tensordict[key][0].numpy()).all()
            scalars = (reward, info["extrinsic_reward"], terminated, truncated, info["hazard"], info["is_success"])
            names = ("reward", "extrinsic_reward", "terminated", "truncated", "hazard", "success")
            assert scalars == tuple(tensordict[name].item() for name in names)
            tensordict = tensordict.exclude("reward", "extrinsic_reward")


def test_observations_rewards_and_flags_have_the_types_of_gymnasium():
    env = MultiGoalGymEnv(view=3)
    observation, info = env.reset(seed=0)
    assert (observation.dtype, observation.shape) == (np.uint8, (3, 3))
    _, reward, terminated, truncated, info = env.step(np.int64(0))
    assert [type(value) for value in (reward, terminated, truncated)] == [float, bool, bool]
    assert (info["attained"].dtype, info["attained"].shape) == (np.bool_, (2,))
    assert [type(info[key]) for key in ("extrinsic_reward", "hazard", "is_success")] == [float, bool, bool]


def test_info_holds_obstacle_goals_and_success():
    env = MultiGoalGymEnv(**CORRIDOR)
    _, info = env.reset(options={"agent": 7, "objects": [8, 9, 10]})
    assert (info["extrinsic_reward"], info["hazard"], info["is_success"]) == (0, False, False)
    assert not info["attained"].any()
    results = [env.step(RIGHT) for _ in range(3)]
    assert [reward for _, reward, *_ in results] == [-1, 1, 1]
    assert [info["hazard"] for *_, info in results] == [True, False, False]
    assert [info["attained"].tolist() for *_, info in results] == [[False, False], [True, False], [False, True]]
    assert [info["is_success"] for *_, info in results] == [False, False, True]
    assert [terminated for *_, terminated, _, _ in results] == [False, False, True]


def test_max_steps_truncates():
    env = MultiGoalGymEnv(max_steps=2, **CORRIDOR)
    env.reset(options={"agent": 7, "objects": [8, 9, 10]})
    assert [env.step(0)[2:4] for _ in range(2)] == [(False, False), (False, True)]


def test_one_seed_repeats_and_two_differ():
    def worlds(seed):
        env = MultiGoalGymEnv(view=None)
        first, _ = env.reset(seed=seed)
        second, _ = env.reset()
        return np.stack([first, second])

    assert (worlds(3) == worlds(3)).all()
    assert (worlds(3) != worlds(4)).any()
    assert (worlds(3)[0] != worlds(3)[1]).any()


@pytest.mark.parametrize(("env_id", "layout"), IDS.items())
def test_ids_have_their_layout_and_pass_arguments_on(env_id, layout):
    env = gymnasium.make(env_id, num_goals=3, view=3, num_obstacles=1).unwrapped
    assert (env.rules.is_wall == MultiGoalGridEnv(1, layout=layout).rules.is_wall).all()
    assert (env.rules.num_goals, env.rules.view, env.rules.num_obstacles) == (3, 3, 1)
    assert env.spec.to_json()


def test_environments_work_in_a_gymnasium_vector():
    envs = gymnasium.make_vec("hdrqn/Gridworld-v0", num_envs=2, vectorization_mode="sync")
    observation, _ = envs.reset(seed=0)
    assert observation.shape == (2, 5, 5)
    assert (observation[0] != observation[1]).any()
    _, reward, _, _, info = envs.step(np.array([0, 1]))
    assert reward.shape == (2,)
    assert info["is_success"].shape == (2,)


def test_the_picture_shows_every_object_and_dims_what_the_agent_does_not_see():
    env = MultiGoalGymEnv(view=3, render_mode="rgb_array", **CORRIDOR)
    env.reset(options={"agent": 7, "objects": [8, 9, 10]})
    picture, colours = env.render(), palette(5)
    assert (picture.shape, picture.dtype) == ((3 * 32, 6 * 32, 3), np.uint8)
    corners = torch.from_numpy(picture[32 + 2, 2::32].copy())  # of the six cells of the corridor, left to right
    assert (corners[:3] == colours[[1, 0, 2]]).all()
    dimmed, bright = corners[3:].float(), colours[[3, 4, 1]].float()
    assert (dimmed < 0.8 * bright).all()
    assert ((dimmed / bright).std(dim=0) < 0.02).all()
    assert (picture[32 + 16, 32 + 16] == AGENT_COLOUR).all()


def test_a_world_is_drawn_alone_as_in_a_batch():
    rules = MultiGoalGridEnv(1, layout="four_rooms").rules
    state = rules.sample(3)
    pictures = draw_worlds(rules, state, cell_pixels=8)
    single = [draw_worlds(rules, type(state)(*(field[n : n + 1] for field in state)), cell_pixels=8) for n in range(3)]
    assert (pictures == torch.cat(single)).all()
    with pytest.raises(ValueError, match="cell_pixels must be >= 4, got 3"):
        draw_worlds(rules, state, cell_pixels=3)


def test_no_picture_without_a_mode():
    env = MultiGoalGymEnv()
    env.reset(seed=0)
    assert env.render() is None


@pytest.mark.parametrize(
    ("arguments", "named"),
    [({"max_steps": 0}, "max_steps"), ({"view": 2}, "view"), ({"render_mode": "human"}, "render_mode")],
)
def test_bad_arguments_are_named(arguments, named):
    with pytest.raises(ValueError, match=named):
        MultiGoalGymEnv(**arguments)


def test_bad_options_and_actions_are_named():
    env = MultiGoalGymEnv(**CORRIDOR)
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        env.step(0)
    with pytest.raises(ValueError, match="options must have the keys 'agent' and 'objects', got \\['agent'\\]"):
        env.reset(options={"agent": 7})
    with pytest.raises(ValueError, match=r"agent must stand on free cells, got \[0\]"):
        env.reset(options={"agent": 0, "objects": [8, 9, 10]})
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must be an integer from 0 to 3"):
        env.step(4)
