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


class _RestartingLSTM(torch.autograd.Function):
    @staticmethod
    def forward(ctx, inputs, keep, hidden, cell, weight_ih, weight_hh, bias):  # noqa: ANN001, ANN205
        time, size = len(inputs), hidden.shape[-1]
        gates = torch.addmm(bias, inputs.flatten(0, 1), weight_ih.t()).unflatten(0, (time, -1))  # [T, B, 4H]
        write_and_forget = gates[..., : 2 * size]
        write, forget, update, read = gates.chunk(4, -1)  # views, filled step by step
        hiddens, cells, squashed, outputs = gates.new_empty((4, time, *hidden.shape)).unbind()
        weight_hh_t = weight_hh.t()
        for step in range(time):
            torch.mul(hidden, keep[step], out=hiddens[step])
            torch.mul(cell, keep[step], out=cells[step])
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
        write, forget, update, read = gates.chunk(4, -1)
        # How the cell (first three gates) and the output (last gate) answer to each gate's input, for all steps at
        # once; multiplied in place by their gradients below, this becomes the gradient of the gates.
        grad_gates = gates - gates * gates
        of_write, of_forget, of_update, of_read = grad_gates.chunk(4, -1)
        of_write *= update
        of_forget *= cells
        torch.addcmul(write, write, update * update, value=-1, out=of_update)
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
            grad_hidden = (grad_gates[step] @ weight_hh).mul_(keep[step])
            grad_cell = grad_cell * cell_by_cell[step]
        flat = grad_gates.flatten(0, 1)
        grad_inputs = (flat @ weight_ih).view_as(inputs) if ctx.needs_input_grad[0] else None
        grad_weight_ih = flat.t() @ inputs.flatten(0, 1)
        grad_weight_hh = flat.t() @ hiddens.flatten(0, 1)
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
