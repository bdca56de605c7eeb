"""An LSTM over sequences whose state can restart in the middle.

``nn.LSTM`` cannot restart its state in mid-sequence. A loop over ``LSTMCell`` can, but it pays for autograd at every
step and computes each weight gradient T times. This module has two alternatives, both with the parameters and the gate
order of ``nn.LSTM``:

- :func:`restarting_lstm` is a loop with its own backward pass: one matrix product for the inputs of all steps, one for
  each weight gradient, and only the truly sequential part step by step.
- :class:`Gaps` inserts an empty step before each restart, which sets the state to zero; the library's own kernels then
  process whole sequences. On a CPU this is faster for long sequences, and under autocast for all. The number of steps
  depends on the data, so the host has to read it, which would stall a GPU.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from hdrqn_torchrl.devices import autocast_dtype, multiplies_bfloat16, on_host
from hdrqn_torchrl.modules.sizes import check_memory_span

CLOSED = -1e4
"""Gate input at a gap; its sigmoid is zero in every floating-point format."""


class _RestartingLSTM(torch.autograd.Function):
    """The loop. ``inputs`` and both weights may have a lower precision, which is used for matrix products only."""

    @staticmethod
    def forward(ctx, inputs, keep, hidden, cell, weight_ih, weight_hh, bias):  # noqa: ANN001, ANN205
        time, size, low = len(inputs), hidden.shape[-1], weight_hh.dtype
        mixed = low != hidden.dtype
        if mixed:
            gates = (inputs.flatten(0, 1) @ weight_ih.t() + bias).unflatten(0, (time, -1))
        else:
            gates = torch.addmm(bias, inputs.flatten(0, 1), weight_ih.t()).unflatten(0, (time, -1))  # [T, B, 4H]
        write_and_forget = gates[..., : 2 * size]
        write, forget, update, read = gates.chunk(4, -1)  # views, filled step by step
        hiddens, cells, squashed, outputs = gates.new_empty((4, time, *hidden.shape)).unbind()
        weight_hh_t = weight_hh.t()
        for step in range(time):
            torch.mul(hidden, keep[step], out=hiddens[step])
            torch.mul(cell, keep[step], out=cells[step])
            if mixed:
                gates[step] += hiddens[step].to(low) @ weight_hh_t
            else:
                gates[step].addmm_(hiddens[step], weight_hh_t)
            write_and_forget[step].sigmoid_()
            update[step].tanh_()
            read[step].sigmoid_()
            cell = torch.addcmul(forget[step] * cells[step], write[step], update[step])
            torch.tanh(cell, out=squashed[step])
            hidden = torch.mul(read[step], squashed[step], out=outputs[step])
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(inputs, keep, weight_ih, weight_hh, gates, hiddens, cells, squashed)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):  # noqa: ANN001, ANN205
        inputs, keep, weight_ih, weight_hh, gates, hiddens, cells, squashed = ctx.saved_tensors
        low = weight_hh.dtype
        write, forget, update, read = gates.chunk(4, -1)
        # Derivatives of the cell (first three gates) and of the output (last gate) by the gates' inputs, for all steps
        # at once. The loop below multiplies them in place by the gradients of cell and output: the gates' gradients.
        grad_gates = gates - gates * gates
        of_write, of_forget, of_update, of_read = grad_gates.chunk(4, -1)
        of_write *= update
        of_forget *= cells
        of_update.copy_(write).addcmul_(write, update * update, value=-1)
        of_read *= squashed
        by_cell = grad_gates.unflatten(-1, (4, -1))[..., :3, :]
        output_by_cell = torch.addcmul(read, read, squashed * squashed, value=-1)
        cell_by_cell = forget * keep

        grad_hidden = grad_cell = torch.zeros_like(grad[0])
        for step in reversed(range(len(inputs))):
            grad_hidden = grad_hidden + grad[step]
            grad_cell = torch.addcmul(grad_cell, grad_hidden, output_by_cell[step])
            by_cell[step] *= grad_cell.unsqueeze(1)
            of_read[step] *= grad_hidden
            grad_hidden = (grad_gates[step].to(low) @ weight_hh).to(grad.dtype).mul_(keep[step])
            grad_cell = grad_cell * cell_by_cell[step]
        flat = grad_gates.flatten(0, 1)
        grad_bias, flat = flat.sum(0), flat.to(low)
        grad_inputs = (flat @ weight_ih).view_as(inputs) if ctx.needs_input_grad[0] else None
        grad_weight_ih = flat.t() @ inputs.flatten(0, 1)
        grad_weight_hh = flat.t() @ hiddens.flatten(0, 1).to(low)
        return grad_inputs, None, grad_hidden, grad_cell, grad_weight_ih, grad_weight_hh, grad_bias


def lstm_weights(lstm: nn.LSTM) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weights (input to gates, hidden to gates) and biases of the first layer, in the order that kernels take them."""
    weight_ih, weight_hh, bias_ih, bias_hh = (
        getattr(lstm, name) for name in ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0")
    )
    return weight_ih, weight_hh, bias_ih, bias_hh


