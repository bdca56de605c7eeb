"""An LSTM over sequences whose state restarts inside them.

``nn.LSTM`` cannot restart its state in mid-sequence; a loop over ``LSTMCell`` can, but pays for autograd at
every step and multiplies out each weight gradient T times. Here one matrix product serves the inputs of all
steps, and one each weight gradient; only what is truly sequential is done step by step. The gate order and
the parameters are those of ``nn.LSTM``.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

_aten = torch.ops.aten


class _RestartingLSTM(torch.autograd.Function):
    @staticmethod
    def forward(ctx, inputs, keep, hidden, cell, weight_ih, weight_hh, bias):  # noqa: ANN001, ANN205
        time, size = len(inputs), hidden.shape[-1]
        gates = torch.addmm(bias, inputs.flatten(0, 1), weight_ih.t()).unflatten(0, (time, -1))  # [T, B, 4H]
        weight_hh_t = weight_hh.t()
        hiddens, before, cells, squashed = [], [], [], []
        for step in range(time):
            hidden, cell = hidden * keep[step], cell * keep[step]
            before.append(hidden)
            cells.append(cell)
            gate = gates[step].addmm_(hidden, weight_hh_t)
            gate[:, : 2 * size].sigmoid_()
            gate[:, 2 * size : 3 * size].tanh_()
            gate[:, 3 * size :].sigmoid_()
            write, forget, update, read = gate.chunk(4, -1)
            cell = torch.addcmul(forget * cell, write, update)
            squash = cell.tanh()
            hidden = read * squash
            squashed.append(squash)
            hiddens.append(hidden)
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(inputs, keep, weight_ih, weight_hh, gates, *before, *cells, *squashed)
        return torch.stack(hiddens)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):  # noqa: ANN001, ANN205
        inputs, keep, weight_ih, weight_hh, gates, *saved = ctx.saved_tensors
        time = len(inputs)
        before, cells, squashed = saved[:time], saved[time : 2 * time], saved[2 * time :]
        grad_gates = torch.empty_like(gates)
        grad_hidden = grad_cell = torch.zeros_like(grad[0])
        for step in reversed(range(time)):
            write, forget, update, read = gates[step].chunk(4, -1)
            to_write, to_forget, to_update, to_read = grad_gates[step].chunk(4, -1)
            total = grad[step] + grad_hidden
            through_cell = grad_cell + _aten.tanh_backward(total * read, squashed[step])
            _aten.sigmoid_backward.grad_input(through_cell * update, write, grad_input=to_write)
            _aten.sigmoid_backward.grad_input(through_cell * cells[step], forget, grad_input=to_forget)
            _aten.tanh_backward.grad_input(through_cell * write, update, grad_input=to_update)
            _aten.sigmoid_backward.grad_input(total * squashed[step], read, grad_input=to_read)
            grad_hidden = (grad_gates[step] @ weight_hh) * keep[step]
            grad_cell = through_cell * forget * keep[step]
        flat = grad_gates.flatten(0, 1)
        grad_inputs = (flat @ weight_ih).view_as(inputs) if ctx.needs_input_grad[0] else None
        grad_weight_ih = flat.t() @ inputs.flatten(0, 1)
        grad_weight_hh = flat.t() @ torch.cat(before)
        return grad_inputs, None, grad_hidden, grad_cell, grad_weight_ih, grad_weight_hh, flat.sum(0)


def lstm_weights(lstm: nn.LSTM) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weights and biases of the first layer: input to gates, hidden to gates."""
    weight_ih, weight_hh, bias_ih, bias_hh = (
        getattr(lstm, name) for name in ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0")
    )
    return weight_ih, weight_hh, bias_ih, bias_hh


def restarting_lstm(lstm: nn.LSTM, inputs: Tensor, init: Tensor, state: tuple[Tensor, Tensor]) -> Tensor:
    """Outputs of a one-layer ``lstm`` (``batch_first``) whose state restarts from zero where ``init`` is set.

    Args:
        lstm: its parameters are used.
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
    keep = (~init).to(inputs.dtype).t().unsqueeze(-1)  # [T, B, 1]
    weight_ih, weight_hh, bias_ih, bias_hh = lstm_weights(lstm)
    by_time = inputs.transpose(0, 1).contiguous()
    return _RestartingLSTM.apply(by_time, keep, *state, weight_ih, weight_hh, bias_ih + bias_hh).transpose(0, 1)
