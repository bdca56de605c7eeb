"""Vectors whose entries have bounds, on one scale."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.data import Bounded, TensorSpec

_LARGEST = 1e4  # beyond it a bound says only that there is none


class ScaledVector(nn.Module):
    """Maps entries from their bounds to [-1, 1]; entries without bounds stay as they are.

    So what is bounded by 0.4, such as the angle of a pole, weighs as much at first as what is bounded by 5.

    Args:
        spec: of vectors ``[N, D]``.

    Shapes:
        ``[*, D]`` of any dtype -> ``[*, D]`` float.

    Examples:
        >>> spec = Bounded(torch.tensor([[0.0, -torch.inf]]), torch.tensor([[4.0, torch.inf]]), shape=(1, 2))
        >>> ScaledVector(spec)(torch.tensor([[0.0, 7.0], [3.0, -7.0]]))
        tensor([[-1.0000,  7.0000],
                [ 0.5000, -7.0000]])
    """

    _middle: Tensor
    _factor: Tensor

    def __init__(self, spec: TensorSpec) -> None:
        super().__init__()
        low = high = torch.zeros(spec.shape[-1])
        if isinstance(spec, Bounded):
            bounds = (spec.space.low, spec.space.high)
            low, high = (bound.reshape(-1, spec.shape[-1])[0].float().cpu() for bound in bounds)
        bounded = (low.abs() <= _LARGEST) & (high.abs() <= _LARGEST) & (low < high)
        self.register_buffer("_middle", torch.where(bounded, (low + high) / 2, 0.0), persistent=False)
        self.register_buffer("_factor", torch.where(bounded, 2 / (high - low), 1.0), persistent=False)

    def forward(self, vector: Tensor) -> Tensor:
        return (vector.to(self._factor.dtype) - self._middle) * self._factor
