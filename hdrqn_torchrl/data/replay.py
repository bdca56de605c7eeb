"""Replay memories that return sequences (section III-B of the paper)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from hdrqn_torchrl import keys
from hdrqn_torchrl.data.device_priorities import DevicePrioritySampler
from hdrqn_torchrl.data.prioritized import PrioritizedSequenceSampler, StartRule
from hdrqn_torchrl.data.samplers import (
    EpisodeSliceSampler,
    EpisodeStartSampler,
    StepSliceSampler,
    WholeEpisodeSampler,
)
from hdrqn_torchrl.data.storage import SequenceStorage
from hdrqn_torchrl.devices import on_host

Sampling = Literal["steps", "episodes", "episode_starts", "whole_episodes"]
FROM_STARTS = ("episode_starts", "whole_episodes")
"""Kinds of sampling whose sequences all begin where an episode does, so that the zero state is exact."""
AnySampler = StepSliceSampler | EpisodeStartSampler | PrioritizedSequenceSampler | DevicePrioritySampler


class SequenceBuffer(TensorDictReplayBuffer):
    """TorchRL's replay buffer for batches of any length: a single step, or more than it can hold.

    Examples:
        >>> from tensordict import TensorDict
        >>> buffer = make_sequence_buffer(16, slice_len=4, batch_size=3, num_envs=2)
        >>> buffer.can_sample()
        False
        >>> steps = {"observation": torch.zeros(2, 5, 7), "collector": {"traj_ids": torch.tensor([[0] * 5, [1] * 5])}}
        >>> _ = buffer.extend(TensorDict(steps, [2, 5]))
        >>> buffer.can_sample(), len(buffer), buffer.is_full()
        (True, 10, False)
    """

    def extend(self, tensordicts: TensorDictBase, *, update_priority: bool | None = None) -> Tensor:
        """Stores transitions ``[N, T]`` or ``[M]``, after the inverses of transforms; the newest, if they are too many.

        Args:
            tensordicts: what is stored.
            update_priority: TorchRL's; not read, as new sequences have the largest priority.

        Raises:
            ValueError: if they are not of the shape that the memory was built for.
        """
        if self.transforms:
            tensordicts = self._transform.inv(tensordicts)
        self._storage.check_shape(tensordicts)
        written = tensordicts[..., -self._storage.rows :]
        if not on_host(next(written.values(True, True))):
            self._storage.newest = (self._writer._cursor + written.shape[-1] - 1) % self._storage.rows
        index = self._extend(written)
        self._storage.newest = None
        return index

    @property
    def transforms(self) -> int:
        """How many there are between what is stored and what is drawn."""
        return 0 if self._transform is None else len(self._transform)

    keeps_starts: bool = False
    """Whether a sequence can always be drawn once one could."""

    def can_sample(self) -> bool:
        """Whether a sequence can be drawn by now."""
        return len(self) > 0 and self._sampler.can_sample(self._storage)

    def is_full(self) -> bool:
        """Whether what comes next is written over what was stored first."""
        return self._storage._is_full

    def rewrite(self, change: Callable[..., None]) -> None:
        """Changes what is stored, in place.

        Args:
            change: takes the stored rows ``[rows, *]`` and, as ``newest``, the number of the one written last.
        """
        if len(self):
            change(self._storage[:], newest=self._storage._last_cursor_index)
            if isinstance(self._sampler, PrioritizedSequenceSampler | DevicePrioritySampler):
                self._sampler.forget_priorities()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restores what ``state_dict`` returned.

        Raises:
            ValueError: if it belongs to a memory of another size, or to none.
        """
        cursor = state_dict["_writer"]["_cursor"]
        if not 0 <= cursor < self._storage.rows:
            raise ValueError(
                f"the stored memory's next row must lie in [0, {self._storage.rows}), got {cursor}; it is damaged: use "
                "another checkpoint."
            )
        super().load_state_dict(state_dict)


