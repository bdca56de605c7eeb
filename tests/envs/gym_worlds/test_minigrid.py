import gymnasium
import numpy as np
import pytest
import torch

pytest.importorskip("minigrid")

from hdrqn_torchrl.envs import check_task, make_minigrid
from hdrqn_torchrl.envs.gym import Subgoals
from hdrqn_torchrl.envs.gym.minigrid import making
from hdrqn_torchrl.envs.gym.minigrid.bot import bot_can_play, play
from hdrqn_torchrl.envs.gym.minigrid.survey import survey
from hdrqn_torchrl.rendering import scene_of

LEFT, RIGHT, FORWARD, PICKUP, DROP, TOGGLE = range(6)
COLOURS = ("red", "green", "blue", "purple", "yellow", "grey")
pytestmark = pytest.mark.filterwarnings("ignore:.*out of date")


def names(id, **settings):
    return make_minigrid(id, 1, **settings).task.subgoals[-1].names


def bot_s_actions(env):
    """One action of MiniGrid's bot at a time, for the first world."""
    from minigrid.utils.baby_ai_bot import BabyAIBot

    bot = BabyAIBot(env.worlds.vector.envs[0].env)
    while True:
        yield int(bot.replan())


class TestSubgoals:
    def test_are_what_can_be_done_with_the_objects_of_the_task(self):
        assert names("MiniGrid-DoorKey-5x5-v0") == ("pick up the key", "unlock the locked door", "reach the goal")
        assert names("MiniGrid-Empty-5x5-v0") == ("reach the goal",)

    def test_tell_objects_apart_by_colour_where_an_episode_has_several_colours(self):
        assert names("MiniGrid-KeyCorridorS3R3-v0") == (
            "pick up the key", "pick up the ball", "unlock the locked door",
            *(f"open the {colour} door" for colour in COLOURS), "enter an unvisited room", "complete the mission",
        )  # fmt: skip

    def test_of_missions_to_go_somewhere_are_to_stand_before_objects(self):
        assert "stand before the red ball" in names("BabyAI-GoToLocal-v0")

    def test_are_none_that_end_the_episode_or_that_the_actions_do_not_allow(self):
        doors = names("MiniGrid-GoToDoor-8x8-v0")
        assert doors == (*(f"stand before the {colour} door" for colour in COLOURS), "complete the mission")
        assert not any(name.startswith("open") for name in names("MiniGrid-GoToObject-8x8-N2-v0"))
        assert names("MiniGrid-Dynamic-Obstacles-6x6-v0") == ("reach the goal",)

    def test_have_the_colours_that_occur(self):
        assert names("MiniGrid-RedBlueDoors-6x6-v0")[:2] == ("open the red door", "open the blue door")

    def test_are_attained_on_the_bot_s_way_in_this_order(self):
        env = make_minigrid("BabyAI-KeyCorridorS3R3-v0", 1, seed=3)
        tensordict, attained = env.reset(), []
        subgoals = np.array(env.task.subgoals[-1].names)
        for action in bot_s_actions(env):
            tensordict = env.step(tensordict.set("action", torch.tensor([action])))["next"]
            attained += subgoals[tensordict["attained"][0].numpy()].tolist()
            if tensordict["done"]:
                break
        assert tensordict["success"] and tensordict["reward"] > 0
        once = [name for name in attained if name != "enter an unvisited room"]
        assert len(set(once)) == len(once), "all but rooms are attained once"
        order = [attained.index(name) for name in ("pick up the key", "unlock the locked door", "pick up the ball")]
        assert order == sorted(order)
        assert 1 <= attained.count("enter an unvisited room") < 9
        assert attained[-2:] == ["pick up the ball", "complete the mission"]

    def test_that_an_episode_lacks_or_that_are_done_are_not_available(self):
        env = make_minigrid("MiniGrid-KeyCorridorS3R3-v0", 8, seed=0)
        available = env.reset()["available"]
        subgoals = env.task.subgoals[-1].names
        for index, each in enumerate(env.worlds.vector.envs):
            doors = {cell.color for cell in each.unwrapped.grid.grid if cell is not None and cell.type == "door"}
            for colour in COLOURS:
                assert available[index, subgoals.index(f"open the {colour} door")] == (colour in doors)
        step = env.rollout(270, break_when_any_done=False)
        again = list(subgoals).index("enter an unvisited room")
        done = step["next", "attained"].cumsum(1) > 0
        others = [index for index in range(len(subgoals)) if index != again]
        first_episode = step["next", "done"].cumsum(1) - step["next", "done"].long() == 0
        assert not (done & step["next", "available"])[..., others][first_episode.squeeze(-1)].any()

    def test_can_be_left_out_or_be_one_s_own(self):
        class Turned(Subgoals):
            names = ("east",)

            def conditions(self, env, before, after, info):
                return (env.unwrapped.agent_dir == 0,)

        assert make_minigrid("MiniGrid-Empty-5x5-v0", 1, subgoals=None).task.subgoals == ()
        assert names("MiniGrid-Empty-5x5-v0", subgoals=Turned()) == ("east",)