def remember_for(lstm: nn.LSTM, steps: int) -> None:
    """Sets the gates' biases so that a new ``lstm`` remembers for up to so many steps (Tallec and Ollivier, 2018).

    PyTorch draws biases around zero: forget gates are half open, and of what a cell holds and of its gradient a
    millionth is left after 20 steps. Here the biases of forget gates are log(u) with u uniform between 1 and steps - 1,
    so cells forget within u + 1 steps, and those of the gates that write are the opposite.

    Args:
        lstm: of one layer; changed in place.
        steps: the longest time between what has to be remembered and its use; 0 changes nothing.

    Raises:
        ValueError: if ``steps`` is not 0 and less than 3.

    Examples:
        >>> lstm = nn.LSTM(3, 2, batch_first=True)
        >>> remember_for(lstm, 50)
        >>> bool((lstm_weights(lstm)[2][2:4].sigmoid() >= 0.5).all())
        True
    """
    check_memory_span(steps)
    if steps == 0:
        return
    _, _, bias_ih, bias_hh = lstm_weights(lstm)
    size = lstm.hidden_size
    with torch.no_grad():
        kept = torch.empty(size).uniform_(1, steps - 1).log_()
        bias_hh[: 2 * size] = 0.0
        bias_ih[:size], bias_ih[size : 2 * size] = -kept, kept


def restarting_lstm(lstm: nn.LSTM, inputs: Tensor, init: Tensor, state: tuple[Tensor, Tensor]) -> Tensor:
    """Outputs of a one-layer ``lstm`` (``batch_first``) whose state restarts from zero where ``init`` is set.

    Under autocast, matrix products have the lower precision, and a CPU uses :class:`Gaps`.

    Args:
        lstm: the layer whose parameters are used.
        inputs: ``[B, T, I]``.
        init: ``[B, T]`` bool; the state restarts before these steps.
        state: hidden and cell state before the first step, ``[B, H]`` each.

    Returns:
        ``[B, T, H]``.

    Examples:
        >>> lstm, inputs = nn.LSTM(3, 4, batch_first=True), torch.randn(2, 5, 3)
        >>> zero = torch.zeros(2, 4)
        >>> outputs = restarting_lstm(lstm, inputs, torch.zeros(2, 5, dtype=torch.bool), (zero, zero))
        >>> torch.allclose(outputs, lstm(inputs)[0], atol=1e-6)
        True
    """
    low = autocast_dtype(inputs)
    if low is not None and on_host(init):
        gaps = Gaps(init)
        return gaps.remove(gaps.lstm(lstm, [gaps.insert(inputs)], state))
    weight_ih, weight_hh, bias_ih, bias_hh = lstm_weights(lstm)
    keep = (~init).to(bias_ih.dtype).t().unsqueeze(-1)  # [T, B, 1]
    by_time = inputs.transpose(0, 1).contiguous()
    if low is not None:
        by_time, weight_ih, weight_hh = by_time.to(low), weight_ih.to(low), weight_hh.to(low)
    return _RestartingLSTM.apply(by_time, keep, *state, weight_ih, weight_hh, bias_ih + bias_hh).transpose(0, 1)


