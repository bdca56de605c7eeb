import inspect
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs, step_mdp

pytest.importorskip("ale_py")

from hdrqn_torchrl.envs import check_task, task_of
from hdrqn_torchrl.envs.montezuma.environment import MontezumaEnv
from hdrqn_torchrl.envs.montezuma.making import make_montezuma
from hdrqn_torchrl.envs.montezuma.screen import ALL_ACTIONS, BOXES, SUBGOALS, USEFUL_ACTIONS, locate
from hdrqn_torchrl.rendering import scene_of

ROUTE = json.loads((Path(__file__).parent / "montezuma_route.json").read_text())
"""Actions that take the key and open the right door, and what happens at which step."""


def play(env, actions, others=0):
    """Steps ``[T]`` of the first emulator; the others do ``others``."""
    tensordict, steps = env.reset(), []
    for action in actions:
        chosen = torch.full((env.num_envs,), others)
        chosen[0] = action
        tensordict = env.step(tensordict.set("action", chosen))["next"]
        steps.append(tensordict[0].exclude("pixels").clone())
    return torch.stack(steps)


@pytest.fixture(scope="module")
def route():
    env = MontezumaEnv(2, subgoals=list(BOXES), seed=0)
    return env, play(env, ROUTE["actions"])


class TestRoute:
    def test_the_route_takes_the_key_and_opens_a_door(self, route):
        _, steps = route
        scores = {int(step): float(steps["reward"][step]) for step in steps["reward"].squeeze(-1).nonzero()}
        assert scores == {75: 100.0, 166: 300.0}
        assert steps["extrinsic_reward"].squeeze(-1).nonzero().flatten().tolist() == [75, 166]
        assert steps["extrinsic_reward"].sum() == 2.0
        assert steps["terminated"].squeeze(-1).nonzero().flatten().tolist() == [166]
        assert steps["success"].squeeze(-1).nonzero().flatten().tolist() == [166]
        assert not steps["hazard"].any()

    def test_each_subgoal_is_attained_at_its_step(self, route):
        env, steps = route
        first = {name: int(steps["attained"][:, g].float().argmax()) for g, name in enumerate(env.subgoals)
                 if steps["attained"][:, g].any()}  # fmt: skip
        assert {name: first[name] for name in ROUTE["first_attained"]} == ROUTE["first_attained"]
        assert "left_door" not in first

    def test_a_place_is_attained_on_the_way_in_only(self, route):
        env, steps = route
        inside = ~steps["available"]
        for g, name in enumerate(env.subgoals):
            if name not in ("key", "right_door"):
                entered = inside[1:, g] & ~inside[:-1, g]
                assert (steps["attained"][1:, g] == entered).all()

    def test_the_key_is_worth_choosing_until_it_is_taken(self, route):
        env, steps = route
        key = list(env.subgoals).index("key")
        assert steps["available"][:75, key].all() and not steps["available"][75:, key].any()
        assert steps["attained"][:, key].nonzero().flatten().tolist() == [75]

    def test_with_the_key_a_door_is_worth_choosing_where_the_agent_stands_at_it_and_opening_it_attains_it(self, route):
        env, steps = route
        door, other = (list(env.subgoals).index(f"{side}_door") for side in ("right", "left"))
        assert steps["attained"][:, door].nonzero().flatten().tolist() == [165, 166]  # it came there, it opened
        assert steps["available"][165, door] and steps["available"][165, other]
        assert not steps["attained"][:, other].any()

    def test_without_the_key_a_door_is_not_worth_choosing_where_the_agent_stands_at_it(self):
        env = MontezumaEnv(1, seed=0)
        steps = play(env, [3, 3, 11, *[3] * 15])
        door = SUBGOALS.index("right_door")
        came = steps["attained"][:, door].nonzero().flatten().tolist()
        assert len(came) == 1 and not steps["available"][came[0], door]

    def test_the_position_starts_in_the_middle_and_stays_in_the_room(self, route):
        _, steps = route
        assert steps["position"][0].tolist() == [83.5, 82.5]
        x, y = steps["position"].T
        assert x.min() >= 11 and x.max() <= 148 and y.min() >= 65 and y.max() <= 170


