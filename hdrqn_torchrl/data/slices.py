"""Where slices of a ring begin and end, as pure functions of tensors."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.devices import on_host


def episode_starts(init: Tensor, episode: Tensor, done: Tensor, newest: int, length: int) -> Tensor:
    """Which steps of a ring start an episode and are followed by ``length - 1`` steps without a gap.

    Args:
        init: first step of an episode, ``[rows, N]`` bool.
        episode: number of the episode, ``[rows, N]``.
        done: last step of an episode, ``[rows, N]`` bool.
        newest: row that was written last.
        length: steps of a slice.

    Returns:
        ``[rows, N]`` bool.

    Examples:
        >>> done = torch.tensor([[False], [True], [False], [False]])
        >>> init, episode = done.roll(1, 0), torch.tensor([[0], [0], [1], [1]])
        >>> episode_starts(init, episode, done, newest=3, length=2).flatten()
        tensor([False, False,  True, False])
    """
    age = (newest - torch.arange(len(init), device=init.device)) % len(init)
    starts = init & (age >= length - 1).unsqueeze(-1)
    # Where one episode follows another that has not ended, steps between them were lost.
    gap = ((episode != episode.roll(-1, 0)) | init.roll(-1, 0)) & ~done
    gap[newest] = False
    if length > 1 and (not on_host(gap) or gap.any()):
        starts &= ~_within(gap, newest, length - 1)
    return starts


def _within(mark: Tensor, newest: int, steps: int) -> Tensor:
    """Whether one of so many steps of a ring, from each on, is marked, ``[rows, N]``."""
    time = (torch.arange(len(mark), device=mark.device) - newest - 1).remainder(len(mark))  # 0: the oldest
    ahead = torch.where(mark, time.unsqueeze(-1), 2 * len(mark)).roll(-newest - 1, 0)
    following = ahead.flip(0).cummin(0).values.flip(0).roll(newest + 1, 0)
    return following < time.unsqueeze(-1) + steps


def steps_left(episode: Tensor, done: Tensor, newest: int) -> tuple[Tensor, Tensor]:
    """How far each step of a ring is from the last stored step of its episode.

    Args:
        episode: number of the episode, ``[rows, N]``.
        done: last step of an episode, ``[rows, N]`` bool.
        newest: row that was written last.

    Returns:
        Stored steps from each step on, itself included, and whether they end with their episode, ``[rows, N]``.

    Examples:
        >>> episode, done = torch.tensor([[7], [7], [7], [5], [7]]), torch.tensor([[0], [0], [0], [1], [0]]).bool()
        >>> left, ended = steps_left(episode, done, newest=2)
        >>> left.flatten().tolist(), ended.flatten().tolist()
        ([3, 2, 1, 1, 4], [False, False, False, True, False])
    """
    rows = len(episode)
    age = rows - 1 - newest
    episode, done = episode.roll(age, 0), done.roll(age, 0)  # oldest first
    time = torch.arange(rows, device=episode.device).unsqueeze(-1)
    is_last = episode != episode.roll(-1, 0)
    is_last[-1] = True
    last = torch.where(is_last, time, rows).flip(0).cummin(0).values.flip(0)
    return (last - time + 1).roll(-age, 0), done.gather(0, last).roll(-age, 0)


def steps_passed(episode: Tensor, newest: int) -> Tensor:
    """How many stored steps of its episode each step of a ring comes after.

    Args:
        episode: number of the episode, ``[rows, N]``.
        newest: row that was written last.

    Returns:
        ``[rows, N]``.

    Examples:
        >>> steps_passed(torch.tensor([[7], [7], [7], [5], [7]]), newest=2).flatten().tolist()
        [1, 2, 3, 0, 0]
    """
    rows = len(episode)
    age = rows - 1 - newest
    episode = episode.roll(age, 0)  # oldest first
    time = torch.arange(rows, device=episode.device).unsqueeze(-1)
    is_first = episode != episode.roll(1, 0)
    is_first[0] = True
    first = torch.where(is_first, time, 0).cummax(0).values
    return (time - first).roll(-age, 0)


def padded_slices(
    start: Tensor, left: Tensor, length: int, *, rows: int
) -> tuple[tuple[Tensor, ...], dict[NestedKey, Any]]:
    """Slices of a ring that repeat their last real step where they end early.

    Args:
        start: place of each slice's first step: time, then environment if there are several, ``[B, ndim]``.
        left: real steps from there on, ``[B]``.
        length: steps of a slice.
        rows: times that the ring holds.

    Returns:
        Indices ``[B * length]``, one tensor per dimension, and which of them are real, under
        ``("collector", "mask")``.

    Examples:
        >>> (time,), info = padded_slices(torch.tensor([[4], [0]]), torch.tensor([3, 2]), 3, rows=6)
        >>> time.tolist(), info["collector", "mask"].tolist()
        ([4, 5, 0, 0, 1, 1], [True, True, True, True, True, False])
    """
    offset = torch.arange(length, device=start.device)
    mask = offset < left.unsqueeze(-1)  # [B, T]
    time = start[:, :1] + torch.minimum(offset, left.unsqueeze(-1) - 1)
    index = [(time % rows).flatten()]
    index += [place.repeat_interleave(length) for place in start[:, 1:].unbind(-1)]
    return tuple(index), {keys.PAD_MASK: mask.flatten()}
