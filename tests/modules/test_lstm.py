from types import SimpleNamespace

import pytest
import torch
from torch import nn

from hdrqn_torchrl.modules.lstm import restarting_lstm


def make_case(batch, time, restart_rate):
    torch.manual_seed(batch * 100 + time)
    lstm = nn.LSTM(3, 4, batch_first=True).double()
    inputs = torch.randn(batch, time, 3, dtype=torch.double, requires_grad=True)
    init = torch.rand(batch, time) < restart_rate
    state = tuple(torch.randn(batch, 4, dtype=torch.double, requires_grad=True) for _ in range(2))
    return lstm, inputs, init, state


def cell_loop(lstm, inputs, init, state):
    """The same with ``nn.LSTMCell``, one row and one step at a time."""
    cell = nn.LSTMCell(3, 4).double()
    for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
        delattr(cell, name)
        setattr(cell, name, getattr(lstm, f"{name}_l0"))
    rows = []
    for b in range(len(inputs)):
        hidden, memory = state[0][b : b + 1], state[1][b : b + 1]
        outputs = []
        for t in range(inputs.shape[1]):
            if init[b, t]:
                hidden, memory = torch.zeros_like(hidden), torch.zeros_like(memory)
            hidden, memory = cell(inputs[b : b + 1, t], (hidden, memory))
            outputs.append(hidden[0])
        rows.append(torch.stack(outputs))
    return torch.stack(rows)


@pytest.mark.parametrize(
    ("batch", "time", "restart_rate"), [(3, 6, 0.3), (1, 6, 0.3), (4, 1, 0.5), (1, 1, 0.0), (3, 5, 0.0), (2, 5, 1.0)]
)
def test_outputs_and_all_gradients_equal_a_loop_over_cells(batch, time, restart_rate):
    lstm, inputs, init, state = make_case(batch, time, restart_rate)
    outputs, expected = restarting_lstm(lstm, inputs, init, state), cell_loop(lstm, inputs, init, state)
    torch.testing.assert_close(outputs, expected)
    weights = torch.randn_like(outputs)
    leaves = [inputs, *state, *lstm.parameters()]
    gradients = torch.autograd.grad((outputs * weights).sum(), leaves)
    wanted = torch.autograd.grad((expected * weights).sum(), leaves, allow_unused=True)
    for gradient, want in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(gradient, torch.zeros_like(gradient) if want is None else want)


def test_gradients_equal_finite_differences():
    lstm, inputs, init, state = make_case(2, 4, 0.3)
    init[0, 2] = True

    def run(inputs, hidden, cell, *weights):
        names = (name for name, _ in lstm.named_parameters())
        return restarting_lstm(SimpleNamespace(**dict(zip(names, weights, strict=True))), inputs, init, (hidden, cell))

    assert torch.autograd.gradcheck(run, (inputs, *state, *lstm.parameters()))


def test_frozen_inputs_and_weights_need_no_gradient():
    lstm, inputs, init, state = make_case(2, 4, 0.3)
    lstm.requires_grad_(False)
    outputs = restarting_lstm(lstm, inputs.detach(), init, tuple(part.detach() for part in state))
    assert not outputs.requires_grad
    lstm.requires_grad_(True)
    outputs = restarting_lstm(lstm, inputs.detach(), init, tuple(part.detach() for part in state))
    outputs.sum().backward()
    assert lstm.weight_hh_l0.grad.abs().sum() > 0


def test_the_state_before_a_restart_is_forgotten_and_others_keep_theirs():
    lstm, inputs, _, (hidden, cell) = make_case(2, 3, 0.0)
    init = torch.tensor([[True, False, False], [False, False, False]])
    outputs = restarting_lstm(lstm, inputs, init, (hidden, cell))
    moved = restarting_lstm(lstm, inputs, init, (hidden + 1.0, cell))
    assert (outputs[0] == moved[0]).all() and (outputs[1] != moved[1]).any()