class TestObservation:
    def test_is_cells_and_direction_and_words_only_where_missions_differ(self):
        sizes = [
            make_minigrid(id, 1).observation_spec["observation"].shape[-1]
            for id in ("MiniGrid-DoorKey-5x5-v0", "MiniGrid-KeyCorridorS3R1-v0")
        ]
        assert sizes == [7 * 7 * 3 + 1, 7 * 7 * 3 + 1 + 5]

    def test_keeps_within_its_numbers_of_codes(self):
        env = make_minigrid("MiniGrid-ObstructedMaze-1Dlhb-v0", 4, seed=0)
        assert env.observation_spec.is_in(
            env.rollout(200, break_when_any_done=False).exclude("action")[:, -1].select(*env.observation_spec.keys())
        )


def test_a_process_looks_at_a_task_s_episodes_once_for_all_environments_with_the_same_settings(monkeypatch):
    looks = []
    monkeypatch.setattr(making, "survey", lambda env: (looks.append(env.spec.id), survey(env))[1])
    making._looked.cache_clear()
    first, again = (names("MiniGrid-DoorKey-5x5-v0", max_steps=50) for _ in range(2))
    assert first == again and len(looks) == 1
    make_minigrid("MiniGrid-DoorKey-5x5-v0", 1, max_steps=51)
    make_minigrid("MiniGrid-Empty-5x5-v0", 1)
    assert len(looks) == 3
    for _ in range(2):  # a list has no hash
        make_minigrid("BabyAI-BossLevel-v0", 1, settings={"action_kinds": ["goto"]})
    assert len(looks) == 5


def test_a_task_with_fewer_actions_and_a_loss_states_both():
    env = make_minigrid("MiniGrid-Dynamic-Obstacles-6x6-v0", 1)
    assert env.action_spec.n == 3 and env.task.smallest_extrinsic_return == -1.0


def test_a_task_without_a_mission_is_made():
    assert make_minigrid("MiniGrid-Playground-v0", 1, seed=0).rollout(3).shape == (1, 3)


def test_keeps_the_contract_of_tasks():
    found = check_task(make_minigrid("MiniGrid-DoorKey-5x5-v0", 4, seed=0))
    assert [str(finding) for finding in found if finding.severity == "wrong"] == []


def test_lava_is_a_hazard_and_the_task_says_how_long_an_episode_is():
    env = make_minigrid("MiniGrid-LavaGapS5-v0", 16, seed=0)
    step = env.rollout(150, break_when_any_done=False)["next"]
    assert step["hazard"].any() and not (step["hazard"] & ~step["terminated"]).any()
    assert not (step["hazard"] & step["success"]).any()
    assert env.task.max_steps == 100 and make_minigrid("MiniGrid-LavaGapS5-v0", 1, max_steps=7).task.max_steps == 7


def test_another_environment_is_refused():
    with pytest.raises(ValueError, match=r"id must be that of a MiniGrid or BabyAI task, got 'CartPole-v1'; use"):
        make_minigrid("CartPole-v1")
    with pytest.raises(ValueError, match="id must be that of a MiniGrid or BabyAI task, got 'MiniGrid-No-v0'"):
        make_minigrid("MiniGrid-No-v0")


class TestPlayers:
    @pytest.mark.parametrize(
        "id",
        ["MiniGrid-DoorKey-6x6-v0", "MiniGrid-MultiRoom-N2-S4-v0", "MiniGrid-UnlockPickup-v0", "BabyAI-GoToLocal-v0"],
    )
    def test_the_bot_completes_every_mission(self, id):
        task = make_minigrid(id, 1).task
        figures = play(lambda: gymnasium.make(id), "bot", 60, episodes=5)
        assert task.ceiling == "bot" and figures["success_rate"] == 1.0 and figures["episodes"] == 5
        chance = play(lambda: gymnasium.make(id), "random", 60, episodes=5)
        assert chance["steps_mean"] > figures["steps_mean"]

    @pytest.mark.parametrize("id", ["MiniGrid-MemoryS7-v0", "MiniGrid-ObstructedMaze-1Dlh-v0", "BabyAI-KeyInBox-v0"])
    def test_a_task_that_the_bot_cannot_play_has_chance_only(self, id):
        assert not bot_can_play(gymnasium.make(id), id)
        task = make_minigrid(id, 1).task
        assert task.ceiling is None and list(task.references) == ["random"]

    def test_say_so_when_their_time_is_up(self):
        with pytest.raises(TimeoutError, match="of 100 episodes took 0 seconds"):
            play(lambda: gymnasium.make("MiniGrid-Empty-5x5-v0"), "random", 0)


def test_a_scene_shows_the_map_what_the_agent_sees_and_the_mission():
    env = make_minigrid("BabyAI-GoToLocal-v0", 1, seed=0)
    env.reset()
    scene = scene_of(env, subgoal=0)
    world, view = np.asarray(scene.draw_world(320)), np.asarray(scene.draw_view(140))
    assert world.shape == (320, 320, 3) and view.shape == (140, 140, 3) and world.std() > 0 < view.std()
    assert scene.write_world().plain.startswith("go to") and scene.action_names == env.task.actions
