"""What a device means for the code that runs on it."""

from __future__ import annotations

import torch
from torch import Tensor


def on_host(tensor: Tensor) -> bool:
    """Whether the host can look into a tensor without waiting for a device.

    Where it can, a look may save work (``if mask.any(): ...``). On a GPU it would stop the queue of kernels, and the
    work is done in any case.
    """
    return tensor.device.type == "cpu"


def multiplies_bfloat16(kind: str) -> bool:
    """Whether devices of a kind (``"cpu"``, ``"cuda"``) have matrix units for bfloat16."""
    if kind == "cpu":
        return bool(torch.cpu.get_capabilities().get("amx_bf16", False))
    return kind == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)


def autocast_dtype(tensor: Tensor) -> torch.dtype | None:
    """What autocast makes of matrix products on a tensor's device; ``None`` outside of it."""
    kind = tensor.device.type
    if not torch.amp.is_autocast_available(kind) or not torch.is_autocast_enabled(kind):
        return None
    return torch.get_autocast_dtype(kind)
