"""Acting by the mean of Q-values over all changed worlds: the same in each of them."""

import pytest
import torch
from helpers import ROOM, build, collect, small_env, tiny_settings

from hdrqn_torchrl.algorithms import make_v3
from hdrqn_torchrl.envs.grid.symmetries import grid_symmetries
from hdrqn_torchrl.modules import AllSubgoalsNetwork, CellFeatures, compact_network
from hdrqn_torchrl.modules.symmetric_mean import PREFERENCE, SymmetricMean

SIZE, STEPS = 8, 5
CLOSE = {"rtol": 0, "atol": 1e-6}
PREFERRED = -PREFERENCE * torch.arange(4)
TURNS = grid_symmetries(ROOM, 3)


def make_network():
    torch.manual_seed(0)
    return AllSubgoalsNetwork(CellFeatures(3, num_codes=5), num_actions=4, num_subgoals=2, hidden_size=SIZE)


def sequence(*batch):
    torch.manual_seed(1)
    observation = torch.randint(5, (STEPS, *batch, 3, 3), dtype=torch.uint8)
    init = torch.rand(STEPS, *batch) < 0.3
    return observation, torch.randint(4, (STEPS, *batch)), init, torch.rand(STEPS, *batch, 2) < 0.7


def values_along(step, observation, action, init, mask, size):
    """Values of both levels at each step of a sequence that begins with an empty memory."""
    state = (torch.zeros(*init.shape[1:], size), torch.zeros(*init.shape[1:], size))
    values = []
    for seen, did, first, allowed in zip(observation, action, init, mask, strict=True):
        value, state = step(seen, did, first, [allowed], state)
        values.append(value)
    return [torch.stack(level) for level in zip(*values, strict=True)]


def mean_along(symmetries, network, *inputs):
    mean = SymmetricMean(symmetries)
    return values_along(lambda *step: mean.step(network, *step), *inputs, mean.number * SIZE)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_it_is_the_mean_over_the_changed_worlds(batch):
    network, (observation, action, init, mask) = make_network(), sequence(*batch)
    expected = [PREFERRED, 0.0]
    changes = [(list(range(9)), list(range(4))), *((list(turn.places), list(turn.actions)) for turn in TURNS)]
    assert len(changes) == 8
    rows = (observation.view(STEPS, -1, 3, 3), action.view(STEPS, -1), init.view(STEPS, -1), mask.view(STEPS, -1, 2))
    for places, actions in changes:
        seen = rows[0].flatten(-2)[..., places].view_as(rows[0])
        did = torch.tensor(actions)[rows[1]]
        action_value, subgoal_value = values_along(network.step, seen, did, *rows[2:], SIZE)
        expected[0] = expected[0] + action_value[..., actions] / 8
        expected[1] = expected[1] + subgoal_value / 8
    for found, wanted in zip(mean_along(TURNS, network, observation, action, init, mask), expected, strict=True):
        torch.testing.assert_close(found, wanted.view_as(found), **CLOSE)


@pytest.mark.parametrize("turn", TURNS)
def test_it_is_the_same_in_each_changed_world(turn):
    network, (observation, action, init, mask) = make_network(), sequence(3)
    action_value, subgoal_value = mean_along(TURNS, network, observation, action, init, mask)
    changed = observation.flatten(-2)[..., list(turn.places)].view_as(observation)
    did = torch.tensor(turn.actions)[action]
    there, chosen = mean_along(TURNS, network, changed, did, init, mask)
    torch.testing.assert_close((there - PREFERRED)[..., list(turn.actions)], action_value - PREFERRED, **CLOSE)
    torch.testing.assert_close(chosen, subgoal_value, **CLOSE)
    assert not torch.allclose(there, action_value), "the actions of a changed world are others"


def test_of_actions_that_a_symmetric_view_makes_equal_the_first_is_taken():
    observation, action, init, mask = torch.zeros(STEPS, 64, 3, 3, dtype=torch.uint8), *sequence(64)[1:]
    init[:] = True
    action_value, _ = mean_along(TURNS, make_network(), observation, action, init, mask)
    assert (action_value.argmax(-1) == 0).all()


def test_an_agent_carries_the_memory_of_each_world_and_learns_from_one():
    env = small_env(4)
    agent = build("v3", env, settings=tiny_settings(sampling="episode_starts", slice_len=7), symmetries=True)
    (batch,) = collect(agent, env, steps=32)
    assert batch["memory_hidden"].shape == (4, 32, 8 * 8)
    agent.observe(batch)
    assert agent.learners["joint"].learn()
    assert not any("symmetric_mean" in name for name in agent.policy.state_dict()), "weights fit any agent of its size"


def test_subgoals_that_may_be_of_places_go_with_no_symmetry():
    with pytest.raises(ValueError, match=r"^symmetries must be False with subgoals='discovered'"):
        make_v3(small_env(2), compact_network(), symmetries=True, subgoals="discovered")
