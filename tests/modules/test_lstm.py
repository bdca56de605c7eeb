import math
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from hdrqn_torchrl.devices import multiplies_bfloat16
from hdrqn_torchrl.modules import lstm as lstm_module
from hdrqn_torchrl.modules.lstm import Gaps, remember_for, restarting_lstm


def with_gaps(lstm, inputs, init, state):
    """The same outputs by way of ``Gaps``."""
    gaps = Gaps(init)
    return gaps.remove(gaps.lstm(lstm, [gaps.insert(inputs)], state))


both_ways = pytest.mark.parametrize("unroll", [restarting_lstm, with_gaps])


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


@both_ways
@pytest.mark.parametrize(
    ("batch", "time", "restart_rate"), [(3, 6, 0.3), (1, 6, 0.3), (4, 1, 0.5), (1, 1, 0.0), (3, 5, 0.0), (2, 5, 1.0)]
)
def test_outputs_and_all_gradients_equal_a_loop_over_cells(batch, time, restart_rate, unroll):
    lstm, inputs, init, state = make_case(batch, time, restart_rate)
    outputs, expected = unroll(lstm, inputs, init, state), cell_loop(lstm, inputs, init, state)
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


@both_ways
def test_frozen_inputs_and_weights_need_no_gradient(unroll):
    lstm, inputs, init, state = make_case(2, 4, 0.3)
    lstm.requires_grad_(False)
    outputs = unroll(lstm, inputs.detach(), init, tuple(part.detach() for part in state))
    assert not outputs.requires_grad
    lstm.requires_grad_(True)
    outputs = unroll(lstm, inputs.detach(), init, tuple(part.detach() for part in state))
    outputs.sum().backward()
    assert lstm.weight_hh_l0.grad.abs().sum() > 0


@both_ways
def test_a_restart_resets_the_state_of_its_own_sequence_only(unroll):
    lstm, inputs, _, (hidden, cell) = make_case(2, 3, 0.0)
    init = torch.tensor([[True, False, False], [False, False, False]])
    outputs = unroll(lstm, inputs, init, (hidden, cell))
    moved = unroll(lstm, inputs, init, (hidden + 1.0, cell))
    assert (outputs[0] == moved[0]).all() and (outputs[1] != moved[1]).any()


class TestGaps:
    init = torch.tensor([[True, False, True, True], [False, False, False, False], [False, True, False, False]])

    def test_there_is_one_gap_before_each_restart_except_at_the_first_step(self):
        """Two gaps in the first row, none in the second, one in the third; all rows are then equally long."""
        gaps, numbers = Gaps(self.init), torch.arange(12).view(3, 4)
        rows = gaps.insert(numbers).view(6, 3)
        is_gap = gaps._is_gap.view(6, 3)
        assert is_gap.t().tolist() == [
            [False, False, True, False, True, False],
            [False, False, False, False, True, True],
            [False, True, False, False, False, True],
        ]
        assert [column[~gap].tolist() for column, gap in zip(rows.t(), is_gap.t(), strict=True)] == numbers.tolist()
        assert (gaps.remove(gaps.insert(numbers)) == numbers).all()

    @pytest.mark.parametrize("kind", [torch.float32, torch.float64, torch.bfloat16])
    def test_the_state_is_exactly_zero_after_a_gap(self, kind):
        """Outputs do not depend on steps before a restart, however large, and no gradient reaches them."""
        torch.manual_seed(0)
        lstm, inputs = nn.LSTM(3, 4).to(kind), torch.randn(3, 4, 3, dtype=kind)
        state = tuple(torch.full((3, 4), 50.0, dtype=kind) for _ in range(2))
        other = inputs.clone()
        other[0, 1] += 5.0
        inputs.requires_grad_()
        outputs, moved = with_gaps(lstm, inputs, self.init, state), with_gaps(lstm, other, self.init, state)
        assert (outputs[0, 2:] == moved[0, 2:]).all() and (outputs[0, 1] != moved[0, 1]).any()
        (gradient,) = torch.autograd.grad(outputs[0, 2:].sum(), inputs)
        assert (gradient[0, :2] == 0).all() and (gradient[0, 2:] != 0).all() and (gradient[1:] == 0).all()

    def test_parts_of_the_input_are_concatenated(self):
        lstm, inputs, init, state = make_case(3, 6, 0.3)
        gaps = Gaps(init)
        parts = gaps.insert(inputs[..., :2]), gaps.insert(inputs[..., 2:])
        found = gaps.lstm(lstm, list(parts), state)
        assert (found == gaps.lstm(lstm, [gaps.insert(inputs)], state)).all()

    def test_outputs_are_the_same_without_gradients(self):
        lstm, inputs, init, state = make_case(3, 6, 0.3)
        with torch.no_grad():
            outputs = with_gaps(lstm, inputs, init, state)
        torch.testing.assert_close(outputs, with_gaps(lstm, inputs, init, state).detach())


