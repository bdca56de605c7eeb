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
) -> Tensor:
    """Mean error of the predictor some steps ahead; the number of steps is drawn at each call.

    Args:
        predictor: the predictor.
        memory: output of the LSTM ``[B, T + 1, H]``.
        action: ``[B, T]`` int64, or one more.
        observation: ``[B, T + 1, ...]``.
        valid: ``[B, T + 1]`` bool, ``False`` for padding, which only follows valid steps.
        cut: ``[B, T]`` bool; the next observation does not result from the step (another episode begins).

    Returns:
        Scalar; 0 if there was nothing to predict.
    """
    ahead = int(torch.randint(1, min(predictor.max_steps, cut.shape[1]) + 1, ()))  # on the host, which must know it
    error = predictor(memory, action, observation, steps=ahead)
    known = valid[:, ahead:] & ~cut.unfold(1, ahead, 1).any(-1)
    return error.masked_fill(~known, 0.0).sum() / known.sum().clamp(min=1)
