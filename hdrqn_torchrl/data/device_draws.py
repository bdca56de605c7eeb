"""Draws whose shapes do not depend on what is stored, so that a GPU can do them inside a captured update."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from hdrqn_torchrl.data.device_priorities import DevicePrioritySampler, cumulative, pick
from hdrqn_torchrl.data.replay import SequenceBuffer
from hdrqn_torchrl.data.slices import padded_slices


class DeviceDraws:
    """Draws sequences from a memory as its sampler does, in distribution.

    TorchRL's samplers, and ours that build on them, list the stored episodes: how many there are, only the host can
    find out. Here every stored step has a weight, in a table as long as the memory.

    Args:
        buffer: of :func:`~hdrqn_torchrl.data.make_sequence_buffer`, on the device; if it draws by priority, so does
            every call of :meth:`draw`, by those of that moment.
        sequences: of a draw.
        length: steps of a sequence, lookahead included.

    Examples:
        See :class:`~hdrqn_torchrl.learning.Learner`.
    """

    def __init__(self, buffer: SequenceBuffer, *, sequences: int, length: int) -> None:
        self._buffer, self._storage, self._sampler = buffer, buffer._storage, buffer._sampler
        self._sequences, self._length = sequences, length
        self._revision: int | None = None
        self._sums: Tensor | None = None  # [capacity], of weights
        self._left: Tensor | None = None  # [capacity]
        self._pads = False

    def refresh(self) -> None:
        """Takes up what was written since the last call; no part of a capture.

        Raises:
            ValueError: if the buffer has transforms.
        """
        if self._buffer.transforms:
            raise ValueError(
                f"the buffer must have no transforms where updates are captured, got {self._buffer.transforms}: what "
                "is drawn inside a graph does not pass them; use capture=False."
            )
        if isinstance(self._sampler, DevicePrioritySampler):
            self._sampler.admit(self._storage)
        elif self._revision != self._storage._mutation_revision:
            self._revision = self._storage._mutation_revision
            self._tabulate()

    def _tabulate(self) -> None:
        weight, left = self._sampler.weights(self._storage)
        if self._sums is None:
            self._sums = torch.zeros(self._storage.max_size, dtype=torch.int64, device=weight.device)
            self._left = torch.full_like(self._sums, self._length)
        written = weight.numel()
        self._sums[:written] = cumulative(weight.flatten())
        self._sums[written:] = self._sums[written - 1]
        self._pads = left is not None
        if left is not None and self._left is not None:
            self._left[:written] = left.flatten()

    def draw(self) -> TensorDictBase:
        """Sequences ``[B, T]``, with what ``buffer.sample`` writes into them."""
        place, left, info = self._choose()
        others = self._storage.row_shape[0] if self._storage.row_shape else 1
        start = torch.stack([place // others, place % others][: self._storage.ndim], -1)
        index, mask = padded_slices(start, left, self._length, rows=self._storage.rows)
        drawn = self._storage._storage[index]  # also of rows that were not written yet, when it was captured
        info["index"] = torch.stack(index, -1)
        for key, value in ({**mask, **info} if self._pads else info).items():
            drawn.set(key, value)
        return drawn.reshape(-1, self._length)

    def _choose(self) -> tuple[Tensor, Tensor, dict[NestedKey, Tensor]]:
        """Places of starts and steps left from there, ``[B]``, and what else a sampler tells, ``[B * T]``."""
        if isinstance(self._sampler, DevicePrioritySampler):
            self._pads = True
            place, weight = self._sampler.draw(self._sequences)
            return place, self._sampler.left[place], {"priority_weight": weight.repeat_interleave(self._length)}
        assert self._sums is not None and self._left is not None, "refresh() comes before the first draw"
        place = pick(self._sums, self._sequences)
        return place, self._left[place], {}

    def set_priorities(self, sample: TensorDictBase, priority: Tensor) -> None:
        """Sets the priorities ``[B]`` of sequences that were drawn."""
        self._sampler.update_priority(sample.get("index")[:, 0], priority, storage=self._storage)
