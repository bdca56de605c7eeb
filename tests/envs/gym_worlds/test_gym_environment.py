from functools import partial
from multiprocessing import current_process

import gymnasium
import numpy as np
import pytest
import torch
from gym_toys import Counter, CountingResets, Forgetful, Milestones, Remembering
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit, TransformObservation
from torchrl.envs.utils import check_env_specs

from hdrqn_torchrl.envs import Reference, Subgoals, Symmetry, Task, check_task, make_gym
from hdrqn_torchrl.envs.gym import worlds

STEPS = 40


def played(env, steps=STEPS, seed=0):
    """A rollout with known actions."""
    torch.manual_seed(seed)
    return env.rollout(steps, break_when_any_done=False)


def go_on(env, tensordict, steps=STEPS):
    torch.manual_seed(1)
    rows = []
    for _ in range(steps):
        step, tensordict = env.step_and_maybe_reset(env.rand_action(tensordict))
        rows.append(step.clone())
    return torch.stack(rows, 1)


def test_keeps_torchrl_s_contract_and_that_of_tasks():
    env = make_gym(Counter, 4, subgoals=Milestones(), success=lambda reward, info: reward > 0, max_steps=30, seed=0)
    check_env_specs(env)
    assert [finding.what for finding in check_task(env) if finding.severity == "wrong"] == []


def test_subgoals_are_attained_in_the_step_in_which_their_condition_becomes_true():
    step = played(make_gym(Counter, 3, subgoals=Milestones(), seed=0))
    before, after = step["observation"][..., 0], step["next", "observation"][..., 0]
    for index, count in enumerate((5, 8)):
        assert torch.equal(step["next", "attained"][..., index], (before < count) & (after >= count))
        assert torch.equal(step["available"][..., index], before < count)


@pytest.mark.parametrize("processes", [False, True])
def test_every_episode_is_reset_once(processes):
    env = make_gym(CountingResets, 3, processes=processes, seed=0)
    step = played(env, 25)
    resets = step["next", "observation"][:, -1, 1]
    assert torch.equal(resets, 1 + step["next", "done"][:, :-1, 0].sum(1))
    env.close()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vectors_made_elsewhere_lose_no_step_and_no_reset_in_any_autoreset_mode(mode):
    vector = SyncVectorEnv([CountingResets] * 3, autoreset_mode=mode)
    step = played(make_gym(vector, 3, subgoals=Milestones(), seed=0))
    count, done = step["next", "observation"][..., 0], step["next", "done"].squeeze(-1)
    assert torch.equal(done, count >= 10), "the last observation of an episode is its own"
    grown = count - step["observation"][..., 0]
    assert torch.equal(grown, step["action"] + 1.0), "no action was ignored"
    resets = step["observation"][..., 1]
    assert torch.equal(resets[:, 1:] - resets[:, :-1], done[:, :-1].float()), "each end was followed by one reset"
    assert torch.equal(step["next", "attained"][..., 0], (count >= 5) & (step["observation"][..., 0] < 5))


def test_a_vector_that_cannot_reset_some_of_its_worlds_is_refused():
    vector = gymnasium.make_vec("CartPole-v1", num_envs=2, vectorization_mode="vector_entry_point")
    with pytest.raises(ValueError, match=r"id must be a vector that can reset some .* got CartPoleVectorEnv"):
        make_gym(vector, 2)


def test_a_time_limit_truncates_and_an_end_of_its_own_terminates():
    step = played(make_gym(Counter, 3, max_steps=4, seed=0))
    assert step["next", "truncated"].any() and step["next", "terminated"].any()
    assert not (step["next", "truncated"] & step["next", "terminated"]).any()
    assert make_gym(Counter, 1, max_steps=4).task.max_steps == 4
    assert make_gym("CartPole-v1", 1).task.max_steps == 500


