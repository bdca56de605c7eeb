import math

import pytest
import torch

from hdrqn_torchrl.transforms import IntrinsicReward

REWARDS = IntrinsicReward(reached=2.0, hazard=-0.75, wrong_subgoal=-0.5)
ATTAINED = torch.tensor([[False, False], [True, False], [False, True], [True, True]])
HAZARD = torch.tensor([[True], [False], [True], [False]])
# By hand, for subgoal 0 and for subgoal 1.
EXPECTED = torch.tensor([[-0.75, -0.75], [2.0, -0.5], [-1.25, 1.25], [1.5, 1.5]])


def test_the_intrinsic_reward_for_all_subgoals_by_hand():
    assert torch.equal(REWARDS.of_all(ATTAINED, HAZARD), EXPECTED)


@pytest.mark.parametrize("subgoal", [0, 1])
def test_the_intrinsic_reward_for_one_subgoal_is_that_of_all(subgoal):
    reached = ATTAINED[:, [subgoal]]
    assert torch.equal(REWARDS.of(ATTAINED, reached, HAZARD), EXPECTED[:, [subgoal]])


def test_the_intrinsic_reward_needs_no_hazard():
    assert torch.equal(REWARDS.of_all(ATTAINED), EXPECTED + 0.75 * HAZARD)


@pytest.mark.parametrize(
    ("settings", "largest"),
    [
        ({}, 1.0),
        ({"reached": 0.25}, 0.25),
        ({"reached": -1.0}, 0.0),
        ({"hazard": 0.1}, math.inf),
        ({"wrong_subgoal": 0.5}, math.inf),
    ],
)
def test_the_largest_return_of_an_option_is_known_unless_other_rewards_are_positive(settings, largest):
    assert IntrinsicReward(**settings).largest_return == largest
