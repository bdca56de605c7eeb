"""Replay memories that give back sequences (section IV-C of the paper)."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

from hdrqn_torchrl import keys


def make_sequence_buffer(
    capacity: int,
    *,
    slice_len: int,
    batch_size: int,
    num_envs: int | None = None,
    traj_key: NestedKey = keys.TRAJ_IDS,
    device: str = "cpu",
) -> TensorDictReplayBuffer:
    """A TorchRL replay buffer from which random slices of random episodes are drawn ("bootstrapped random updates").

    An episode is chosen uniformly, then a start in it uniformly. Episodes shorter than ``slice_len`` are not
    dropped: they are padded and ``("collector", "mask")`` tells which steps are real.

    Args:
        capacity: number of transitions kept.
        slice_len: n, transitions of a sequence.
        batch_size: number of sequences of a sample.
        num_envs: N if the buffer is extended by collected batches ``[N, T]`` with T >= 2 (steps); ``None`` if by rows
            ``[M]`` that keep each episode together (options).
        traj_key: entry that numbers the episodes.
        device: device of the storage.

    Returns:
        The buffer; sample from it with :func:`sample_sequences`.

    Raises:
        ValueError: if a number breaks its rule.
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
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity, ndim=1 if num_envs is None else 2, device=device),
        sampler=SliceSampler(
            slice_len=slice_len,
            traj_key=traj_key,
            init_key=None,  # keep the stored flag: it tells true starts of episodes
            cache_values=True,
            strict_length=False,
            pad_output=True,
        ),
        batch_size=batch_size * slice_len,
    )


def sample_sequences(buffer: TensorDictReplayBuffer, slice_len: int) -> TensorDictBase:
    """Draws a sample from a buffer of :func:`make_sequence_buffer` as sequences ``[batch_size, slice_len]``."""
    return buffer.sample().reshape(-1, slice_len)