def test_key_and_door_are_a_farther_set_of_subgoals_on_request():
    env, plain = (MontezumaEnv(1, seed=0, key_and_door=wanted) for wanted in (True, False))
    steps, usual = (play(each, ROUTE["actions"]) for each in (env, plain))
    near, far = task_of(env).subgoals
    assert (near.names, near.prefix, far.names, far.prefix) == (SUBGOALS, "places", ("key", "door"), "")
    assert [each.names for each in task_of(plain).subgoals] == [SUBGOALS]
    assert [steps["attained"][:, g].nonzero().flatten().tolist() for g in range(2)] == [[75], [166]]
    assert steps["available"][:75].all() and steps["available"][75:].tolist() == [[False, True]] * 92
    for entry in ("attained", "available"):
        assert (steps[f"places_{entry}"] == usual[entry]).all()
    assert scene_of(env, subgoal=1).subgoal_names == ("key", "door")
    check_env_specs(env)


def test_the_screen_shows_the_agent_where_the_ram_says():
    by_ram, by_pixels = (MontezumaEnv(1, locator=locator, seed=0) for locator in ("ram", "pixels"))
    a, b = play(by_ram, ROUTE["actions"]), play(by_pixels, ROUTE["actions"])
    assert (a["position"] - b["position"]).abs().mean() < 1.0
    assert (a["position"] - b["position"]).abs().max() <= 9.0
    assert (a["attained"] == b["attained"]).float().mean() > 0.98


@pytest.mark.parametrize("settings", [{}, {"key_and_door": True, "noops": 30, "practice": 0.5}], ids=str)
def test_montezuma_fulfils_the_contract_for_tasks_without_scripted_players(settings):
    found = check_task(make_montezuma(2, max_steps=40, **settings), steps=60)
    assert [finding.costs for finding in found] == ["no ceiling line"]


def test_without_an_agent_the_locator_takes_the_middle():
    assert locate(np.zeros((210, 160, 3), np.uint8)).tolist() == [80.0, 105.0]


def fall(**settings):
    """Walks to the left off the start platform: a fall that kills."""
    env = MontezumaEnv(1, seed=0, **settings)
    return env, play(env, [4] * 25)


class TestDeath:
    def test_a_death_is_noticed_at_once_and_ends_the_episode(self):
        _, steps = fall()
        (died,) = steps["hazard"].squeeze(-1).nonzero().flatten().tolist()[:1]
        assert steps["terminated"][died] and not steps["terminated"][:died].any()
        assert not steps["attained"][: died + 1].any()  # it fell through no box

    def test_with_more_lives_the_agent_stands_at_the_start_afterwards(self):
        _, steps = fall(one_life=False)
        (died,) = steps["hazard"].squeeze(-1).nonzero().flatten().tolist()[:1]
        assert not steps["done"].any()
        assert steps["position"][died].tolist() == [79.5, 82.5]
        assert not steps["hazard"][died + 1]

    def test_a_death_is_one_also_if_every_frame_is_a_step(self):
        env = MontezumaEnv(1, seed=0, one_life=False, frame_skip=1, max_steps=1000)
        steps = play(env, [4] * 60)
        (died,) = steps["hazard"].squeeze(-1).nonzero().flatten().tolist()
        assert steps["position"][died].tolist() == [79.5, 82.5]

    def test_the_last_life_ends_the_game(self):
        env = MontezumaEnv(1, seed=0, one_life=False, max_steps=1000)
        steps = play(env, [4] * 200)
        assert steps["hazard"][: int(steps["done"].float().argmax()) + 1].sum() == 6
        assert steps["terminated"].any()

    def test_a_fall_through_a_box_attains_nothing(self):
        everywhere = {"screen": (0, 0, 160, 210), "below": (0, 100, 68, 210)}
        env = MontezumaEnv(1, seed=0, subgoals=everywhere)
        steps = play(env, [4] * 25)
        died = int(steps["hazard"].float().argmax())
        assert (steps["position"][:died, 1] > 100).any()  # it was in the box, ...
        assert not steps["attained"][: died + 1, 1].any()  # ... but falling