def make_sequence_buffer(
    capacity: int,
    *,
    slice_len: int,
    batch_size: int,
    num_envs: int | None = None,
    lookahead: int = 0,
    episode_len: int | None = None,
    sampling: Sampling = "steps",
    priority_exponent: float | None = None,
    importance_exponent: float = 0.6,
    traj_key: NestedKey = keys.TRAJ_IDS,
    done_key: NestedKey = ("next", keys.DONE),
    terminated_key: NestedKey | None = None,
    device: torch.device | str = "cpu",
) -> SequenceBuffer:
    """A TorchRL replay buffer from which random slices of episodes are drawn ("bootstrapped random updates").

    Trajectories shorter than ``slice_len`` are not dropped: they are padded and ``("collector", "mask")`` marks
    the real steps.

    Args:
        capacity: number of transitions kept, rounded up to the same number for each environment.
        slice_len: n, transitions of a sequence.
        batch_size: number of sequences of a sample.
        num_envs: N if the buffer is extended by collected batches ``[N, T]`` (steps); ``None`` if by rows ``[M]`` that
            keep each episode together (options).
        lookahead: transitions that a sequence has beyond ``slice_len``. Where it begins does not depend on them.
        episode_len: largest number of transitions of an episode, if known; then a capacity is refused with which
            sequences from the start of an episode might run out.
        sampling: ``"steps"``: every step is equally likely to start a slice (:class:`StepSliceSampler`);
            ``"episodes"``: a random episode, then a random start in it, as the paper describes it
            (:class:`EpisodeSliceSampler`);
            ``"episode_starts"``: from the start of a random episode on, and into the next ones
            (:class:`EpisodeStartSampler`); ``"whole_episodes"``: the same, padded after the episode's end
            (:class:`WholeEpisodeSampler`).
        priority_exponent, importance_exponent: draw sequences by priority, see :class:`PrioritizedSequenceSampler`
            (on a GPU :class:`~hdrqn_torchrl.data.device_priorities.DevicePrioritySampler`); ``None``: all alike.
        traj_key: entry that numbers the episodes.
        done_key: last transition of an episode; read where sequences run on, or are drawn by priority.
        terminated_key: if given, sequences do not begin with the last stored transition of an episode unless this flag
            is set: what it led to is not stored, so that there would be nothing to learn from. ``"episode_starts"``
            does not read it.
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
    if lookahead < 0:
        raise ValueError(f"lookahead must be >= 0 transitions, got {lookahead}; use 0.")
    if batch_size < 1:
        raise ValueError(f"batch_size must be >= 1 sequence, got {batch_size}; use 32.")
    if sampling == "episode_starts" and num_envs is None:
        raise ValueError("sampling must be 'steps', 'episodes' or 'whole_episodes' for rows, got 'episode_starts'.")
    length = slice_len + lookahead
    _check_capacity(capacity, slice_len, lookahead, num_envs or 1, sampling, episode_len)
    storage = SequenceStorage(capacity, num_envs=num_envs, device=device)
    sampler: AnySampler
    if priority_exponent is None:
        sampler = _make_sampler(sampling, slice_len, lookahead, traj_key, done_key, terminated_key)
    elif sampling == "episodes":
        raise ValueError(
            "sampling must be 'steps', 'episode_starts' or 'whole_episodes' with priority_exponent, got 'episodes', "
            "which picks an episode first."
        )
    else:
        rule = StartRule(
            slice_len=length, sampling=sampling, traj_key=traj_key, done_key=done_key, terminated_key=terminated_key
        )
        sampler = _make_prioritized(storage.max_size, rule, priority_exponent, importance_exponent, device)
    buffer = SequenceBuffer(storage=storage, sampler=sampler, batch_size=batch_size * length)
    known = episode_len is not None if sampling in FROM_STARTS else terminated_key is None and priority_exponent is None
    buffer.keeps_starts = num_envs is not None and known
    return buffer


def _make_prioritized(
    capacity: int, rule: StartRule, priority: float, importance: float, device: torch.device | str | None
) -> PrioritizedSequenceSampler | DevicePrioritySampler:
    if on_host(torch.empty(0, device=device)):
        return PrioritizedSequenceSampler(
            capacity, **vars(rule), priority_exponent=priority, importance_exponent=importance
        )
    return DevicePrioritySampler(
        capacity, rule, priority_exponent=priority, importance_exponent=importance, device=device or "cpu"
    )


def _check_capacity(
    capacity: int, slice_len: int, lookahead: int, num_envs: int, sampling: Sampling, episode_len: int | None
) -> None:
    """Refuses a memory that can't hold a sequence, or in which there may be none at times."""
    beyond = f" and {lookahead} beyond" if lookahead else ""
    rows, needed = -(-capacity // num_envs), slice_len + lookahead
    if rows < needed or capacity < num_envs * slice_len:
        raise ValueError(
            f"capacity must hold at least slice_len={slice_len} transitions{beyond} of each of {num_envs} "
            f"environments, got {capacity}; the paper keeps 100,000 steps and 50,000 options."
        )
    if sampling not in FROM_STARTS or episode_len is None:
        return
    if sampling == "whole_episodes":
        needed = min(needed, episode_len)
    if rows < needed + episode_len - 1:
        raise ValueError(
            f"capacity must hold an episode of {episode_len} and slice_len={slice_len} transitions{beyond} of each of "
            f"{num_envs} environments with sampling={sampling!r}, or no stored sequence may begin where an episode "
            f"does, got {capacity}; use at least {num_envs * (needed + episode_len - 1)}."
        )


def _make_sampler(
    sampling: Sampling,
    slice_len: int,
    lookahead: int,
    traj_key: NestedKey,
    done_key: NestedKey,
    terminated_key: NestedKey | None,
) -> AnySampler:
    length = slice_len + lookahead
    if sampling == "steps":
        return StepSliceSampler(slice_len=length, traj_key=traj_key, terminated_key=terminated_key)
    if sampling == "episodes":
        return EpisodeSliceSampler(
            slice_len=length, lookahead=lookahead, traj_key=traj_key, terminated_key=terminated_key
        )
    if sampling == "episode_starts":
        return EpisodeStartSampler(slice_len=length, traj_key=traj_key, done_key=done_key)
    if sampling == "whole_episodes":
        return WholeEpisodeSampler(slice_len=length, traj_key=traj_key, terminated_key=terminated_key)
    raise ValueError(
        f"sampling must be 'steps', 'episodes', 'episode_starts' or 'whole_episodes', got {sampling!r}; the paper "
        "has 'episodes'."
    )


def sample_sequences(buffer: TensorDictReplayBuffer) -> TensorDictBase:
    """Draws sequences ``[batch_size, slice_len + lookahead]`` from a buffer of :func:`make_sequence_buffer`.

    Args:
        buffer: where to draw.

    Examples:
        >>> from tensordict import TensorDict
        >>> buffer = make_sequence_buffer(16, slice_len=4, batch_size=3, num_envs=2)
        >>> steps = {"observation": torch.zeros(2, 5, 7), "collector": {"traj_ids": torch.tensor([[0] * 5, [1] * 5])}}
        >>> _ = buffer.extend(TensorDict(steps, [2, 5]))
        >>> sample_sequences(buffer)["observation"].shape
        torch.Size([3, 4, 7])
    """
    return buffer.sample().reshape(-1, buffer.sampler.slice_len)