def test_the_same_seed_gives_the_same_worlds_and_another_seed_others():
    first, again, other = (played(make_gym(Counter, 3, seed=seed)) for seed in (0, 0, 1))
    assert torch.equal(first["observation"], again["observation"])
    assert not torch.equal(first["observation"], other["observation"])


def test_neighbouring_seeds_of_a_vector_made_elsewhere_share_no_worlds():
    """Gymnasium gives world i the vector's seed plus i."""
    env = make_gym(gymnasium.make_vec("CartPole-v1", num_envs=20, vectorization_mode="sync"), 20)

    def starts(seed):
        env.set_seed(seed)
        return {tuple(row) for row in env.reset()["observation"].tolist()}

    assert len(starts(4)) == 20 and starts(4) == starts(4) and not starts(4) & starts(5)


def test_images_can_have_their_channels_at_either_end():
    def paint(env):
        space = gymnasium.spaces.Box(0, 255, (9, 8, 7), np.uint8)
        return TransformObservation(env, lambda shown: np.full(space.shape, shown[0], np.uint8), space)

    for channels, shape in (("first", (9, 8, 7)), ("last", (7, 9, 8))):
        env = make_gym(Counter, 2, wrappers=[paint], channels=channels)
        assert env.reset()["observation"].shape == env.observation_spec["observation"].shape == (2, *shape)


class TestRules:
    def test_reward_success_and_hazard_come_from_info_or_a_function(self):
        env = make_gym(
            Counter, 2, reward="count", success="even", hazard=lambda reward, info: info["terminated"], seed=0
        )
        step = played(env)["next"]
        count = step["observation"][..., :1]
        assert torch.equal(step["reward"], count) and torch.equal(step["extrinsic_reward"], count)
        assert torch.equal(step["success"], count % 2 == 0) and torch.equal(step["hazard"], step["terminated"])

    def test_an_entry_that_info_lacks_is_named(self):
        env = make_gym(Counter, 2, success="is_success")
        with pytest.raises(ValueError, match=r"success must name an entry of info .* got 'is_success'; info has"):
            env.rollout(2)

    def test_action_masks_are_read_from_info(self):
        env = make_gym(lambda: Counter(masked=True), 2, seed=0)
        step = env.rollout(
            12, lambda td: td.set("action", torch.zeros(2, dtype=torch.int64)), break_when_any_done=False
        )
        for each in (step, step["next"]):
            assert torch.equal(each["action_mask"][..., 1:], each["observation"][..., :1] % 2 == 0)


class Shown(Counter):
    """Its mask is a part of what it shows."""

    observation_space = spaces.Dict(count=Counter.observation_space, action_mask=spaces.MultiBinary(2))

    def _shown(self):
        return {"count": super()._shown(), "action_mask": np.array([1, self.count % 2 == 0], np.int8)}


@pytest.mark.parametrize("given", [False, True])
def test_action_masks_are_read_from_a_dict_observation(given):
    vector = SyncVectorEnv([Shown] * 2, autoreset_mode=AutoresetMode.DISABLED)
    env = make_gym(vector if given else Shown, 2, seed=0)
    step = played(env, 12)
    for each in (step, step["next"]):
        assert each["observation"].shape[-1] == 2  # without the mask
        assert torch.equal(each["action_mask"][..., 1:], each["observation"][..., :1] % 2 == 0)
    if not given:
        seen = make_gym(Shown, 2, entries=["count", "action_mask"], seed=0).reset()
        assert seen["observation"].shape[-1] > 2 and "action_mask" in seen


def test_a_world_whose_process_has_ended_is_told():
    env = make_gym(Counter, 2, processes=True, seed=0)
    step = env.reset().set("action", torch.zeros(2, dtype=torch.int64))
    env.worlds.vector.processes[1].kill()
    env.worlds.vector.processes[1].join()
    with pytest.raises(RuntimeError, match=r"the process of a world \(processes=True\) has ended"):
        env.step(step)


