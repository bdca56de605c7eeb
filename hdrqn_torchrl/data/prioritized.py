"""Sequences drawn by what is left to learn from them (Schaul et al., 2016; Kapturowski et al., 2019)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Storage
from torchrl.data.replay_buffers import PrioritizedSampler

from hdrqn_torchrl import keys
from hdrqn_torchrl.data.slices import episode_starts, padded_slices, steps_left

PriorityStarts = Literal["steps", "episode_starts", "whole_episodes"]
FLOOR = 1e-3
"""Added to priorities: keeps sequences without error in play."""
_TINY = torch.finfo(torch.float32).tiny


@dataclass(frozen=True, kw_only=True)
class StartRule:
    """Which stored steps begin a sequence that is complete: long enough, or ended by its episode.

    Args:
        slice_len, sampling, init_key, traj_key, done_key, terminated_key: as in :class:`PrioritizedSequenceSampler`.
    """

    slice_len: int
    sampling: PriorityStarts = "steps"
    init_key: NestedKey = keys.IS_INIT
    traj_key: NestedKey = keys.TRAJ_IDS
    done_key: NestedKey = ("next", keys.DONE)
    terminated_key: NestedKey | None = None

    def find(self, storage: Storage) -> tuple[Tensor, Tensor]:
        """Whether each stored step begins a complete sequence, and how many of its steps are real, ``[rows, N]``."""
        stored, newest, length = storage[:], storage._last_cursor_index, self.slice_len  # type: ignore[attr-defined]
        rows = (len(stored), -1)
        episode, done = stored.get(self.traj_key).view(rows), stored.get(self.done_key).view(rows)
        left, ended = steps_left(episode, done, newest)
        complete = ended | (left >= length)
        if self.terminated_key is not None:
            complete &= (left > 1) | stored.get(self.terminated_key).view(rows)
        if self.sampling == "steps":
            return complete, left
        init = stored.get(self.init_key).view(rows)
        if self.sampling == "whole_episodes":
            return init & complete, left
        return episode_starts(init, episode, done, newest, length), torch.full_like(left, length)


def places_of(index: Tensor, storage: Storage) -> Tensor:
    """Places of steps ``[M, ndim]`` in a table of all, time by time."""
    return index[:, 0] if storage.ndim == 1 else index[:, 0] * storage.shape[1] + index[:, 1]


def check_priorities(priorities: Tensor, starts: Tensor, largest: float | None, *, capacity: int) -> None:
    """Refuses stored priorities that are none, or of another memory.

    Raises:
        ValueError: if so.
    """
    shape = (capacity,)
    if priorities.shape != shape or starts.shape != shape or starts.dtype != torch.bool:
        raise ValueError(
            f"stored priorities must be those of {capacity} steps, got {list(priorities.shape)} and "
            f"{list(starts.shape)}; load them with the capacity and num_envs that they were saved with."
        )
    known = priorities[starts]
    if not (torch.isfinite(known) & (known > 0)).all() or not (largest is None or 0 <= largest < float("inf")):
        raise ValueError("stored priorities must be finite and > 0, got others; use another checkpoint.")


class PrioritizedSequenceSampler(PrioritizedSampler):
    r"""Slices that start at a step with probability :math:`p^\alpha / \sum p^\alpha`, where p is that step's priority.

    TorchRL's ``PrioritizedSliceSampler`` joins episodes, and the newest steps to the oldest, once a storage [time,
    environment] is full, takes 0.3 s after every write at 200,000 steps, and has a state that only pickle can save; so
    its ``PrioritizedSampler`` draws the starts alone here, among those whose slice is complete: long enough, or ended
    by its episode. A new start has the largest priority there ever was, at least 1.

    Samples hold ``"priority_weight"``, :math:`p^{-\alpha \beta}`, the same at all steps of a slice; losses take it
    relative to the largest of a minibatch. ``buffer.update_priority(index_of_starts, priority)`` sets new priorities.

    Args:
        capacity: steps that the storage holds.
        slice_len: steps of a slice.
        sampling: which steps may start one: every step (``"steps"``), or first steps of episodes, whose slices run on
            into the next ones (``"episode_starts"``) or are padded (``"whole_episodes"``).
        priority_exponent: alpha; 0 is uniform.
        importance_exponent: beta; 1 makes up for the drawing in full, 0 not at all.
        init_key, traj_key, done_key: first step, number and last step of an episode; the first is not read for
            ``"steps"``.
        terminated_key: as in :class:`~hdrqn_torchrl.data.StepSliceSampler`.

    Examples:
        >>> from tensordict import TensorDict
        >>> _ = torch.manual_seed(0)
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> sampler = PrioritizedSequenceSampler(10, slice_len=2, traj_key="episode")
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), sampler=sampler, batch_size=40)
        >>> steps = TensorDict(episode=torch.zeros(4, dtype=torch.int64), step=torch.arange(4), batch_size=4)
        >>> steps["next", "done"] = torch.zeros(4, 1, dtype=torch.bool)
        >>> _ = buffer.extend(steps)
        >>> buffer.sample().reshape(20, 2)["step"][:, 0].unique().tolist()
        [0, 1, 2]
        >>> buffer.update_priority(torch.tensor([[0], [1], [2]]), torch.tensor([0.0, 100.0, 0.0]))
        >>> buffer.sample().reshape(20, 2)["step"][:, 0].unique().tolist()
        [1]
    """

    _rng: torch.Generator | None

    def __init__(
        self,
        capacity: int,
        *,
        slice_len: int,
        sampling: PriorityStarts = "steps",
        priority_exponent: float = 0.9,
        importance_exponent: float = 0.6,
        init_key: NestedKey = keys.IS_INIT,
        traj_key: NestedKey = keys.TRAJ_IDS,
        done_key: NestedKey = ("next", keys.DONE),
        terminated_key: NestedKey | None = None,
    ) -> None:
        super().__init__(capacity, priority_exponent, importance_exponent, eps=FLOOR, device="cpu")
        self.slice_len, self.sampling = slice_len, sampling
        self._rule = StartRule(
            slice_len=slice_len,
            sampling=sampling,
            init_key=init_key,
            traj_key=traj_key,
            done_key=done_key,
            terminated_key=terminated_key,
        )
        self._forget()

    def _forget(self) -> None:
        self._starts = torch.zeros(self._max_capacity, dtype=torch.bool)  # what the tree holds, time by time
        self._left: Tensor | None = None  # [rows, N]
        self._revision: int | None = None

    def sample(self, storage: Storage, batch_size: int) -> tuple[tuple[Tensor, ...], dict[NestedKey, Any]]:
        """Draws ``batch_size // slice_len`` slices; returns their indices, one tensor per storage dimension."""
        left = self._admit(storage)
        if not self._starts.any():
            raise RuntimeError(
                f"no stored step begins a complete sequence of slice_len={self.slice_len} steps; update later, raise "
                "capacity or use shorter slices."
            )
        place, priority = self._draw(batch_size // self.slice_len, steps=left.numel())
        weight, place = priority**-self._beta, place.to(left.device)
        start = torch.stack(torch.unravel_index(place, storage.shape[: storage.ndim]), -1)  # [B, ndim]
        index, info = padded_slices(start, left.flatten()[place], self.slice_len, rows=storage.shape[0])
        return index, {**info, "priority_weight": weight.repeat_interleave(self.slice_len)}

    def _draw(self, number: int, *, steps: int) -> tuple[Tensor, Tensor]:
        """Places of starts among the first ``steps``, and their priorities, ``[number]`` each.

        TorchRL's own draw fails where the random number is 0, once in 2**24, and no sequence begins at place 0.
        """
        mass = torch.rand(number, generator=self._rng) * self._sum_tree.query(0, steps)
        place = torch.as_tensor(self._sum_tree.scan_lower_bound(mass.clamp_(min=_TINY))).clamp_(max=steps - 1)
        priority = torch.as_tensor(self._sum_tree[place])
        while not priority.all():  # rounding led behind the last start
            place = torch.where(priority == 0, place - 1, place)
            priority = torch.as_tensor(self._sum_tree[place])
        return place, priority

    def can_sample(self, storage: Storage) -> bool:
        """Whether a complete sequence begins in a storage that is not empty."""
        self._admit(storage)
        return bool(self._starts.any())

    def _admit(self, storage: Storage) -> Tensor:
        """Takes up the starts that have become complete since the last draw; returns the steps left from each step."""
        if self._left is None or self._revision != storage._mutation_revision:
            self._revision = storage._mutation_revision
            complete, self._left = self._rule.find(storage)
            complete = complete.flatten().cpu()
            new = (complete & ~self._starts[: len(complete)]).nonzero().squeeze(-1)
            self._starts[new] = True
            if len(new):
                super().update_priority(new, self.default_priority)
        return self._left

    def mark_update(self, index: int | Tensor, *, storage: Storage | None = None) -> None:
        """Forgets the priorities of steps that were overwritten."""
        assert isinstance(index, Tensor) and storage is not None
        place = places_of(index.view(-1, storage.ndim), storage).cpu()
        self._starts[place] = False
        self._sum_tree[place] = 0.0

    def update_priority(self, index: int | Tensor, priority: float | Tensor, *, storage: Storage | None = None) -> None:
        """Sets priorities of starts that were drawn; those that were overwritten since then are skipped.

        Args:
            index: their places in the storage, ``[M, ndim]``.
            priority: absolute TD errors of their sequences, ``[M]``; see
                :func:`~hdrqn_torchrl.objectives.sequence_priority`.
            storage: the storage.
        """
        assert isinstance(index, Tensor) and isinstance(priority, Tensor) and storage is not None
        place = places_of(index, storage).cpu()
        there = self._starts[place]
        if there.any():
            super().update_priority(place[there], priority.cpu()[there])

    def forget_priorities(self) -> None:
        """Gives all sequences the priority of new ones: what they teach has changed."""
        self._sum_tree[self._starts.nonzero().squeeze(-1)] = 0.0
        self._forget()

    def _empty(self) -> None:
        super()._empty()
        self._forget()

    def state_dict(self) -> dict[str, Any]:
        """Priorities as a tensor, so that no tree needs to be pickled."""
        largest = self._max_priority[0]
        return {
            "priorities": torch.as_tensor(self._sum_tree[torch.arange(self._max_capacity)]),
            "starts": self._starts.clone(),
            "largest": None if largest is None else float(largest),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned.

        Raises:
            ValueError: if it is of another capacity, or holds something other than priorities.
        """
        priorities, starts = (state_dict[name].cpu() for name in ("priorities", "starts"))  # where the trees are
        check_priorities(priorities, starts, state_dict["largest"], capacity=self._max_capacity)
        self._empty()
        self._starts = starts.clone()
        known = self._starts.nonzero().squeeze(-1)
        if len(known):
            self._sum_tree[known] = self._min_tree[known] = priorities[known]
        if state_dict["largest"] is not None:
            self._max_priority = (torch.tensor(state_dict["largest"]), None)
