"""What an environment returns against its spaces or Gymnasium's rules is refused in the step in which it does."""

import re

import gymnasium
import numpy as np
import pytest
import torch
from gym_toys import Counter
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit

from hdrqn_torchrl.envs import check_task, make_gym
from hdrqn_torchrl.envs.gym import Subgoals, make_encoder


class Odd(gymnasium.Env):
    """It shows, says and returns what it is told to, after a first step as it should be.

    Args:
        odd: entries of a step that differ: ``reset``, ``observation``, ``reward``, ``terminated``, ``info``, ``step``.
        at_reset: entries of ``info`` at a reset.
    """

    observation_space = spaces.Box(0.0, 1.0, (2,), np.float32)
    action_space = spaces.Discrete(3)

    def __init__(self, *, at_reset=None, **odd):
        self.at_reset, self.odd, self.steps = at_reset or {}, odd, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.odd.get("reset", (np.zeros(2, np.float32), self.at_reset))

    def step(self, action):
        self.steps += 1
        told = self.odd if self.steps > 1 else {}
        info = told.get("info", self.at_reset)
        usual = (
            told.get("observation", np.zeros(2, np.float32)), told.get("reward", 0.0), told.get("terminated", False),
            False, info,
        )  # fmt: skip
        return told.get("step", usual)


def mask(*allowed):
    return {"action_mask": np.array(allowed, np.int8)}


def refused(words, env, steps=3):
    torch.manual_seed(0)
    with pytest.raises(ValueError, match=words):
        env.rollout(steps, break_when_any_done=False)


class TestActionMasks:
    @pytest.mark.parametrize(
        ("info", "words"),
        [
            (mask(0, 0, 0), r"must allow one of the agent's actions until the episode is over, got \[0, 0, 0\]"),
            (mask(1, 1), r"info\['action_mask'\], one for each action, must be 3 truth values"),
            (mask(1, 1, 1, 1), "must be 3 truth values"),
            ({"action_mask": [0.5, 1, 0]}, "must be True or False"),
            ({"action_mask": "101"}, "must be 3 truth values, got '101'"),
            ({}, "must be there at resets and after every step, info has"),
        ],
    )
    def test_that_break_the_rule_are_refused_in_the_middle_of_an_episode(self, info, words):
        refused(words, make_gym(lambda: Odd(at_reset=mask(1, 0, 1), info=info), 2, seed=0))

    def test_that_allow_nothing_are_refused_at_a_reset(self):
        refused("must allow one of the agent's actions", make_gym(lambda: Odd(at_reset=mask(0, 0, 0)), 2))

    def test_that_come_only_after_steps_are_refused(self):
        refused("must be there at the first reset, too", make_gym(lambda: Odd(info=mask(1, 1, 1)), 2))

    def test_that_allow_only_actions_which_the_agent_lacks_are_refused(self):
        refused(r"agent's actions \(actions=", make_gym(lambda: Odd(at_reset=mask(0, 1, 0)), 2, actions=[2, 0]))

    def test_may_allow_nothing_when_the_episode_is_over(self):
        env = make_gym(lambda: Odd(at_reset=mask(1, 1, 1), info=mask(0, 0, 0), terminated=True), 2)
        step = env.rollout(4, break_when_any_done=False)
        assert not step["next", "action_mask"][:, 1].any() and step["action_mask"].all()

    def test_are_read_by_the_places_of_actions_whose_numbers_begin_elsewhere(self):
        def make():
            env = Odd(at_reset=mask(0, 0, 1))
            env.action_space = spaces.Discrete(3, start=5)
            return env

        assert make_gym(make, 2, actions=[7, 5]).reset()["action_mask"].tolist() == [[True, False]] * 2

    def test_of_vectors_made_elsewhere_are_checked_too(self):
        vector = SyncVectorEnv(
            [lambda: Odd(at_reset=mask(1, 1, 1), info=mask(0, 0, 0))] * 2, autoreset_mode=AutoresetMode.DISABLED
        )
        refused("must allow one of the agent's actions", make_gym(vector, 2))


