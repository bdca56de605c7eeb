"""Sequences drawn by priority where the priorities are tensors of a GPU, which a captured update reads and writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Storage
from torchrl.data.replay_buffers.samplers import Sampler

from hdrqn_torchrl.data.prioritized import FLOOR, StartRule, check_priorities, places_of
from hdrqn_torchrl.data.slices import padded_slices

_FINEST = 2**40  # parts of the largest weight


class DevicePrioritySampler(Sampler):
    """As :class:`~hdrqn_torchrl.data.PrioritizedSequenceSampler`, whose trees lie on the host.

    Every stored step has a place in a table as long as the memory, which is summed up at every draw. So nothing has a
    shape that depends on what is stored, and the host reads nothing. The table is changed in place: graphs go on
    with it. States are the same as the other's, and each can load the other's.

    Args:
        capacity, priority_exponent, importance_exponent: as there.
        rule: which steps begin a sequence.
        device: of the storage.

    Examples:
        >>> DevicePrioritySampler(10, StartRule(slice_len=2)).state_dict()["largest"]
        1.0
    """

    _rng: torch.Generator | None

    def __init__(
        self,
        capacity: int,
        rule: StartRule,
        *,
        priority_exponent: float = 0.9,
        importance_exponent: float = 0.6,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__()
        self._rule, self._alpha, self._beta = rule, priority_exponent, importance_exponent
        self.slice_len = rule.slice_len
        self._powers = torch.zeros(capacity, device=device)  # priority ** alpha; 0 where no complete sequence begins
        self._starts = torch.zeros(capacity, dtype=torch.bool, device=device)
        self.left = torch.full((capacity,), rule.slice_len, device=device)
        """Real steps from each on, ``[capacity]``."""
        self._largest = torch.ones((), device=device)
        self._revision: int | None = None
        self._can_sample: tuple[int, bool] | None = None

    def admit(self, storage: Storage) -> None:
        """Takes up the starts that have become complete since the last draw; no part of a capture."""
        if self._revision == storage._mutation_revision:
            return
        self._revision = storage._mutation_revision
        complete, left = (each.flatten() for each in self._rule.find(storage))
        starts, powers = self._starts[: len(complete)], self._powers[: len(complete)]
        powers.copy_(torch.where(complete & ~starts, self._power(self._largest), powers))
        starts |= complete
        self.left[: len(left)] = left

    def _power(self, priority: Tensor) -> Tensor:
        return (priority + FLOOR) ** self._alpha

    def draw(self, sequences: int) -> tuple[Tensor, Tensor]:
        """Places ``[B]`` of starts, after :meth:`admit`, and what corrects for their priorities, ``[B]``."""
        place = pick(cumulative(self._powers), sequences, self._rng)
        return place, self._powers[place] ** -self._beta

    def sample(self, storage: Storage, batch_size: int) -> tuple[tuple[Tensor, ...], dict[NestedKey, Any]]:
        """As that of the other sampler, on the device; asks it once after a write whether there is anything."""
        if not self.can_sample(storage):
            raise RuntimeError(
                f"no stored step begins a complete sequence of slice_len={self.slice_len} steps; update later, raise "
                "capacity or use shorter slices."
            )
        place, weight = self.draw(batch_size // self.slice_len)
        others = 1 if storage.ndim == 1 else storage.shape[1]
        start = torch.stack([place // others, place % others][: storage.ndim], -1)
        index, info = padded_slices(start, self.left[place], self.slice_len, rows=storage.shape[0])
        return index, {**info, "priority_weight": weight.repeat_interleave(self.slice_len)}

    def can_sample(self, storage: Storage) -> bool:
        """Whether a complete sequence begins in a storage that is not empty."""
        self.admit(storage)
        if self._can_sample is None or self._can_sample[0] != self._revision:
            self._can_sample = storage._mutation_revision, bool(self._starts.any())
        return self._can_sample[1]

    def mark_update(self, index: int | Tensor, *, storage: Storage | None = None) -> None:
        """Forgets the priorities of steps that were overwritten."""
        assert isinstance(index, Tensor) and storage is not None
        place = places_of(index.view(-1, storage.ndim), storage).to(self._starts.device)
        self._starts.index_fill_(0, place, False)
        self._powers.index_fill_(0, place, 0.0)

    def update_priority(self, index: int | Tensor, priority: float | Tensor, *, storage: Storage | None = None) -> None:
        """As that of the other sampler; of several for one start the largest counts, in whatever order they come."""
        assert isinstance(index, Tensor) and isinstance(priority, Tensor) and storage is not None
        place = places_of(index, storage)
        there, priority = self._starts[place], priority.detach()
        powers = torch.where(there, self._power(priority), 0.0)
        self._powers.scatter_reduce_(0, place, powers, "amax", include_self=False)
        self._largest.copy_(torch.maximum(self._largest, torch.where(there, priority, 0.0).max()))

    def forget_priorities(self) -> None:
        """As that of the other sampler."""
        self._powers.zero_()
        self._starts.zero_()
        self._revision, self._can_sample = None, None

    def _empty(self) -> None:
        self.forget_priorities()
        self._largest.fill_(1.0)

    def dumps(self, path: str | Path) -> None:
        """Writes the state to a folder."""
        Path(path).mkdir(parents=True, exist_ok=True)
        torch.save(self.state_dict(), Path(path) / "priorities.pt")

    def loads(self, path: str | Path) -> None:
        """Reads what :meth:`dumps` wrote."""
        self.load_state_dict(torch.load(Path(path) / "priorities.pt", weights_only=True))

    def state_dict(self) -> dict[str, Any]:
        """Priorities, as in the state of the other sampler."""
        return {
            "priorities": self._powers.clone(),
            "starts": self._starts.clone(),
            "largest": float(self._largest),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned, of this sampler or the other.

        Raises:
            ValueError: if it is of another capacity, or holds something other than priorities.
        """
        priorities, starts = (state_dict[name].to(self._starts.device) for name in ("priorities", "starts"))
        check_priorities(priorities, starts, state_dict["largest"], capacity=len(self._starts))
        self._empty()
        self._starts.copy_(starts)
        self._powers.copy_(torch.where(starts, priorities, 0.0))
        if state_dict["largest"] is not None:
            self._largest.fill_(state_dict["largest"])


def cumulative(weight: Tensor) -> Tensor:
    """Running sums of weights ``[capacity]``, in whole parts: sums of floats have no fixed order on a GPU.

    Args:
        weight: >= 0; less than 2**23 of them.

    Examples:
        >>> sums = cumulative(torch.tensor([0.5, 0.0, 1.5]))
        >>> (4 * sums / sums[-1]).tolist()
        [1.0, 1.0, 4.0]
    """
    weight = weight.double()
    return (weight * (_FINEST / weight.max().clamp(min=1e-300))).ceil().long().cumsum(0)


def pick(sums: Tensor, number: int, generator: torch.Generator | None = None) -> Tensor:
    """Places ``[number]``, each drawn in proportion to its weight; an arbitrary one if all weights are 0.

    Args:
        sums: of :func:`cumulative`.
        number: of draws.
        generator: of random numbers; ``None``: the default one of the device.
    """
    ticket = torch.rand(number, dtype=torch.float64, device=sums.device, generator=generator) * sums[-1]
    place = torch.searchsorted(sums, ticket.long().clamp(max=sums[-1] - 1), right=True)
    return place.clamp(max=len(sums) - 1)