class TestEpisodes:
    def test_the_step_limit_truncates(self):
        env = MontezumaEnv(1, seed=0, max_steps=3)
        steps = play(env, [0] * 3)
        assert steps["truncated"].flatten().tolist() == [False, False, True]
        assert not steps["terminated"].any()

    def test_a_partial_reset_leaves_other_emulators_alone(self):
        env = MontezumaEnv(3, seed=0)
        tensordict = env.reset()
        for _ in range(5):
            tensordict = step_mdp(env.step(tensordict.set("action", torch.tensor([3, 3, 3]))))
        before = tensordict["position"].clone()
        reset = torch.tensor([[False], [True], [False]])
        after = env.reset(tensordict.set("_reset", reset))
        assert after["position"][1].tolist() == [79.5, 82.5]
        assert (after["position"][[0, 2]] == before[[0, 2]]).all()
        assert env.steps.tolist() == [5, 0, 5]

    def test_no_ops_make_starts_differ_and_a_seed_repeats_them(self):
        env = MontezumaEnv(20, seed=3, noops=30)
        skulls = [env.reset() is not None and env.emulators.ram[:, 47].copy() for _ in range(2)]
        env.set_seed(3)
        again = env.reset() is not None and env.emulators.ram[:, 47].copy()
        assert len(set(skulls[0].tolist())) > 5
        assert (again == skulls[0]).all() and (again != skulls[1]).any()

    def test_sticky_actions_come_from_generators_of_their_own(self):
        def positions(seed):
            return play(MontezumaEnv(2, seed=seed, sticky=0.25), [3, 4] * 10)["position"]

        first, second = positions(1), positions(2)
        assert (first == positions(1)).all()
        assert (first != second).any()

    def test_neighbouring_seeds_share_no_random_numbers(self):
        """Evaluations that choose a checkpoint have one seed, those that report it the next."""
        env = MontezumaEnv(3, sticky=0.25)

        def paths(seed):
            env.set_seed(seed)
            tensordict, seen = env.reset(), []
            for step in range(60):
                tensordict = step_mdp(env.step(tensordict.set("action", torch.full((3,), 3 + step % 2))))
                seen.append(tensordict["position"])
            return torch.stack(seen, 1).flatten(1).unbind(0)

        assert not any((one == other).all() for one in paths(1) for other in paths(2))

    def test_seeding_starts_everything_over(self):
        env = MontezumaEnv(2, seed=3, noops=30, practice=1.0, practice_steps=100)
        first = env.reset()["pixels"]
        play(env, ROUTE["actions"][:7])
        assert env.total_steps == 14 and (env.reset()["position"] != torch.tensor([79.5, 82.5])).any()
        env.set_seed(3)
        assert (env.reset()["pixels"] == first).all() and env.total_steps == 0

    def test_practice_begins_where_a_subgoal_was_attained(self):
        env = MontezumaEnv(1, seed=0, practice=1.0)
        assert env.reset()["position"].tolist() == [[79.5, 82.5]]  # nothing was attained yet
        steps = play(env, ROUTE["actions"][:7])
        place = steps["position"][6].tolist()
        again = env.reset()
        assert again["position"].tolist() == [place] != [[79.5, 82.5]]
        assert not again["available"][0, SUBGOALS.index("middle_ladder_bottom")]
        assert again["attained"][0].nonzero().tolist() == [[SUBGOALS.index("middle_ladder_bottom")]]

    def test_practice_ends_after_practice_steps(self):
        env = MontezumaEnv(1, seed=0, practice=1.0, practice_steps=7)
        play(env, ROUTE["actions"][:7])
        assert env.reset()["position"].tolist() == [[79.5, 82.5]]


def test_a_restored_environment_goes_on_as_the_original():
    settings = {"sticky": 0.25, "practice": 0.5, "noops": 5, "max_steps": 30}
    env, other = MontezumaEnv(3, seed=1, **settings), MontezumaEnv(3, seed=9, **settings)
    torch.manual_seed(0)
    env.rollout(40, break_when_any_done=False)
    actions = torch.randint(18, (60, 3))
    state = env.state_dict()

    def go_on(env):
        seen = []
        for step, action in enumerate(actions):
            if step % 20 == 19:
                seen.append(env.reset().exclude("pixels"))
            seen.append(env.step(env.fake_tensordict().set("action", action))["next"].exclude("pixels"))
        return seen

    first = go_on(env)
    other.load_state_dict(state)
    torch.manual_seed(5)
    second = go_on(other)
    for one, two in zip(first, second, strict=True):
        assert all((one[key] == two[key]).all() for key in one.keys())  # noqa: SIM118


