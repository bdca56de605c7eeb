"""Predicting the next observations from the memory: an auxiliary task that teaches the memory what to keep.

Q-learning tells a recurrent network little about what to remember, as a remembered place affects values only when it
is used. To predict the next observations, the memory must hold where the agent is and what surrounds it (Guo et al.,
2018; Gregor et al., 2019). There is theory for this as well: a memory that predicts observations and rewards is
sufficient for optimal control (approximate information states; Subramanian et al., 2022).
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from hdrqn_torchrl.modules.sizes import check_size


class Decoder(nn.Module):
    """Predicts an observation from a vector, and measures the error."""

    def error(self, vector: Tensor, observation: Tensor) -> Tensor:
        """Error ``[*]`` of the prediction from ``vector`` ``[*, D]``, given the true ``observation`` ``[*, ...]``."""
        raise NotImplementedError


class DecoderFactory(Protocol):
    """Makes a decoder for vectors of a given size."""

    def __call__(self, in_features: int) -> Decoder: ...


class CellDecoder(Decoder):
    """Predicts the code of every cell of a window; the error is the mean cross-entropy (nats per cell).

    Args:
        in_features: D.
        view: side of the window in cells.
        num_codes: number of cell codes.

    Examples:
        >>> decoder = CellDecoder(8, view=5, num_codes=5)
        >>> decoder.error(torch.zeros(2, 3, 8), torch.zeros(2, 3, 5, 5, dtype=torch.uint8)).shape
        torch.Size([2, 3])
    """

    def __init__(self, in_features: int, view: int, num_codes: int) -> None:
        super().__init__()
        for name, value, usual in (("in_features", in_features, 128), ("view", view, 5), ("num_codes", num_codes, 5)):
            check_size(name, value, usual)
        self.logits = nn.Linear(in_features, view * view * num_codes)
        self.num_codes = num_codes

    def error(self, vector: Tensor, observation: Tensor) -> Tensor:
        logits = self.logits(vector).unflatten(-1, (-1, self.num_codes)).float()
        cells = observation.flatten(-2).long()
        picked = logits.gather(-1, cells.unsqueeze(-1)).squeeze(-1)
        return (logits.logsumexp(-1) - picked).mean(-1)


class ImageDecoder(Decoder):
    """Predicts a coarse version of an image; the error is the mean squared error of intensities in [0, 1].

    Args:
        in_features: D.
        channels: number of channels of the image.
        size: side of the coarse image in pixels.

    Examples:
        >>> decoder = ImageDecoder(8, channels=3)
        >>> decoder.error(torch.zeros(2, 3, 8), torch.zeros(2, 3, 3, 44, 44, dtype=torch.uint8)).shape
        torch.Size([2, 3])
    """

    def __init__(self, in_features: int, channels: int, size: int = 14) -> None:
        super().__init__()
        for name, value, usual in (("in_features", in_features, 128), ("channels", channels, 3), ("size", size, 14)):
            check_size(name, value, usual)
        self.pixels = nn.Linear(in_features, channels * size * size)
        self.size = size

    def error(self, vector: Tensor, observation: Tensor) -> Tensor:
        images = observation.reshape(-1, *observation.shape[-3:]).float()
        coarse = functional.adaptive_avg_pool2d(images, self.size)
        if observation.dtype == torch.uint8:
            coarse /= 255
        guess = self.pixels(vector).float().flatten(0, -2)
        return (guess - coarse.flatten(1)).square().mean(-1).view(vector.shape[:-1])


class ObservationPredictor(nn.Module):
    """Predicts the observation after the next k actions from the memory, for 1 <= k <= ``max_steps``.

    Args:
        make_decoder: makes the decoder for the observation.
        hidden_size: H, size of the memory's output.
        num_actions: A.
        max_steps: largest k.
        width: number of units in the hidden layer.

    Raises:
        ValueError: if a value breaks its rule.

    Examples:
        >>> predictor = ObservationPredictor(lambda size: CellDecoder(size, 5, 5), hidden_size=8, num_actions=4)
        >>> memory, action = torch.zeros(2, 7, 8), torch.zeros(2, 7, dtype=torch.int64)
        >>> observation = torch.zeros(2, 7, 5, 5, dtype=torch.uint8)
        >>> predictor(memory, action, observation, steps=3).shape
        torch.Size([2, 4])
    """

    def __init__(
        self, make_decoder: DecoderFactory, *, hidden_size: int, num_actions: int, max_steps: int = 4, width: int = 128
    ) -> None:
        super().__init__()
        for name, value, usual in (
            ("max_steps", max_steps, 4),
            ("width", width, 128),
            ("hidden_size", hidden_size, 128),
        ):
            check_size(name, value, usual)
        check_size("num_actions", num_actions, "the number of the environment's actions")
        self.max_steps, self.num_actions = max_steps, num_actions
        self.memory = nn.Linear(hidden_size, width)
        self.actions = nn.Embedding(max_steps * num_actions, width)  # one for each action at each place in the sequence
        self.horizon = nn.Embedding(max_steps, width)
        self.decoder = make_decoder(width)

    def forward(self, memory: Tensor, action: Tensor, observation: Tensor, *, steps: int) -> Tensor:
        """Errors of all predictions k = ``steps`` ahead, along sequences.

        Args:
            memory: output of the LSTM after each step's observation, ``[B, T, H]``.
            action: ``[B, T]`` int64.
            observation: ``[B, T, ...]``.
            steps: k.

        Returns:
            ``[B, T - k]``: the error of the prediction made at step t of the observation at step t + k.
        """
        last = memory.shape[1] - steps
        place = torch.arange(steps, device=action.device) * self.num_actions
        taken = self.actions(action.unfold(1, steps, 1)[:, :last] + place).sum(-2)
        expected = torch.relu(self.memory(memory[:, :last]) + self.horizon.weight[steps - 1] + taken)
        return self.decoder.error(expected, observation[:, steps:])
