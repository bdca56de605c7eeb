"""The error of a memory's predictions along sequences."""

from __future__ import annotations

import torch
from torch import Tensor

from hdrqn_torchrl.modules import ObservationPredictor


def prediction_loss(
    predictor: ObservationPredictor,
    memory: Tensor,
    action: Tensor,
    observation: Tensor,
    *,
    valid: Tensor,
    cut: Tensor,
    ahead: int | None = None,
) -> Tensor:
    """Mean error of the predictor some steps ahead.

    Args:
        predictor: the predictor.
        memory: output of the LSTM ``[B, T + 1, H]``.
        action: ``[B, T]`` int64, or one more.
        observation: ``[B, T + 1, ...]``.
        valid: ``[B, T + 1]`` bool, ``False`` for padding, which only follows valid steps.
        cut: ``[B, T]`` bool; the next observation does not result from the step (another episode begins).
        ahead: number of steps; ``None``: :func:`draw_ahead`.

    Returns:
        Scalar; 0 if there was nothing to predict.
    """
    ahead = draw_ahead(predictor, cut.shape[1]) if ahead is None else ahead
    error = predictor(memory, action, observation, steps=ahead)
    known = valid[:, ahead:] & ~cut.unfold(1, ahead, 1).any(-1)
    return error.masked_fill(~known, 0.0).sum() / known.sum().clamp(min=1)


def draw_ahead(predictor: ObservationPredictor, steps: int) -> int:
    """How many steps ahead to predict, of those that the predictor and sequences of ``steps`` steps allow.

    It is drawn on the host, which must know it: shapes depend on it.
    """
    return int(torch.randint(1, min(predictor.max_steps, steps) + 1, ()))