class TestAutocast:
    """Under autocast, outputs and gradients of both implementations equal those in float32 up to rounding."""

    @pytest.mark.parametrize("on_gpu", [False, True])
    def test_outputs_and_gradients_are_close_to_those_in_float32(self, on_gpu, monkeypatch):
        lstm, inputs, init, state = make_case(4, 30, 0.1)
        lstm, inputs, state = lstm.float(), inputs.float().detach(), [part.float().detach() for part in state]
        leaves = [inputs.requires_grad_(), *(part.requires_grad_() for part in state), *lstm.parameters()]
        expected = restarting_lstm(lstm, inputs, init, tuple(state))
        monkeypatch.setattr(lstm_module, "on_host", lambda tensor: not on_gpu)
        with torch.autocast("cpu", torch.bfloat16):
            outputs = restarting_lstm(lstm, inputs, init, tuple(state))
        assert outputs.dtype == (torch.float32 if on_gpu else torch.bfloat16)
        assert (outputs != expected).any()
        assert relative_error(outputs, expected) < 0.01
        weights = torch.randn_like(expected)
        wanted = torch.autograd.grad((expected * weights).sum(), leaves)
        for gradient, want in zip(torch.autograd.grad((outputs.float() * weights).sum(), leaves), wanted, strict=True):
            assert gradient.dtype == torch.float32 and relative_error(gradient, want) < 0.02

    @pytest.mark.parametrize("on_gpu", [False, True])
    def test_the_cell_keeps_its_precision_under_autocast(self, on_gpu, monkeypatch):
        """0.001 is added to a cell at each of 200 steps; in bfloat16 the sum would stop growing."""
        if not on_gpu and not multiplies_bfloat16("cpu"):
            pytest.skip("without bfloat16 in hardware the cell is lowered, too")
        monkeypatch.setattr(lstm_module, "on_host", lambda tensor: not on_gpu)
        lstm = nn.LSTM(1, 1, batch_first=True).requires_grad_(False)
        lstm.weight_ih_l0.zero_(), lstm.weight_hh_l0.zero_(), lstm.bias_hh_l0.zero_()
        lstm.bias_ih_l0.copy_(torch.tensor([50.0, 50.0, 0.001, 50.0]))  # writes 0.001, forgets nothing, shows all
        init, start = torch.zeros(1, 200, dtype=torch.bool), (torch.zeros(1, 1), torch.ones(1, 1))
        with torch.autocast("cpu", torch.bfloat16):
            outputs = restarting_lstm(lstm, torch.zeros(1, 200, 1), init, start)
        assert outputs[0, -1].item() == pytest.approx(math.tanh(1.2), abs=2e-3)  # tanh(1) is 0.07 less


def relative_error(found, expected):
    return ((found.float() - expected).norm() / expected.norm()).item()


class TestMemorySpan:
    @staticmethod
    def left_after(lstm, steps):
        """The share of a cell's gradient that is left after so many steps without inputs."""
        zero = torch.zeros(1, lstm.hidden_size)
        cell = torch.full_like(zero, 0.1).requires_grad_()
        hidden, last = zero, cell
        for _ in range(steps):
            hidden, last = torch.lstm_cell(torch.zeros(1, 3), (hidden, last), *lstm_module.lstm_weights(lstm))
        return torch.autograd.grad(last.sum(), cell)[0].abs().mean()

    def test_new_cells_keep_things_for_about_so_many_steps(self):
        torch.manual_seed(0)
        lstm = nn.LSTM(3, 64, batch_first=True)
        assert self.left_after(lstm, 20) < 1e-4
        remember_for(lstm, 40)
        assert self.left_after(lstm, 20) > 0.1 and self.left_after(lstm, 400) < 0.01

    def test_forget_gates_are_open_for_1_to_span_steps_and_writing_gates_are_the_opposite(self):
        lstm = nn.LSTM(3, 1000, batch_first=True)
        others = {name: value.clone() for name, value in lstm.state_dict().items()}
        remember_for(lstm, 50)
        write, forget, *rest = (lstm.bias_ih_l0 + lstm.bias_hh_l0).chunk(4)
        assert torch.equal(write, -forget)
        spans = forget.exp()
        assert 1 <= spans.min() < 2 and 48 < spans.max() <= 49 and abs(spans.mean() - 25) < 1.5
        assert torch.equal(torch.cat(rest), (others["bias_ih_l0"] + others["bias_hh_l0"])[2000:])
        assert torch.equal(lstm.weight_hh_l0, others["weight_hh_l0"])

    def test_0_changes_nothing_and_draws_no_random_number(self):
        lstm = nn.LSTM(3, 4, batch_first=True)
        before, random = [each.clone() for each in lstm.parameters()], torch.get_rng_state()
        remember_for(lstm, 0)
        assert all(torch.equal(*pair) for pair in zip(before, lstm.parameters(), strict=True))
        assert torch.equal(random, torch.get_rng_state())

    @pytest.mark.parametrize("span", [-1, 1, 2, 2.5, True])
    def test_a_span_that_can_not_be_is_refused(self, span):
        with pytest.raises(ValueError, match=r"memory_span must be .* got"):
            remember_for(nn.LSTM(3, 4), span)
