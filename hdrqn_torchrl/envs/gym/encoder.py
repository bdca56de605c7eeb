"""How what an environment shows becomes an array of fixed shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torchrl.data import Bounded, Categorical, TensorSpec, Unbounded

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.findings import ReturnError


@dataclass(frozen=True, kw_only=True)
class Encoder:
    """Makes one array of fixed shape of an observation.

    Attributes:
        encode: takes an observation of the environment.
        space: of what it returns: a ``Box`` (image or vector) or ``MultiDiscrete`` (codes).
        parts: names and sizes of the entries that a vector is joined from; empty: it is one.
    """

    encode: Callable[[Any], NDArray]
    space: spaces.Box | spaces.MultiDiscrete
    parts: tuple[tuple[str, int], ...] = ()

    @property
    def is_image(self) -> bool:
        return isinstance(self.space, spaces.Box) and len(self.space.shape) == 3

    def check_finite(self, batch: NDArray) -> None:
        """Refuses floats ``[N, ...]`` that are none, or were too large for float32: of all worlds at once, for speed.

        Raises:
            ReturnError: naming the entry and the world.
        """
        if batch.dtype.kind != "f" or np.count_nonzero(np.isfinite(batch)) == batch.size:
            return
        world, *place = (int(each) for each in np.argwhere(~np.isfinite(batch))[0])
        value, name = batch[(world, *place)], keys.OBSERVATION
        for name, size in self.parts:  # noqa: B007 (the last one is meant)
            if place[0] < size:
                break
            place[0] -= size
        raise ReturnError(
            f"{name}[{', '.join(map(str, place))}] of world {world} must be a finite number as float32, got {value}; "
            "correct what the environment returns."
        )

    def spec(self, num_envs: int, *, device: torch.device | None = None) -> TensorSpec:
        """TorchRL's spec of a batch of what it returns."""
        space, shape = self.space, (num_envs, *self.space.shape)
        dtype = torch.from_numpy(np.empty(0, space.dtype)).dtype
        if isinstance(space, spaces.MultiDiscrete):
            if space.nvec.ndim == 2:  # a window: the same number for all cells
                return Categorical(int(space.nvec.max()), shape=shape, dtype=dtype, device=device)
            highest = torch.as_tensor(np.array(space.nvec), dtype=dtype, device=device) - 1
            return Bounded(torch.zeros_like(highest).expand(shape), highest.expand(shape), dtype=dtype, device=device)
        if not np.isfinite(space.low).all() or not np.isfinite(space.high).all():
            return Unbounded(shape=shape, dtype=dtype, device=device)
        low, high = (torch.as_tensor(bound, device=device).expand(shape) for bound in (space.low, space.high))
        return Bounded(low, high, shape=shape, dtype=dtype, device=device)