def test_a_state_of_another_size_is_refused():
    with pytest.raises(ValueError, match="state_dict must hold 2 emulators, got 1"):
        MontezumaEnv(2, seed=0).load_state_dict(MontezumaEnv(1, seed=0).state_dict())


def test_threads_do_not_change_the_results():
    one, two = (MontezumaEnv(5, seed=0, threads=threads) for threads in (1, 2))
    torch.manual_seed(0)
    actions = torch.randint(18, (20, 5))
    for env in (one, two):
        env.reset()
    for action in actions:
        a, b = (env.step(env.fake_tensordict().set("action", action))["next"] for env in (one, two))
        assert (a["pixels"] == b["pixels"]).all() and (a["position"] == b["position"]).all()


@pytest.mark.parametrize("settings", [{}, {"view": None}, {"keep_pixels": True}, {"actions": USEFUL_ACTIONS}], ids=str)
@pytest.mark.parametrize("num_envs", [1, 3])
def test_the_specs_of_montezuma_are_right(num_envs, settings):
    check_env_specs(make_montezuma(num_envs, seed=0, **settings))


def test_the_actions_can_be_chosen():
    env = MontezumaEnv(1, actions=USEFUL_ACTIONS, seed=0)
    useful = [USEFUL_ACTIONS.index(action) for action in ROUTE["actions"][:40]]
    assert (play(env, useful)["position"] == play(MontezumaEnv(1, seed=0), ROUTE["actions"][:40])["position"]).all()


def test_what_the_agent_sees_is_black_beyond_the_screen():
    env = make_montezuma(1, seed=0)
    tensordict = env.reset()
    for action in ROUTE["actions"][:76]:  # to the key, at the left edge
        tensordict = step_mdp(env.step(tensordict.set("action", torch.tensor([action]))))
    assert (tensordict["observation"][0, :, :, 0] == 0).all()
    assert tensordict["observation"].float().std() > 10


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_envs": 0}, "num_envs must be >= 1, got 0; "),
        ({"max_steps": 0}, "max_steps must be >= 1, got 0; "),
        ({"noops": -1}, "noops must be >= 0, got -1; "),
        ({"practice": 1.5}, r"practice must lie in \[0, 1\], got 1.5; "),
        ({"locator": "eyes"}, "locator must be 'ram' or 'pixels', got 'eyes'; "),
        ({"actions": (0, 18)}, r"actions must be different numbers from 0 to 17, got \[0, 18\]; "),
        ({"subgoals": ["kye"]}, "subgoals must be names among .*, got 'kye'"),
        ({"subgoals": {"a": (5, 5, 5, 9)}}, r"subgoals.a must be left, top, right, bottom .*, got \[5, 5, 5, 9\]"),
        ({"subgoals": []}, "subgoals must hold at least one place"),
        ({"sticky": 1.0}, r"sticky must lie in \[0, 1\), got 1.0; "),
        ({"threads": 0}, "threads must be >= 1, got 0"),
    ],
)
def test_wrong_settings_of_montezuma_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        MontezumaEnv(**settings)


def test_the_builder_has_the_settings_of_the_environment_and_its_own():
    def arguments(of):
        return {name: each.default for name, each in inspect.signature(of).parameters.items() if name != "self"}

    own = {"view": 70, "size": 44, "keep_pixels": False}
    assert arguments(make_montezuma) == arguments(MontezumaEnv.__init__) | own


def test_all_18_actions_are_the_default():
    assert MontezumaEnv(1, seed=0).action_spec.n == len(ALL_ACTIONS) == 18


@pytest.mark.parametrize(
    ("name", "shape"), [("ram", [127]), ("screen", [1, 160, 3]), ("state", [1 << 17]), ("state", [0])]
)
def test_a_stored_emulator_of_other_sizes_is_refused(name, shape):
    from hdrqn_torchrl.envs.montezuma.emulators import Snapshot

    moment = {"state": torch.zeros(9, dtype=torch.uint8), "ram": torch.zeros(128, dtype=torch.uint8)}
    moment["screen"] = torch.zeros(210, 160, 3, dtype=torch.uint8)
    assert len(Snapshot.of_tensors(moment).state) == 9
    with pytest.raises(ValueError, match="a stored emulator must be bytes of a state, a RAM and a screen, got "):
        Snapshot.of_tensors(moment | {name: torch.zeros(shape, dtype=torch.uint8)})
