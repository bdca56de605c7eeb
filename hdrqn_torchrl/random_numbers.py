"""The global random numbers of torch, numpy and Python: seeding them, and leaving them as they were."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy
import torch

_SEEDS_OF_NUMPY = 2**32


def seed_all(seed: int) -> None:
    """Seeds all of them, on GPUs, too.

    Args:
        seed: any that torch takes; numpy takes its lowest 32 bits.
    """
    torch.manual_seed(seed)
    _seed_others(seed)


def _seed_others(seed: int) -> None:
    random.seed(seed)
    numpy.random.seed(seed % _SEEDS_OF_NUMPY)


def host_state() -> tuple[Any, ...]:
    """Their states on the host, for :func:`set_host_state`."""
    return torch.default_generator.get_state(), random.getstate(), numpy.random.get_state()


def set_host_state(state: tuple[Any, ...]) -> None:
    """Brings them back to a state.

    Args:
        state: of :func:`host_state`.
    """
    of_torch, of_python, of_numpy = state
    torch.default_generator.set_state(of_torch)
    random.setstate(of_python)
    numpy.random.set_state(of_numpy)


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
    on_gpus = torch.cuda.default_generators if torch.cuda.is_initialized() else ()
    of_host, of_gpus = host_state(), [each.get_state() for each in on_gpus]
    try:
        if seed is not None:
            for generator in (torch.default_generator, *on_gpus):  # torch.manual_seed would seed GPUs not yet in use
                generator.manual_seed(seed)
            _seed_others(seed)
        yield
    finally:
        set_host_state(of_host)
        for generator, state in zip(on_gpus, of_gpus, strict=True):
            generator.set_state(state)
