"""Epsilon-greedy choice with a schedule of its own (Algorithm 2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type


class EpsilonGreedy(nn.Module):
    """Chooses the best action, or with probability epsilon a uniformly random one.

    Epsilon falls linearly with the frames seen. It is a buffer, so it travels with the policy's weights to
    worker processes and into checkpoints. Under ``ExplorationType.RANDOM`` (the collectors' default) it
    explores, under any other type it is greedy. TorchRL's ``EGreedyModule`` counts its schedule in a Python
    loop over frames and knows no gated choice, hence this module.

    Args:
        start: epsilon at frame 0.
        end: epsilon from ``anneal_frames`` on.
        anneal_frames: length of the schedule in environment frames.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> exploration = EpsilonGreedy(1.0, 0.1, anneal_frames=100)
        >>> exploration.step(50)
        >>> round(exploration.epsilon.item(), 3)
        0.55
        >>> exploration(torch.tensor([[0.0, 2.0, 1.0]]))
        tensor([1])
    """

    frames: Tensor
    epsilon: Tensor

    def __init__(self, start: float = 1.0, end: float = 0.1, *, anneal_frames: int = 100_000) -> None:
        super().__init__()
        for name, value in (("start", start), ("end", end)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must be an epsilon in [0, 1], got {value}; the paper goes from 1.0 to 0.1.")
        if anneal_frames < 1:
            raise ValueError(f"anneal_frames must be >= 1, got {anneal_frames}; use start == end for a constant.")
        self.start, self.end, self.anneal_frames = start, end, anneal_frames
        self.register_buffer("frames", torch.zeros((), dtype=torch.int64))
        self.register_buffer("epsilon", torch.tensor(float(start)))

    def step(self, frames: int) -> None:
        """Advances the schedule by ``frames`` environment frames."""
        self.frames += frames
        progress = (self.frames / self.anneal_frames).clamp(max=1.0)
        self.epsilon.copy_(self.start + (self.end - self.start) * progress)

    def forward(self, action_value: Tensor, mask: Tensor | None = None) -> Tensor:
        """Chooses among ``action_value`` ``[*, A]`` where ``mask`` ``[*, A]`` allows (anywhere if it allows nothing).

        Returns:
            The choice ``[*]`` int64.
        """
        if mask is not None:
            action_value = mask_values(action_value, mask)
        greedy = action_value.argmax(-1)
        if exploration_type() != ExplorationType.RANDOM:
            return greedy
        lottery = torch.rand_like(action_value)
        if mask is not None:
            lottery = mask_values(lottery, mask)
        explores = torch.rand(greedy.shape, device=greedy.device) < self.epsilon
        return torch.where(explores, lottery.argmax(-1), greedy)


def mask_values(values: Tensor, mask: Tensor) -> Tensor:
    """Sets the values ``[*, A]`` that ``mask`` forbids to minus infinity; a row that allows nothing stays as it is."""
    return values.masked_fill(~mask & mask.any(-1, keepdim=True), -torch.inf)
