"""Replay memories that give back sequences (section III-B of the paper)."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, SliceSampler, Storage, TensorDictReplayBuffer

from hdrqn_torchrl import keys

Sampling = Literal["steps", "episodes", "episode_starts"]


class StepSliceSampler(SliceSampler):
    """Slices that start at a uniformly random *step*; TorchRL's ``SliceSampler`` picks an episode first.

    How long an episode lasts depends on what happened in it. To pick episodes uniformly shows each step of a
    short (say, successful) episode more often than it occurs, and shows its last steps less often than those in
    its middle; Q-values of a stochastic task are then biased. Here whether a step is shown depends on its past
    only. A slice that meets the end of its episode is padded and ``("collector", "mask")`` tells its real steps.

    Args:
        slice_len: steps of a slice.
        traj_key: entry that numbers the episodes.

    Examples:
        >>> from tensordict import TensorDict
        >>> sampler = StepSliceSampler(slice_len=4, traj_key="episode")
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10), sampler=sampler, batch_size=8)
        >>> _ = buffer.extend(TensorDict(episode=torch.tensor([0, 0, 0, 1, 1]), batch_size=5))
        >>> buffer.sample().reshape(2, 4)["collector", "mask"].shape
        torch.Size([2, 4])
    """

    def __init__(self, *, slice_len: int, traj_key: NestedKey = keys.TRAJ_IDS) -> None:
        super().__init__(
            slice_len=slice_len,
            traj_key=traj_key,
            truncated_key=None,
            init_key=None,
            cache_values=True,
            strict_length=False,
            pad_output=True,
        )

    def sample(self, storage: Storage, batch_size: int) -> tuple[tuple[Tensor, ...], dict[NestedKey, Any]]:
        """Draws ``batch_size // slice_len`` slices; returns their indices, one tensor per storage dimension."""
        first, _, lengths = self._get_stop_and_length(storage)  # [E, ndim], [E]
        length, count = self._adjusted_batch_size(batch_size)
        ends = lengths.cumsum(0)
        step = torch.randint(int(ends[-1]), (count,), device=ends.device, generator=self._rng)
        episode = torch.searchsorted(ends, step, right=True)
        left = ends[episode] - step  # real steps from the start of the slice on
        offset = torch.arange(length, device=ends.device)
        mask = offset < left.unsqueeze(-1)  # [B, T]
        time = first[episode, 0] + lengths[episode] - left
        time = time.unsqueeze(-1) + torch.minimum(offset, left.unsqueeze(-1) - 1)  # padding repeats the last step
        index = [(time % storage.shape[0]).flatten()]
        index += [place.repeat_interleave(length) for place in first[episode, 1:].unbind(-1)]
        return tuple(index), {keys.PAD_MASK: mask.flatten()}


class EpisodeStartSampler(SliceSampler):
    """Slices that start where a random episode starts, and run on into the next ones if it is shorter.

    The recurrent state of every step is exact, no step is padding, and whether a step is shown depends on its past only
    (see :class:`StepSliceSampler`). Needs a storage of two dimensions (time, environment).

    Args:
        slice_len: steps of a slice; an episode's later steps are never shown.
        init_key: first step of an episode.
        traj_key: entry that numbers the episodes.
    """

    def __init__(
        self, *, slice_len: int, init_key: NestedKey = keys.IS_INIT, traj_key: NestedKey = keys.TRAJ_IDS
    ) -> None:
        super().__init__(slice_len=slice_len, traj_key=traj_key, truncated_key=None, init_key=None, cache_values=True)
        self.first_key = init_key

    def sample(self, storage: Storage, batch_size: int) -> tuple[tuple[Tensor, ...], dict[NestedKey, Any]]:
        """Draws ``batch_size // slice_len`` slices; returns their indices, one tensor per storage dimension."""
        length, count = self._adjusted_batch_size(batch_size)
        contents = storage._mutation_revision
        if contents not in self._cache:
            self._cache.clear()
            self._cache[contents] = self._find_starts(storage, length)
        time, environment = self._cache[contents]
        if not len(time):
            raise RuntimeError(
                f"no stored start of an episode begins slice_len={length} stored steps; update later, raise capacity "
                "or use shorter slices."
            )
        chosen = torch.randint(len(time), (count,), device=time.device, generator=self._rng)
        times = time[chosen].unsqueeze(-1) + torch.arange(length, device=time.device)
        return ((times % storage.shape[0]).flatten(), environment[chosen].repeat_interleave(length)), {}

    def _find_starts(self, storage: Storage, length: int) -> tuple[Tensor, Tensor]:
        """Time and environment of every first step that ``length - 1`` newer steps follow."""
        init = storage[:].get(self.first_key).squeeze(-1)  # [rows, N]
        newest = storage._last_cursor_index
        age = (newest - torch.arange(len(init), device=init.device)) % len(init)
        return (init & (age >= length - 1).unsqueeze(-1)).nonzero(as_tuple=True)  # type: ignore[return-value]


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
            ``"episode_starts"``: from the start of a random episode on (:class:`EpisodeStartSampler`).
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
    if sampling == "steps":
        sampler = StepSliceSampler(slice_len=slice_len, traj_key=traj_key)
    elif sampling == "episode_starts":
        if num_envs is None:
            raise ValueError("sampling must be 'steps' or 'episodes' for rows, got 'episode_starts'.")
        sampler = EpisodeStartSampler(slice_len=slice_len, traj_key=traj_key)
    elif sampling == "episodes":
        sampler = SliceSampler(
            slice_len=slice_len,
            traj_key=traj_key,
            init_key=None,  # keep the stored flag: it tells true starts of episodes
            cache_values=True,
            strict_length=False,
            pad_output=True,
        )
    else:
        raise ValueError(
            f"sampling must be 'steps', 'episodes' or 'episode_starts', got {sampling!r}; the paper's is 'episodes'."
        )
    return TensorDictReplayBuffer(
        storage=SequenceStorage(capacity, ndim=1 if num_envs is None else 2, device=device),
        sampler=sampler,
        batch_size=batch_size * slice_len,
    )


def sample_sequences(buffer: TensorDictReplayBuffer, slice_len: int) -> TensorDictBase:
    """Draws a sample from a buffer of :func:`make_sequence_buffer` as sequences ``[batch_size, slice_len]``."""
    return buffer.sample().reshape(-1, slice_len)
