"""What a builder does unless told otherwise is what ``conf/algo/`` says, value by value."""

from __future__ import annotations

import inspect
from dataclasses import asdict, fields, is_dataclass, replace
from functools import cache, partial

import pytest
import torch
from helpers import small_env
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from hdrqn_torchrl.algorithms import make_dqn, make_drqn, make_hdqn, make_hdrqn, make_v3, presets
from hdrqn_torchrl.cli.configuration import CONF, plain
from hdrqn_torchrl.learning import LearnerSettings
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.runs.settings.building import build

BUILDERS = {
    "dqn": make_dqn,
    "drqn": make_drqn,
    "hdqn": make_hdqn,
    "v1": partial(make_hdrqn, version="v1"),
    "v2": make_hdrqn,
    "v3": make_v3,
}
LEARNERS = {"sub", "meta", "learner"}
PYTHON_ONLY = {"repeatable_subgoals", "total_frames"}  # what the environment is like; what conf/ puts into learners
OF_MEMORY = {"recurrent", "prediction_steps", "prediction_weight"}
TAKEN_AWAY = {
    "dqn": OF_MEMORY,
    "hdqn": {*OF_MEMORY, "version", "meta_input", "meta_input_time", "refresh_hidden_steps"},
}
"""Settings in ``conf/`` of the general builder that an agent without memory has no use for."""
DIFFERS = {"precision": ("auto", "fp32")}  # a training asks the machine; a call in Python computes the same on all
NOT_V3 = {"max_target", "trace_decay", "n_step"}  # v3's loss has targets of its own

algorithms = pytest.mark.parametrize("name", BUILDERS)


@cache
def composed(name: str, *overrides: str) -> dict:
    """The settings of ``algo=name``, with nothing that a particular environment asks for."""
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        return plain(compose("config", overrides=[f"algo={name}", "per_env_algo=none", *overrides]))["algo"]


@cache
def agents(name: str):
    """The same agent from Python's defaults and from ``conf/``."""
    env, network = small_env(2), compact_network(8, (8,))
    return BUILDERS[name](env, network), build(composed(name), env, network, place="algo")


def test_every_algorithm_of_conf_is_compared():
    assert sorted(BUILDERS) == sorted(path.stem for path in (CONF / "algo").glob("*.yaml"))


@algorithms
def test_arguments(name):
    arguments = inspect.signature(BUILDERS[name]).parameters
    defaults = {key: each.default for key, each in arguments.items() if each.default is not inspect.Parameter.empty}
    stated = {key: value for key, value in composed(name).items() if key != "_target_"}
    stated = {key: value for key, value in stated.items() if key not in TAKEN_AWAY.get(name, set())}
    assert set(defaults) - PYTHON_ONLY == set(stated)
    built = LEARNERS | {key for key in stated if key.endswith("exploration")}  # compared below
    assert {key: as_numbers(defaults[key]) for key in stated if key not in built} == {
        key: as_numbers(stated[key]) for key in stated if key not in built
    }


def as_numbers(value):
    """Settings as numbers and words, from Python or from ``conf/``."""
    if is_dataclass(value):
        return asdict(value)
    return {key: each for key, each in value.items() if key != "_target_"} if isinstance(value, dict) else value


@algorithms
def test_learners(name):
    (python, conf), changes = agents(name), {key: value for key, (_, value) in DIFFERS.items()}
    settings = {level: replace(learner.settings, **changes) for level, learner in conf.learners.items()}
    assert {level: learner.settings for level, learner in python.learners.items()} == settings


@algorithms
def test_explorations(name):
    def described(exploration):
        plain_values = {key: value for key, value in vars(exploration).items() if isinstance(value, (int, float))}
        tensors = {key: value.tolist() for key, value in exploration.named_buffers()}
        return type(exploration), plain_values, tensors

    python, conf = agents(name)
    assert {level: described(each) for level, each in python.explorations.items()} == {
        level: described(each) for level, each in conf.explorations.items()
    }


@algorithms
def test_schedules_are_not_shared_between_agents(name):
    first, second = (BUILDERS[name](small_env(2), compact_network(8, (8,))) for _ in range(2))
    for exploration in first.explorations.values():
        exploration.step(50_000)
    assert all(each.frames == 0 and each.epsilon == 1.0 for each in second.explorations.values())


@algorithms
def test_conf_states_every_setting_of_a_learner(name):
    known = {each.name for each in fields(LearnerSettings)} - (NOT_V3 if name == "v3" else set())
    stated = {key: set(value) - {"_target_"} for key, value in composed(name).items() if key in LEARNERS}
    assert stated and all(each == known for each in stated.values())
    for learner in (composed(name)[key] for key in stated):
        assert {key: learner[key] for key in DIFFERS} == {key: value for key, (value, _) in DIFFERS.items()}


def test_a_setting_given_for_one_level_leaves_the_other_and_everything_else_as_it_is():
    usual, changed = composed("v2"), composed("v2", "algo.sub.slice_len=12")
    assert changed["sub"] == usual["sub"] | {"slice_len": 12} and changed["meta"] == usual["meta"]


def test_the_learning_rate_falls_as_long_as_a_training_is_by_default():
    total_frames = OmegaConf.load(CONF / "config.yaml").total_frames
    assert LearnerSettings().learning_rate_frames == total_frames
    assert composed("v2", "total_frames=150_000")["meta"]["learning_rate_frames"] == 150_000


def test_v1_looks_at_two_options_in_a_row_and_v2_at_one():
    env, network = small_env(2), compact_network(8, (8,))
    lengths = [make_hdrqn(env, network, version=each).learners["meta"].settings.slice_len for each in ("v1", "v2")]
    assert lengths == [2, 1]
    given = make_hdrqn(env, network, version="v1", meta=presets.META_LEARNER)
    assert given.learners["meta"].settings == presets.META_LEARNER


def test_default_agents_have_the_same_weights_from_python_and_from_conf():
    """Nothing else is drawn on the way to a network."""
    env, network, weights = small_env(2), compact_network(8, (8,)), []
    for make in (make_hdrqn, lambda *parts: build(composed("v2"), *parts, place="algo")):
        torch.manual_seed(0)
        weights.append(make(env, network).policy.state_dict())
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0] if torch.is_tensor(weights[0][key]))


@algorithms
def test_learning_rates_fall_until_the_last_frame_of_a_training(name):
    learners = BUILDERS[name](small_env(2), compact_network(8, (8,)), total_frames=5_000).learners
    assert {learner.settings.learning_rate_frames for learner in learners.values()} == {5_000}
    told = build(composed(name, "total_frames=5000"), small_env(2), compact_network(8, (8,)), place="algo").learners
    assert [each.settings.learning_rate_frames for each in told.values()] == [5_000] * len(learners)
