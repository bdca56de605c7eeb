"""Draws whose shapes do not depend on what is stored, so that a GPU can do them inside a captured update."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hdrqn_torchrl.data.replay import SequenceBuffer
from hdrqn_torchrl.data.slices import padded_slices


class DeviceDraws:
    """Draws sequences from a memory as its sampler does, in distribution.

    TorchRL's samplers, and ours that build on them, list the stored episodes: how many there are, only the host can
    find out. Here every stored step has a weight, in a table as long as the memory.

    Args:
        buffer: drawn from uniformly, of :func:`~hdrqn_torchrl.data.make_sequence_buffer`.
        sequences: of a draw.
        length: steps of a sequence, lookahead included.

    Examples:
        See :class:`~hdrqn_torchrl.learning.Learner`.
    """

    def __init__(self, buffer: SequenceBuffer, *, sequences: int, length: int) -> None:
        self._storage, self._sampler = buffer._storage, buffer._sampler
        self._sequences, self._length = sequences, length
        self._revision: int | None = None
        self._cumulative: Tensor | None = None  # [capacity], of weights
        self._left: Tensor | None = None  # [capacity]
        self._pads = False

    def refresh(self) -> None:
        """Takes up what was written since the last call; no part of a capture."""
        if self._revision == self._storage._mutation_revision:
            return
        self._revision = self._storage._mutation_revision
        weight, left = self._sampler.weights(self._storage)
        if self._cumulative is None:
            self._cumulative = weight.new_zeros(self._storage.max_size)
            self._left = torch.full_like(self._cumulative, self._length, dtype=torch.int64)
        written = weight.numel()
        self._cumulative[:written] = weight.flatten().cumsum(0)
        self._cumulative[written:] = self._cumulative[written - 1]
        self._pads = left is not None
        if left is not None and self._left is not None:
            self._left[:written] = left.flatten()

    def draw(self) -> TensorDictBase:
        """Sequences ``[B, T]``, with what ``buffer.sample`` writes into them."""
        assert self._cumulative is not None and self._left is not None, "refresh() comes before the first draw"
        total = self._cumulative[-1]
        ticket = torch.rand(self._sequences, dtype=total.dtype, device=total.device) * total
        place = torch.searchsorted(self._cumulative, ticket.clamp(max=total * (1 - 1e-15)), right=True)
        others = self._storage.row_shape[0] if self._storage.row_shape else 1
        start = torch.stack([place // others, place % others][: self._storage.ndim], -1)
        index, info = padded_slices(start, self._left[place], self._length, rows=self._storage.rows)
        drawn = self._storage._storage[index]  # also of rows that were not written yet, when it was captured
        for key, value in {**(info if self._pads else {}), "index": torch.stack(index, -1)}.items():
            drawn.set(key, value)
        return drawn.reshape(-1, self._length)
