"""Memories of versions that kept each observation twice."""

import warnings
from copy import deepcopy

import pytest
import torch
from helpers import build, collect, small_env

from hdrqn_torchrl.learning.stored import holds_inputs_twice


def filled(name="v2"):
    torch.manual_seed(0)
    algorithm = build(name, small_env(4))
    for batch in collect(algorithm, small_env(4), 20, batches=2):
        algorithm.observe(batch)
    for learner in algorithm.learners.values():
        learner.learn()
    return algorithm


def as_before(state, *inputs):
    """The state as those versions wrote it."""
    stored = state["buffer"]["_storage"]["stored"]
    for key in inputs:
        stored["next", key] = stored[key].clone()
    return state


@pytest.mark.parametrize(
    ("name", "level", "inputs"),
    [
        ("v2", "sub", ("observation", "subgoal")),
        ("v2", "meta", ("sub_hidden", "subgoal_mask")),
        ("drqn", "flat", ("observation",)),
    ],
)
def test_memories_of_earlier_versions_are_left_out_with_a_warning_and_the_rest_is_loaded(name, level, inputs):
    learner = filled(name).learners[level]
    state = as_before(deepcopy(learner.state_dict()), *inputs)
    successor = build(name, small_env(4)).learners[level]
    with pytest.warns(UserWarning, match="the stored replay memory is of an earlier version, .* it begins empty"):
        successor.load_state_dict(state)
    assert len(successor.buffer) == 0 and successor.updates == learner.updates and successor.updates_due() == 0
    for old, new in zip(learner.network.parameters(), successor.network.parameters(), strict=True):
        assert torch.equal(old, new)


@pytest.mark.parametrize("name", ["drqn", "v1", "v2", "v3"])
def test_current_memories_are_loaded_whole(name):
    for level, learner in filled(name).learners.items():
        successor = build(name, small_env(4)).learners[level]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            successor.load_state_dict(deepcopy(learner.state_dict()))
        assert len(successor.buffer) == len(learner.buffer) > 0


def test_an_empty_memory_is_not_taken_for_an_earlier_one():
    assert not holds_inputs_twice({"_storage": {"stored": None}}, ["observation"])


def test_options_in_progress_of_earlier_versions_are_forgotten():
    extract = filled().learners["meta"].extract
    state = deepcopy(extract.state_dict())
    state["held"] = state["held"].exclude("over")
    successor = build("v2", small_env(4)).learners["meta"].extract
    successor.load_state_dict(state)
    assert successor.state_dict()["held"] is None and successor.state_dict()["is_open"] is not None