class TestObservations:
    @pytest.mark.parametrize(
        ("space", "options", "value", "words"),
        [
            (spaces.Discrete(3), {}, 3, "observation must be a whole number from 0 to 2, got 3"),
            (spaces.Discrete(3), {}, -1, "from 0 to 2, got -1"),
            (spaces.Discrete(3, start=5), {}, 4, "from 5 to 7, got 4"),
            (spaces.Discrete(3), {}, 1.5, "from 0 to 2, got 1.5"),
            (spaces.MultiDiscrete([3, 5]), {}, np.array([0, 5]), r"observation\[1\] must be .* from 0 to 4, got 5"),
            (spaces.MultiDiscrete([3, 300]), {}, np.array([-1, 0]), r"observation\[0\] must be .* from 0 to 2, got -1"),
            (spaces.MultiDiscrete([3, 5]), {}, np.array([np.nan, 0]), r"observation\[0\] .* got nan"),
            (spaces.MultiBinary(2), {}, np.array([0, 2], np.int8), r"observation\[1\] must be .* from 0 to 1, got 2"),
            (spaces.Box(-5, 5, (2,), np.int32), {"codes": 11}, np.array([0, -5]), r"\[1\] .* from 0 to 10, got -5"),
            (spaces.Box(0, 255, (2, 2), np.uint8), {"codes": 4}, np.full((2, 2), 4), r"\[0, 0\] .* from 0 to 3, got 4"),
            (spaces.Box(0, 255, (9, 9), np.uint8), {}, np.full((9, 9), 0.7), r"\[0, 0\] .* from 0 to 255, got 0.7"),
            (spaces.Box(0, 255, (9, 9, 3), np.uint8), {}, np.full((9, 9, 3), 300), "from 0 to 255, got 300"),
            (spaces.Box(0, 255, (9, 9, 3), np.uint8), {}, np.full((9, 9, 3), -1), "from 0 to 255, got -1"),
            (
                spaces.Dict({"a": spaces.Discrete(3), "b": spaces.Box(0, 1, (2,))}), {}, {"a": 3, "b": np.zeros(2)},
                r"observation\['a'\] must be a whole number from 0 to 2, got 3",
            ),
        ],
    )  # fmt: skip
    def test_outside_of_their_space_are_refused(self, space, options, value, words):
        with pytest.raises(ValueError, match=words):
            make_encoder(space, **options).encode(value)

    @pytest.mark.parametrize(
        ("space", "value", "words"),
        [
            (
                spaces.Box(0, 1, (2,)),
                np.zeros(3),
                r"observation must be numbers of the shape \[2\] .* got float64 \[3\]",
            ),
            (spaces.Box(0, 1, (2, 3)), np.zeros((3, 2)), r"of the shape \[2, 3\] .* got float64 \[3, 2\]"),
            (spaces.Box(0, 1, (2,)), None, r"of the shape \[2\] .* got None"),
            (spaces.Box(0, 1, (2,)), [[1], [1, 2]], r"of the shape \[2\] .* got \[\[1\], \[1, 2\]\]"),
            (spaces.Box(0, 255, (9, 9, 3), np.uint8), np.zeros((1, 1, 3), np.uint8), r"of the shape \[9, 9, 3\]"),
            (spaces.Discrete(3), np.zeros(2, np.int64), r"of the shape \[\] .* got int64 \[2\]"),
            (spaces.Text(5), 5, r"observation must be a text \(str\), got 5"),
            (spaces.Dict({"a": spaces.Text(5)}), {"b": "x"}, r"observation must have the entry 'a' .* entries \['b'\]"),
            (spaces.Tuple([spaces.Discrete(2)] * 2), (0,), "observation must have the entry 1 as its space says"),
            (spaces.Dict({"a": spaces.Discrete(2)}), None, "observation must have the entry 'a' as its space says"),
        ],
    )
    def test_of_another_kind_or_shape_are_refused(self, space, value, words):
        with pytest.raises(ValueError, match=words):
            make_encoder(space).encode(value)

    def test_of_one_number_may_be_an_array_or_whole_as_a_float(self):
        encode = make_encoder(spaces.Discrete(3)).encode
        assert [encode(value).tolist() for value in (2, np.int8(2), np.array(2), np.array([2]), 2.0)] == [[2]] * 5

    @pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
    def test_that_are_no_finite_numbers_as_float32_are_refused_with_their_entry(self, value):
        def make():
            env = Odd(at_reset={}, observation={"a": np.zeros(2), "b": np.array([0.0, value])})
            env.observation_space = spaces.Dict({key: spaces.Box(-1e300, 1e300, (2,), np.float64) for key in "ab"})
            env.odd["reset"] = {"a": np.zeros(2), "b": np.zeros(2)}, {}
            env.step = lambda action: (env.odd["observation"], 0.0, False, False, {})
            return env

        with np.errstate(over="ignore"):
            refused(re.escape("observation['b'][1] of world 0 must be a finite number as float32"), make_gym(make, 2))


NOTHING = np.zeros(2, np.float32)


