"""What a device means for the code that runs on it."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy
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


@contextmanager
def own_random_numbers(seed: int | None = None) -> Iterator[None]:
    """Random numbers of torch (on the CPU and on GPUs), numpy and Python go on afterwards as if none had been drawn.

    Args:
        seed: of all of them inside; ``None``: they go on inside, too.

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
    """Torch's own, on the host and on the GPUs that are in use; ``torch.manual_seed`` reseeds all of them."""
    return [torch.default_generator, *(torch.cuda.default_generators if torch.cuda.is_initialized() else ())]