@pytest.mark.parametrize("nested", [False, True])
def test_worlds_of_a_vector_made_elsewhere_keep_their_tuples(nested):
    """As many parts as there are worlds, so that nothing but the space tells them apart."""
    part = spaces.Box(-9.0, 9.0, (2,), np.float32)

    class InTuples(Counter):
        observation_space = spaces.Tuple((spaces.Tuple((part, part)),) * 2) if nested else spaces.Tuple((part, part))

        def _shown(self):
            one = tuple(super(InTuples, self)._shown() - number for number in range(2))
            return (one, one) if nested else one

    vector = SyncVectorEnv([InTuples] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
    shown = make_gym(vector, 2, seed=0).reset()["observation"]
    rows = [[env.count, 0.0, env.count - 1.0, -1.0] * (1 + nested) for env in vector.envs]
    assert shown.tolist() == rows


def test_subgoals_see_both_observations_of_an_environment_that_writes_into_one_array():
    class InPlace(Counter):
        shown = np.zeros(2, np.float32)

        def _shown(self):
            self.shown[:] = super()._shown()
            return self.shown

    class Steps(Subgoals):
        names = ("one", "two")
        repeatable = True

        def conditions(self, env, before, after, info):
            return [before is not None and after[0] - before[0] == size for size in (1, 2)]

    found = [played(make_gym(factory, 1, subgoals=Steps(), seed=0)) for factory in (Counter, InPlace)]
    assert found[0]["next", "attained"].any() and torch.equal(*(each["next", "attained"] for each in found))


class TestState:
    def test_what_subgoals_keep_is_part_of_the_state_if_they_say_so(self):
        class Offering(Counter):
            state_dict, load_state_dict = Remembering.state_dict, Remembering.load_state_dict

        class Third(Subgoals):
            """Attained in every third step of all."""

            names = ("third",)
            repeatable = True
            steps = 0

            def conditions(self, env, before, after, info):
                self.steps += before is not None
                return (before is not None and self.steps % 3 == 0,)

        class Stored(Third):
            def state_dict(self):
                return {"steps": self.steps}

            def load_state_dict(self, state):
                self.steps = state["steps"]

        what = [
            [each.what for each in check_task(make_gym(Offering, 2, subgoals=subgoals, seed=0))]
            for subgoals in (Stored(), Third())
        ]
        hole = "state_dict() must hold the whole state with random numbers, and does not"
        assert [hole in each for each in what] == [False, True]

    @pytest.mark.parametrize("factory", [Counter, lambda: TimeLimit(Counter(), 6), Remembering])
    def test_episodes_in_progress_go_on_as_if_nothing_had_happened(self, factory):
        def make(seed):
            return make_gym(factory, 3, subgoals=Milestones(), seed=seed)

        env = make(0)
        tensordict = go_on(env, env.reset(), 7)[:, -1]["next"].exclude("reward", "extrinsic_reward")
        tensordict = env.maybe_reset(tensordict)
        state = env.state_dict()
        expected = go_on(env, tensordict.clone(), 3)
        other = make(5)
        other.load_state_dict(state)
        found = go_on(other, tensordict.clone(), 3)
        for key in ("observation", ("next", "observation"), ("next", "attained"), ("next", "done")):
            assert torch.equal(expected[key], found[key])

    def test_new_episodes_after_a_restart_are_those_that_would_have_come(self):
        env = make_gym(Counter, 3, seed=0)
        tensordict = env.maybe_reset(
            go_on(env, env.reset(), 5)[:, -1]["next"].select("observation", "done", "terminated", "truncated")
        )
        state = env.state_dict()
        expected = go_on(env, tensordict.clone())
        env.load_state_dict(state)
        assert torch.equal(go_on(env, tensordict.clone())["observation"][..., 0], expected["observation"][..., 0])

    def test_episodes_that_cannot_be_brought_back_are_cut_off_and_a_warning_says_so(self):
        env = make_gym(Forgetful, 3, seed=0)
        tensordict = go_on(env, env.reset(), 3)[:, -1]["next"].select("observation", "done", "terminated", "truncated")
        tensordict = env.maybe_reset(tensordict)
        state = env.state_dict()
        with pytest.warns(UserWarning, match="could not be brought back .* not be bit for bit"):
            env.load_state_dict(state)
        step = go_on(env, tensordict.clone(), 3)
        assert torch.equal(step["next", "observation"][:, 0], tensordict["observation"])
        assert step["next", "truncated"][:, 0].all() and not step["next", "reward"][:, 0].any()
        assert not step["next", "truncated"][:, 1].any()

    def test_the_step_that_cuts_them_off_attains_nothing_again(self):
        outcome = ("attained", "success", "hazard")
        always = {"success": lambda reward, info: True, "hazard": lambda reward, info: True}
        env = make_gym(Forgetful, 2, seed=0, subgoals=Milestones(), **always)
        step = go_on(env, env.reset(), 3)[:, -1]["next"]
        state = env.state_dict()
        for key in outcome:
            state["entries"][key][:] = True
        with pytest.warns(UserWarning, match="could not be brought back"):
            env.load_state_dict(state)
        cut = env.step(step.select("observation").set("action", torch.zeros(2).long()))["next"]
        assert cut["truncated"].all() and not any(cut[key].any() for key in outcome)

    @pytest.mark.parametrize("processes", [False, True])
    def test_actions_that_are_refused_when_they_are_taken_again_end_no_training(self, processes):
        def second_if_it_can(tensordict):
            return tensordict.set("action", tensordict["action_mask"][:, 1].long())

        env = make_gym(partial(Forgetful, masked=True), 2 if processes else 8, seed=0, processes=processes)
        env.rollout(3, second_if_it_can, break_when_any_done=False)
        with pytest.warns(UserWarning, match="could not be brought back"):
            env.load_state_dict(env.state_dict())
        step = env.rollout(5, second_if_it_can, break_when_any_done=False)
        assert not step["next", "truncated"].any()
        env.close()

    def test_an_episode_of_too_many_actions_is_cut_off_and_the_next_one_is_brought_back(self, monkeypatch):
        monkeypatch.setattr(worlds, "MOST_ACTIONS", 5)
        env = make_gym(lambda: Counter(ends=False), 2, seed=0)
        bare = "observation", "done", "terminated", "truncated"
        tensordict = go_on(env, env.reset(), 5)[:, -1]["next"].select(*bare)
        go_on(env, tensordict.clone(), 1)
        assert env.state_dict()["worlds"] is None
        with pytest.warns(UserWarning, match="could not be brought back"):
            env.load_state_dict(env.state_dict())
        assert go_on(env, tensordict, 1)["next", "truncated"].all()
        tensordict = go_on(env, env.reset(), 5)[:, -1]["next"].select(*bare)
        state = env.state_dict()
        expected = go_on(env, tensordict.clone(), 2)
        env.load_state_dict(state)
        assert torch.equal(go_on(env, tensordict.clone(), 2)["next", "observation"], expected["next", "observation"])

    def test_what_worlds_of_another_kind_have_stored_is_not_brought_back(self):
        env = make_gym(Counter, 3, seed=0)
        env.reset()
        given = make_gym(SyncVectorEnv([Counter] * 3, autoreset_mode=AutoresetMode.DISABLED), 3, seed=0)
        with pytest.warns(UserWarning, match="could not be brought back"):
            given.load_state_dict(env.state_dict())

    def test_another_number_of_worlds_is_refused(self):
        env = make_gym(Counter, 3)
        env.reset()
        with pytest.raises(ValueError, match=r"state_dict must hold 2 worlds, got 3\."):
            make_gym(Counter, 2).load_state_dict(env.state_dict())


@pytest.mark.parametrize(
    ("id", "settings", "words"),
    [
        ("CartPole-v1", {"num_envs": 0}, "num_envs must be a whole number >= 1, got 0"),
        (
            "NoSuch-v1",
            {},
            r"that of an environment that Gymnasium knows, got 'NoSuch-v1' .*; package=my_package \(env\.package",
        ),
        (
            "CartPole-v1",
            {"settings": {"wheels": 4}},
            r"settings must be arguments that CartPole-v1 takes, got",
        ),
        ("Pendulum-v1", {}, "id must be an environment with one discrete action, got Box"),
        ("CartPole-v1", {"actions": [0, 2]}, r"actions must be different numbers in \[0, 1\], got \[0, 2\]"),
        ("CartPole-v1", {"backend": "jax"}, "backend must be 'gymnasium' or 'envpool', got 'jax'"),
        ("CartPole-v1", {"max_steps": 0}, "max_steps must be a whole number >= 1, got 0; None"),
        ("CartPole-v1", {"subgoals": "no.such"}, "subgoals must name something that can be imported, got 'no.such'"),
        ("CartPole-v1", {"subgoals": "no.such"}, r"No module named 'no'\); name the folder .* export PYTHONPATH=\$PWD"),
        ("CartPole-v1", {"subgoals": "gym_toys.Nope"}, r"'gym_toys.Nope' \(module .* no attribute 'Nope'\)\.$"),
        ("CartPole-v1", {"subgoals": 3}, "subgoals must derive from hdrqn_torchrl.envs.Subgoals and have names, got 3"),
        ("CartPole-v1", {"subgoals": "gym_toys.Counter"}, "subgoals must derive from hdrqn_torchrl.envs.Subgoals"),
        ("CartPole-v1", {"num_envs": "2"}, "num_envs must be a whole number >= 1, got '2'"),
        ("CartPole-v1", {"num_envs": None}, "num_envs must be a whole number >= 1, got None"),
        ("CartPole-v1", {"max_steps": "7"}, "max_steps must be a whole number >= 1, got '7'"),
        ("CartPole-v1", {"max_steps": 1.5}, "max_steps must be a whole number >= 1, got 1.5"),
        ("CartPole-v1", {"seed": "0"}, "seed must be a whole number >= 0, got '0'; None: one is drawn"),
        ("CartPole-v1", {"seed": -1}, "seed must be a whole number >= 0, got -1"),
        ("CartPole-v1", {"max_steps": True}, "max_steps must be a whole number >= 1, got True"),
        ("CartPole-v1", {"actions": 2}, r"actions must be a list of numbers of actions, got 2; put .* into \[...\]"),
        ("CartPole-v1", {"actions": [0.5]}, r"actions must be a list of numbers of actions, got \[0.5\]"),
        ("CartPole-v1", {"settings": [1]}, r"settings must be arguments of the environment by name, got \[1\]"),
        ("CartPole-v1", {"wrappers": "gym_toys.Counter"}, "wrappers must be a list, got 'gym_toys.Counter'"),
        ("CartPole-v1", {"wrappers": [lambda env: None]}, "wrappers must return an environment .* returned None"),
        ("CartPole-v1", {"wrappers": [TimeLimit]}, "wrappers must take an environment and nothing else, got TimeLimit"),
        ("CartPole-v1", {"wrappers": [{}]}, "wrappers must be functions or classes that take a world, got {}"),
        ("CartPole-v1", {"success": lambda r: True}, r"success must name .* or be a function of \(reward, info\)"),
        ("CartPole-v1", {"hazard": 3}, "hazard must name an entry of info, or be a function"),
        (None, {}, "id must be the id of an environment, a function .* got None"),
        (5, {}, "id must be the id of an environment, a function .* got 5"),
        ("", {}, "id must be the id of an environment, a function .* got ''"),
        (Counter(), {}, "id must be the id of an environment, .*; pass the function that makes it"),
        (lambda: None, {}, "id, a function, must return an environment of Gymnasium, got one that returned None"),
        ("nopkg:Foo-v0", {}, "nopkg:Foo-v0 needs nopkg, which can't be imported .*; install it, or .* PYTHONPATH"),
        ("CartPole-v1", {"package": "no_such_package"}, "CartPole-v1 needs no_such_package, which can't be imported"),
    ],
)
def test_what_cannot_be_made_is_refused(id, settings, words):
    with pytest.raises((ValueError, ImportError), match=words):
        make_gym(id, **settings)


def test_worlds_in_processes_of_their_own_are_refused_where_there_can_be_none(monkeypatch):
    monkeypatch.setitem(current_process()._config, "daemon", True)  # as in a worker
    with pytest.raises(ValueError, match="processes must be False in a worker of collector=processes, got True"):
        make_gym("CartPole-v1", 2, processes=True)


class Stating(Counter):
    """Says what it is like."""

    def __init__(self, actions=("one", "two")):
        super().__init__()
        self.task = Task(
            max_steps=20, largest_return=1.0, smallest_extrinsic_return=0.0, ordered=True, actions=actions,
            references={"counts": Reference(what="the count", play=lambda seconds: {"return_mean": 1.0})},
            ceiling="counts", symmetries=(Symmetry(places=(0, 1), actions=(1, 0)),),
        )  # fmt: skip


class TestStatement:
    """What an environment says in its attribute ``task``."""

    def test_holds(self):
        task = make_gym(Stating, 2, subgoals=Milestones()).task
        assert (task.max_steps, task.ordered, task.actions, task.ceiling) == (20, True, ("one", "two"), "counts")
        assert (task.largest_return, task.largest_extrinsic_return, task.smallest_extrinsic_return) == (1.0, 1.0, 0.0)
        assert task.subgoals[0].names == Milestones.names and len(task.symmetries) == 1

    def test_gives_way_to_arguments(self):
        task = make_gym(Stating, 2, max_steps=5, largest_return=3.0, smallest_return=-1.0).task
        assert (task.max_steps, task.largest_return, task.smallest_extrinsic_return) == (5, 3.0, -1.0)
        assert task.ceiling is None, "its players play longer episodes"

    @pytest.mark.parametrize("change", [{"reward": "count"}, {"wrappers": [lambda env: env]}])
    def test_of_returns_is_forgotten_where_rewards_may_be_others(self, change):
        task = make_gym(Stating, 2, **change).task
        assert (task.largest_return, task.smallest_extrinsic_return, task.references) == (np.inf, -np.inf, {})
        assert task.ordered and task.actions == ("one", "two")

    def test_names_the_actions_that_are_left(self):
        task = make_gym(Stating, 2, actions=[1]).task
        assert task.actions == ("two",) and task.symmetries == ()

    def test_of_other_actions_is_refused(self):
        with pytest.raises(ValueError, match=r"task.actions must name the 2 actions of the environment, got \['go'\]"):
            make_gym(lambda: Stating(("go",)), 2)

    def test_of_another_kind_is_left_alone(self):
        class Chores(Counter):
            task = "wash up"

        assert make_gym(Chores, 2).task == Task()


def test_subgoals_that_return_a_wrong_number_of_conditions_are_refused():
    class Wrong(Milestones):
        def conditions(self, env, before, after, info):
            return (True,)

    with pytest.raises(ValueError, match=r"what subgoals.conditions returns, one for .* must be 2 truth values"):
        make_gym(Counter, 2, subgoals=Wrong()).reset()


def test_fewer_actions_are_the_environment_s_own_by_number():
    step = played(make_gym(Counter, 2, actions=[1], seed=0), 5)
    assert np.unique((step["next", "observation"] - step["observation"])[..., 0]).tolist() == [2.0]
