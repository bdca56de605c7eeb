import pytest
import torch
from helpers import unroll_by_steps

from hdrqn_torchrl.modules import DuelingHead, FullyConnectedFeatures, QNetwork


def make_network(**settings):
    torch.manual_seed(0)
    defaults = {"num_actions": 4, "hidden_size": 6}
    return QNetwork(FullyConnectedFeatures(5, (8,)), **(defaults | settings))


def test_dueling_adds_the_centred_advantage_to_the_value():
    head = DuelingHead(1, 3)
    with torch.no_grad():
        head.streams.weight.copy_(torch.tensor([[10.0], [1.0], [2.0], [6.0]]))
        head.streams.bias.zero_()
    assert head(torch.tensor([1.0])).tolist() == [8.0, 9.0, 13.0]  # 10 + advantage - 3


@pytest.mark.parametrize("recurrent", [True, False])
@pytest.mark.parametrize("num_conditions", [0, 3])
@pytest.mark.parametrize("restarts", [False, True])
@pytest.mark.parametrize("gated", [False, True])
def test_unroll_equals_a_loop_over_steps(recurrent, num_conditions, restarts, gated):
    network = make_network(recurrent=recurrent, num_conditions=num_conditions, gate_features=gated)
    observation = torch.randn(3, 7, 5)
    condition = torch.randint(num_conditions, (3, 7)) if num_conditions else None
    init = (torch.rand(3, 7) < 0.3) if restarts else None
    values = network.unroll(observation, condition, init)
    torch.testing.assert_close(values, unroll_by_steps(network, observation, condition, init))


@pytest.mark.parametrize("restarts", [[], [0], [3], [0, 2]], ids=str)
def test_unroll_continues_from_a_given_state(restarts):
    """A sequence cut in two equals the whole one; a restart discards the given state."""
    network = make_network()
    observation, init = torch.randn(3, 9, 5), torch.zeros(3, 9, dtype=torch.bool)
    state = network.initial_state(3)
    for t in range(4):
        _, state = network.step(observation[:, t], None, state)
    init[1, [4 + place for place in restarts]] = True
    whole = network.unroll(observation, None, init)
    for flags in (init[:, 4:], *([] if restarts else [None])):
        torch.testing.assert_close(network.unroll(observation[:, 4:], None, flags, state), whole[:, 4:])
    lost = network.unroll(observation[:, 4:], None, init[:, 4:])
    assert (lost[0] != whole[0, 4:]).any()
    assert torch.allclose(lost[1, 0], whole[1, 4]) == (0 in restarts)


def test_only_a_restart_makes_earlier_steps_irrelevant():
    network, observation = make_network(), torch.randn(1, 6, 5)
    changed = observation.clone()
    changed[:, 1] += 1.0
    init = torch.tensor([[False, False, False, True, False, False]])
    difference = (network.unroll(observation, None, init) - network.unroll(changed, None, init)).abs().sum(-1)[0]
    assert (difference > 0).tolist() == [False, True, True, False, False, False]
    difference = (network.unroll(observation) - network.unroll(changed)).abs().sum(-1)[0]
    assert (difference > 0).tolist() == [False, True, True, True, True, True]


def test_rows_of_a_batch_are_independent():
    network, observation = make_network(), torch.randn(3, 6, 5)
    changed = observation.clone()
    changed[0] += 1.0
    init = torch.zeros(3, 6, dtype=torch.bool)
    init[1, 3] = True
    for flags in (None, init):
        before, after = network.unroll(observation, None, flags), network.unroll(changed, None, flags)
        assert (before[0] != after[0]).any()
        assert (before[1:] == after[1:]).all()


def test_the_condition_changes_the_values():
    network, observation = make_network(num_conditions=2), torch.randn(1, 5)
    state = network.initial_state(1)
    first, second = (network.step(observation, torch.tensor([g]), state)[0] for g in (0, 1))
    assert (first != second).all()


def test_step_works_without_batch_dimension():
    network, observation = make_network(), torch.randn(5)
    value, (hidden, cell) = network.step(observation, None, network.initial_state())
    batched, (batched_hidden, batched_cell) = network.step(observation[None], None, network.initial_state(1))
    assert value.shape == (4,) and hidden.shape == cell.shape == (6,)
    for single, several in ((value, batched), (hidden, batched_hidden), (cell, batched_cell)):
        torch.testing.assert_close(single, several[0])


def test_without_recurrence_values_ignore_the_past():
    network, observation = make_network(recurrent=False), torch.randn(1, 4, 5)
    torch.testing.assert_close(network.unroll(observation)[:, 2:], network.unroll(observation[:, 2:]))


class TestGatedFeatures:
    def test_each_condition_scales_each_feature(self):
        network = make_network(num_conditions=2, gate_features=True)
        with torch.no_grad():
            network.gate.weight.copy_(torch.stack([torch.ones(8), torch.arange(8.0)]))
        observation, plain = torch.randn(3, 5), make_network(num_conditions=2)
        plain.load_state_dict(network.state_dict(), strict=False)
        state = network.initial_state(3)

        def scaled(condition, factors):
            inputs = torch.cat([network.features(observation) * factors, torch.eye(2)[condition]], -1)
            return network.head(torch.lstm_cell(inputs, state, *network.memory.parameters())[0])

        for condition, factors in (
            (torch.tensor([0, 0, 0]), torch.ones(8)),
            (torch.tensor([1, 1, 1]), torch.arange(8.0)),
        ):
            value, _ = network.step(observation, condition, state)
            torch.testing.assert_close(value, scaled(condition, factors))
        torch.testing.assert_close(
            network.step(observation, torch.tensor([0, 0, 0]), state)[0],
            plain.step(observation, torch.tensor([0, 0, 0]), state)[0],
        )

    def test_gate_factors_are_learned_and_absent_without_a_condition(self):
        network = make_network(num_conditions=2, gate_features=True)
        network.unroll(torch.randn(1, 2, 5), torch.tensor([[0, 0]])).sum().backward()
        assert network.gate.weight.grad[0].any() and not network.gate.weight.grad[1].any()
        assert make_network(gate_features=True).gate is None


def test_the_initial_state_is_zero():
    hidden, cell = make_network().initial_state(2, 3)
    assert hidden.shape == cell.shape == (2, 3, 6) and not hidden.any() and not cell.any()
    hidden.add_(1.0)
    assert not cell.any()


@pytest.mark.parametrize(("sizes", "name"), [((0, 4), "in_features"), ((8, -1), "num_actions")])
def test_a_head_without_inputs_or_actions_is_refused(sizes, name):
    with pytest.raises(ValueError, match=f"{name} must be >= 1"):
        DuelingHead(*sizes)


def test_a_wrong_hidden_size_is_refused():
    with pytest.raises(ValueError, match="hidden_size must be >= 1, got 0; "):
        make_network(hidden_size=0)