class TestSteps:
    @pytest.mark.parametrize(
        ("odd", "words"),
        [
            ({"reward": None}, "reward must be a finite number, got None"),
            ({"reward": "1.0"}, "reward must be a finite number, got '1.0'"),
            ({"reward": np.zeros(2)}, r"reward must be a finite number, got float64 \[2\]"),
            ({"reward": float("nan")}, "reward must be a finite number, got nan"),
            ({"terminated": None}, "terminated must be True or False"),
            ({"info": None}, r"step must return \(observation, .* with a dictionary as info, got None"),
            (
                {"step": (NOTHING, 0.0, False, {})},
                r"step must return \(observation, reward, terminated, ",
            ),
            ({"reset": NOTHING}, r"reset must return \(observation, info\)"),
            ({"reset": (NOTHING, None)}, r"reset must return \(observation, info\) with a dictionary"),
        ],
    )
    @pytest.mark.parametrize("max_steps", [None, 9], ids=["bare", "limited"])
    def test_against_the_rules_of_gymnasium_are_refused(self, odd, words, max_steps):
        with pytest.raises(ValueError, match=words):
            make_gym(lambda: Odd(**odd), 2, max_steps=max_steps).rollout(3)

    def test_may_pay_a_reward_in_an_array_of_one_number(self):
        env = make_gym(lambda: Odd(reward=np.array([0.5], np.float32), terminated=np.array([True])), 2)
        step = env.rollout(3, break_when_any_done=False)["next"]
        assert step["reward"][:, 1].tolist() == [[0.5]] * 2 and step["terminated"][:, 1].all()

    @pytest.mark.parametrize("name", ["success", "hazard"])
    @pytest.mark.parametrize("verdict", ["no", None, float("nan"), np.array([True, False]), 2])
    def test_have_verdicts_that_are_true_or_false(self, verdict, name):
        env = make_gym(lambda: Odd(at_reset={"x": verdict}), 2, **{name: "x"})
        refused(f"{name} must be True or False", env)

    def test_get_a_number_from_a_rule_for_the_reward(self):
        refused("reward must be a finite number, got None", make_gym(Odd, 2, reward=lambda reward, info: None))


def made_with(conditions, id=Odd, **odd):
    own = {"names": ("a", "b"), "conditions": lambda self, *given: conditions(*given), **odd}
    return make_gym(id, 2, subgoals=type("Own", (Subgoals,), own)())


class TestSubgoals:
    @pytest.mark.parametrize(
        "holds", [("no", "no"), (float("nan"), 0), (2, 3), None, True, (True,), {"a": True, "b": True}]
    )
    def test_have_conditions_that_are_true_or_false(self, holds):
        refused("what subgoals.conditions returns, one for each", made_with(lambda *_: holds))

    def test_that_fail_are_named_with_the_step(self):
        def fail(env, before, after, info):
            if env.unwrapped.steps == 2:
                raise KeyError("door")
            return True, False

        words = r"subgoals.conditions of Own \(a, b\) must not fail, got KeyError: 'door', 2 steps into an episode"
        refused(words, made_with(fail))

    def test_that_overlook_wrappers_are_told_of_them(self):
        env = made_with(lambda env, *_: (env.steps > 1, False), lambda: TimeLimit(Odd(), 9))
        refused("no attribute 'steps', .*; env is what wrappers show of it: use env.unwrapped.steps", env)

    def test_that_compare_with_what_was_before_a_reset_are_told_that_there_is_nothing(self):
        refused("must not fail, got TypeError: .*, 0 steps .*; before is None at a", made_with(lambda _, b, *__: b[0]))

    def test_that_look_into_worlds_which_can_not_be_looked_into_are_told_so(self):
        vector = SyncVectorEnv([Counter] * 2, autoreset_mode=AutoresetMode.DISABLED)
        refused("must not fail, .*; env is None for EnvPool", made_with(lambda env, *_: env.unwrapped, vector))

    @pytest.mark.parametrize(
        "odd", [{"names": "ab"}, {"names": ("a", "a")}, {"repeatable": (True,)}, {"repeatable": "no"}]
    )
    def test_with_other_names_or_answers_are_refused(self, odd):
        with pytest.raises(ValueError, match=f"subgoals.{next(iter(odd))} must be"):
            made_with(lambda *_: (True, True), **odd)


def test_the_check_of_a_task_says_what_is_returned_wrongly():
    found = [str(each) for each in check_task(make_gym(lambda: Odd(observation=np.full(2, np.nan)), 2), steps=5)]
    assert found[0].startswith("wrong: observation[0] of world 0 must be a finite number"), found
    assert [each for each in check_task(make_gym(Counter, 2, max_steps=9), steps=5) if each.severity == "wrong"] == []
