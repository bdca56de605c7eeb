"""The size of a stored step and of a stored option: each observation is there once."""

import pytest
import torch
from helpers import build, collect, small_env
from tensordict import TensorDict

from hdrqn_torchrl.data import StepSelector

STATE = 8  # hidden units of the small networks, four bytes each


def bytes_of(rows):
    return sum(value.element_size() * value.numel() for value in rows.values(True, True)) / rows.numel()


@pytest.mark.parametrize("name", ["dqn", "drqn", "hdqn", "v1", "v2", "v3"])
def test_no_network_input_is_stored_under_next(name):
    algorithm = build(name, small_env(8))
    (batch,) = collect(algorithm, small_env(8), 20)
    for level, learner in algorithm.learners.items():
        stored = learner.extract(batch)
        read = {key for key in learner.loss.in_keys if not isinstance(key, tuple)} | {"observation", "subgoal"}
        assert not {key for key in stored["next"].keys(True, True) if key in read}, level


@pytest.mark.parametrize(
    ("name", "level", "expected"),
    [
        ("dqn", "flat", {"observation": 9}),
        ("v1", "meta", {"observation": 9, "subgoal_mask": 2}),
        ("v2", "sub", {"observation": 9, "subgoal": 8}),
        ("v2", "meta", {"sub_hidden": 4 * STATE, "subgoal_mask": 2}),
    ],
)
def test_a_row_has_the_size_of_its_inputs_and_a_few_numbers(name, level, expected):
    algorithm = build(name, small_env(8))
    (batch,) = collect(algorithm, small_env(8), 20)
    stored = algorithm.learners[level].extract(batch)
    inputs = {key: bytes_of(stored.select(key)) for key in expected}
    assert inputs == expected
    assert bytes_of(stored) <= sum(inputs.values()) + 34  # actions, flags, rewards and the number of the episode


@pytest.mark.parametrize(("shape", "most"), [((3, 3), 60), ((3, 44, 44), 3 * 44 * 44 + 50)])
def test_a_row_of_a_screen_has_the_size_of_its_inputs_and_a_few_numbers(shape, most):
    """Montezuma's Revenge has 5,808 bytes an observation."""
    batch = TensorDict(observation=torch.zeros(2, 5, *shape, dtype=torch.uint8), batch_size=[2, 5])
    flag = torch.zeros(2, 5, 1, dtype=torch.bool)
    batch.update({"action": torch.zeros(2, 5, dtype=torch.int64), "is_init": flag})
    batch["collector", "traj_ids"] = torch.zeros(2, 5, dtype=torch.int64)
    batch["next"] = batch.select("observation")
    batch["next"].update({"reward": torch.zeros(2, 5, 1), "done": flag, "terminated": flag, "truncated": flag})
    stored = StepSelector(root_keys=["observation", "action", "is_init"], next_keys=["reward"])(batch)
    assert bytes_of(stored) <= most
