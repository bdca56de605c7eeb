"""How the code depends on the device that it runs on."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy
import torch
from torch import Tensor


def on_host(tensor: Tensor) -> bool:
    """Whether the host can read a tensor without waiting for a device.

    On the CPU, reading a value may save work (``if mask.any(): ...``). On a GPU it would stall the queue of kernels, so
    the work is always done.
    """
    return tensor.device.type == "cpu"


def multiplies_bfloat16(kind: str) -> bool:
    """Whether devices of a kind (``"cpu"``, ``"cuda"``) have matrix units for bfloat16."""
    if kind == "cpu":
        return bool(torch.cpu.get_capabilities().get("amx_bf16", False))
    return kind == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)


def autocast_dtype(tensor: Tensor) -> torch.dtype | None:
    """The dtype that autocast uses for matrix products on a tensor's device; ``None`` outside autocast."""
    kind = tensor.device.type
    if not torch.amp.is_autocast_available(kind) or not torch.is_autocast_enabled(kind):
        return None
    return torch.get_autocast_dtype(kind)


@contextmanager
def own_random_numbers(seed: int | None = None) -> Iterator[None]:
    """Restores the random states of torch (CPU and GPUs), numpy and Python on exit.

    Args:
        seed: seeds all of them on entry; ``None``: they keep their states.

    Examples:
        >>> before = torch.get_rng_state()
        >>> with own_random_numbers(3):
        ...     _ = torch.rand(5)
        >>> torch.equal(torch.get_rng_state(), before)
        True
    """
    generators = _generators()
    states, of_python, of_numpy = [each.get_state() for each in generators], random.getstate(), numpy.random.get_state()
    try:
        if seed is not None:
            for generator in generators:
                generator.manual_seed(seed)
            random.seed(seed)
            numpy.random.seed(seed % 2**32)
        yield
    finally:
        for generator, state in zip(generators, states, strict=True):
            generator.set_state(state)
        random.setstate(of_python)
        numpy.random.set_state(of_numpy)


def _generators() -> list[torch.Generator]:
    """Torch's default generators, on the host and on GPUs in use: those that ``torch.manual_seed`` seeds."""
    return [torch.default_generator, *(torch.cuda.default_generators if torch.cuda.is_initialized() else ())]
