"""What is sent every round, as bytes: a copy, and made faster than by torch's own pickling, a file for each tensor."""

from __future__ import annotations

import io
import pickle
from typing import Any

import torch
from torch import Tensor


def pack(message: Any) -> bytes:
    """A copy of something with tensors of a CPU in it.

    Examples:
        >>> weights = {"bias": torch.zeros(2)}
        >>> packed = pack(weights)
        >>> _ = weights["bias"].fill_(1)
        >>> unpack(packed)
        {'bias': tensor([0., 0.])}
    """
    file = io.BytesIO()
    _Packer(file, protocol=pickle.HIGHEST_PROTOCOL).dump(message)
    return file.getvalue()


def unpack(packed: bytes) -> Any:
    """What was packed. It runs code that whoever packed it chose: never give it what lies in a file."""
    return pickle.loads(packed)


class _Packer(pickle.Pickler):
    def reducer_override(self, item: Any) -> Any:
        if type(item) is Tensor and item.dtype != torch.bfloat16 and not item.requires_grad:
            return torch.from_numpy, (item.contiguous().numpy(),)
        return NotImplemented
