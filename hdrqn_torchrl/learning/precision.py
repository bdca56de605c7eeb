"""The precision of learning: float32, or bfloat16 in the matrix products of losses.

Only what autocast lowers has the lower precision: dense layers, convolutions and the LSTM. Parameters, Q-values,
targets, optimiser, acting and all that is stored are float32 in any case.
"""

from __future__ import annotations

import warnings
from contextlib import AbstractContextManager, nullcontext
from typing import Literal

import torch
from torch import nn

from hdrqn_torchrl.devices import is_faster_in_bfloat16, multiplies_bfloat16

Precision = Literal["fp32", "bf16"]


def choose_precision(wanted: Precision | Literal["auto"], network: nn.Module) -> Precision:
    """What a setting means for a network on its device.

    Args:
        wanted: ``"auto"`` is ``"bf16"`` where the device multiplies it faster (a GPU that has it, a CPU with AMX, one
            of AMD with AVX-512 BF16) and the network is large enough to gain, else ``"fp32"``. The same machine and
            network give the same answer.
        network: its parameters are where it will be trained.

    Raises:
        ValueError: if ``wanted`` is unknown, or ``"bf16"`` on a GPU that lacks it.

    Examples:
        >>> choose_precision("auto", nn.Linear(4, 2))
        'fp32'
    """
    if wanted not in ("auto", "fp32", "bf16"):
        raise ValueError(f"precision must be 'auto', 'fp32' or 'bf16', got {wanted!r}; 'fp32' is always right.")
    kind = next(network.parameters()).device.type
    if wanted == "auto":
        return "bf16" if gains(network) and is_faster_in_bfloat16(kind) else "fp32"
    if wanted == "bf16" and kind != "cpu" and not multiplies_bfloat16(kind):
        raise ValueError(f"precision must be 'fp32' or 'auto' on this device ({kind}), which lacks bf16.")
    if wanted == "bf16" and kind == "cpu" and not is_faster_in_bfloat16(kind):
        warnings.warn("precision='bf16' is slower than float32 on this CPU; use 'auto' or 'fp32'.", stacklevel=2)
    return wanted


def gains(network: nn.Module) -> bool:
    """Whether a network is large enough: it has convolutions, or an LSTM of at least 128 units."""
    return any(
        isinstance(part, nn.Conv2d) or (isinstance(part, nn.LSTM) and part.hidden_size >= 128)
        for part in network.modules()
    )


def matrix_products(precision: Precision, kind: str) -> AbstractContextManager:
    """A context for the forward pass of a loss on a kind of device; its backward pass follows suit."""
    if precision == "fp32":
        return nullcontext()
    # Without cache: a weight first read without gradient, by a target network, would lose its gradient for good.
    return torch.autocast(kind, torch.bfloat16, cache_enabled=False)
