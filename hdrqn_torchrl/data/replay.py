"""Replay memories that give back sequences (section III-B of the paper)."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.data.replay_buffers import Sampler

from hdrqn_torchrl import keys
from hdrqn_torchrl.data.prioritized import PrioritizedSequenceSampler
from hdrqn_torchrl.data.samplers import EpisodeStartSampler, StepSliceSampler, WholeEpisodeSampler

Sampling = Literal["steps", "episodes", "episode_starts", "whole_episodes"]
FROM_STARTS = ("episode_starts", "whole_episodes")
"""Samplings whose sequences all begin where an episode does, so that the zero state is exact."""


class SequenceStorage(LazyTensorStorage):
    """TorchRL's storage, whose state includes where it was written last.

    Without that, the first samples after a restart join the newest step in the ring to the oldest.
    """

    def state_dict(self) -> dict[str, Any]:
        if self._storage is None:
            return {"stored": None}
        stored = self[:]  # the part that was written
        return {"stored": stored, "rows": len(self._storage), "last_cursor": self._last_cursor_index}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        stored = state_dict["stored"]
        self._bump_mutation_revision()  # what samplers remember of the old contents is void
        self.initialized = stored is not None
        if stored is None:
            self._storage, self._len = None, 0
            return
        self._storage = stored[:1].expand(state_dict["rows"], *stored.shape[1:]).clone()
        self._storage[: len(stored)] = stored
        self._len = stored.numel()
        self._set_last_cursor(state_dict["last_cursor"])


def make_sequence_buffer(
    capacity: int,
    *,
    slice_len: int,
    batch_size: int,
    num_envs: int | None = None,
    sampling: Sampling = "steps",
    priority_exponent: float | None = None,
    importance_exponent: float = 0.6,
    traj_key: NestedKey = keys.TRAJ_IDS,
    device: torch.device | str = "cpu",
) -> TensorDictReplayBuffer:
    """A TorchRL replay buffer from which random slices of episodes are drawn ("bootstrapped random updates").

    Trajectories shorter than ``slice_len`` are not dropped: they are padded and ``("collector", "mask")`` tells
    which steps are real.

    Args:
        capacity: number of transitions kept.
        slice_len: n, transitions of a sequence.
        batch_size: number of sequences of a sample.
        num_envs: N if the buffer is extended by collected batches ``[N, T]`` with T >= 2 (steps); ``None`` if by rows
            ``[M]`` that keep each episode together (options).
        sampling: ``"steps"``: every step is equally likely to start a slice (:class:`StepSliceSampler`);
            ``"episodes"``: a random episode, then a random start in it, as the paper describes it;
            ``"episode_starts"``: from the start of a random episode on, and into the next ones
            (:class:`EpisodeStartSampler`); ``"whole_episodes"``: the same, padded after the episode's end
            (:class:`WholeEpisodeSampler`).
        priority_exponent, importance_exponent: draw sequences by priority, see :class:`PrioritizedSequenceSampler`;
            ``None``: all alike.
        traj_key: entry that numbers the episodes.
        device: device of the storage.

    Returns:
        The buffer; sample from it with :func:`sample_sequences`.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> make_sequence_buffer(1000, slice_len=8, batch_size=32, num_envs=4).sampler
        StepSliceSampler(...)
    """
    if slice_len < 1:
        raise ValueError(f"slice_len must be >= 1, got {slice_len}; use 1 for a feed-forward network.")
    if batch_size < 1:
        raise ValueError(f"batch_size must be >= 1 sequence, got {batch_size}; use 32.")
    if capacity < slice_len * max(num_envs or 1, 1):
        raise ValueError(
            f"capacity must hold at least slice_len={slice_len} transitions of each of {num_envs or 1} environments, "
            f"got {capacity}; the paper keeps 100,000 steps and 50,000 options."
        )
    if sampling == "episode_starts" and num_envs is None:
        raise ValueError("sampling must be 'steps', 'episodes' or 'whole_episodes' for rows, got 'episode_starts'.")
    sampler: Sampler = _make_sampler(sampling, slice_len, traj_key)
    if priority_exponent is not None:
        if sampling == "episodes":
            raise ValueError(
                "sampling must be 'steps', 'episode_starts' or 'whole_episodes' with priority_exponent, got "
                "'episodes', which picks an episode first."
            )
        sampler = PrioritizedSequenceSampler(
            -(-capacity // (num_envs or 1)) * (num_envs or 1),  # as many as the storage will hold
            slice_len=slice_len,
            sampling=sampling,
            priority_exponent=priority_exponent,
            importance_exponent=importance_exponent,
            traj_key=traj_key,
        )
    return TensorDictReplayBuffer(
        storage=SequenceStorage(capacity, ndim=1 if num_envs is None else 2, device=device),
        sampler=sampler,
        batch_size=batch_size * slice_len,
    )


def _make_sampler(sampling: Sampling, slice_len: int, traj_key: NestedKey) -> SliceSampler:
    own = {"steps": StepSliceSampler, "episode_starts": EpisodeStartSampler, "whole_episodes": WholeEpisodeSampler}
    if sampling in own:
        return own[sampling](slice_len=slice_len, traj_key=traj_key)
    if sampling != "episodes":
        raise ValueError(
            f"sampling must be 'steps', 'episodes', 'episode_starts' or 'whole_episodes', got {sampling!r}; the paper "
            "has 'episodes'."
        )
    return SliceSampler(
        slice_len=slice_len,
        traj_key=traj_key,
        init_key=None,  # keep the stored flag: it tells true starts of episodes
        cache_values=True,
        strict_length=False,
        pad_output=True,
    )


def sample_sequences(buffer: TensorDictReplayBuffer, slice_len: int) -> TensorDictBase:
    """Draws a sample from a buffer of :func:`make_sequence_buffer` as sequences ``[batch_size, slice_len]``."""
    return buffer.sample().reshape(-1, slice_len)