class Gaps:
    """Empty steps inserted before the restarts of sequences, after which an LSTM's state is zero.

    A gap sets an additional input that closes the input, forget and output gates. Cell and output are then exactly
    zero, and no gradient passes.

    Args:
        init: ``[B, T]`` bool; the state restarts before these steps. The host reads it (and waits for a GPU).

    Examples:
        >>> inputs, init = torch.randn(2, 3, 5), torch.tensor([[True, False, True], [False, False, False]])
        >>> lstm, zero, gaps = nn.LSTM(5, 4, batch_first=True), torch.zeros(2, 4), Gaps(init)
        >>> gaps.insert(inputs).shape
        torch.Size([8, 5])
        >>> outputs = gaps.remove(gaps.lstm(lstm, [gaps.insert(inputs)], (zero, zero)))
        >>> torch.allclose(outputs, restarting_lstm(lstm, inputs, init, (zero, zero)), atol=1e-6)
        True
    """

    def __init__(self, init: Tensor) -> None:
        batch, time = init.shape
        restarts = init.cumsum(1)
        before = restarts - restarts[:, :1]  # gaps before each step; a restart at the first step needs none
        self._keep = ~init[:, :1]
        self._shape, self._gapped = (batch, time), (time + int(before[:, -1].max()), batch)
        steps, rows = torch.arange(time, device=init.device), torch.arange(batch, device=init.device)
        self._place = ((steps + before) * batch + rows.unsqueeze(1)).flatten()  # of each step in [L, B]
        self._step = init.new_zeros(self._gapped, dtype=torch.int64).flatten()  # at each place, out of [B, T]
        self._step[self._place] = torch.arange(batch * time, device=init.device)
        self._is_gap = torch.ones_like(self._step, dtype=torch.bool)
        self._is_gap[self._place] = False

    def insert(self, steps: Tensor) -> Tensor:
        """``[B, T, *]`` -> ``[L * B, *]``, time first. The gaps hold a copy of an arbitrary step."""
        return steps.flatten(0, 1).index_select(0, self._step)  # of images a tenth of the time of indexing

    def remove(self, steps: Tensor) -> Tensor:
        """``[L * B, *]`` -> ``[B, T, *]``."""
        return steps[self._place].unflatten(0, self._shape)

    def lstm(self, lstm: nn.LSTM, parts: list[Tensor], state: tuple[Tensor, Tensor]) -> Tensor:
        """Outputs of a one-layer ``lstm``.

        Args:
            lstm: the layer whose parameters are used.
            parts: its inputs, to be concatenated, ``[L * B, *]`` each.
            state: hidden and cell state before the first step, ``[B, H]`` each.

        Returns:
            ``[L * B, H]``.
        """
        weight_ih, weight_hh, bias_ih, bias_hh = lstm_weights(lstm)
        padding = -(weight_ih.shape[1] + 1) % 8  # oneDNN in bfloat16 is half as fast at other widths
        closing = weight_ih.new_zeros((4, lstm.hidden_size, 1 + padding))
        closing[:2, :, 0] = closing[3, :, 0] = CLOSED
        low = autocast_dtype(weight_ih)
        flag = weight_ih.new_zeros((len(self._is_gap), 1 + padding), dtype=low)
        flag[:, 0] = self._is_gap
        inputs = torch.cat([*(part.to(flag.dtype) for part in parts), flag], -1).unflatten(0, self._gapped)
        weights = [torch.cat([weight_ih, closing.flatten(0, 1)], 1), weight_hh, bias_ih, bias_hh]
        hidden, cell = ((part * self._keep).unsqueeze(0) for part in state)
        # has_biases, num_layers, dropout, train, bidirectional, batch_first
        settings = True, 1, 0.0, torch.is_grad_enabled(), False, False
        if low is None:
            return torch.lstm(inputs, (hidden, cell), weights, *settings)[0].flatten(0, 1)
        # Autocast would also lower the precision of the cell, which would lose small increments.
        with torch.autocast(inputs.device.type, enabled=False):
            weights = [weight.to(low) for weight in weights]
            start = hidden.to(low), cell if multiplies_bfloat16(inputs.device.type) else cell.to(low)
            return torch.lstm(inputs, start, weights, *settings)[0].flatten(0, 1)
