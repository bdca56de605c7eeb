"""Replayed sequences as a loss needs them, whichever way their inputs are stored."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.utils import expand_as_right, unravel_key
from torch import Tensor

from hdrqn_torchrl.devices import on_host


class Sequences(NamedTuple):
    """T steps of B sequences, and the T + 1 inputs around them."""

    inputs: TensorDictBase
    """What the network reads, ``[B, T + 1]``."""
    seen: Tensor
    """Which inputs are not padding, ``[B, T + 1]`` bool."""
    steps: TensorDictBase
    """What was done and what it brought, ``[B, T]``."""
    valid: Tensor
    """Which steps are not padding, ``[B, T]`` bool."""
    init: Tensor
    """Before which steps the state restarts, ``[B, T]`` bool."""
    cut: Tensor
    """After which steps the next input is not what they led to, ``[B, T]`` bool; also where there is no next step."""
    lookahead: int
    """How many steps at the end are there for the targets of others only."""


def take_apart(
    tensordict: TensorDictBase,
    valid: Tensor,
    *,
    read_keys: Sequence[NestedKey],
    state_keys: Sequence[NestedKey],
    init_key: NestedKey,
    done_key: NestedKey,
    lookahead: int,
    stored_once: bool,
) -> Sequences:
    """Takes apart replayed sequences.

    Args:
        tensordict: the sequences. If ``stored_once``, ``[B, T + 1]``, with inputs at the root only; otherwise standard
            ones, ``[B, T]``: what followed the last valid step stands under its ``"next"``.
        valid: which of their steps are not padding, bool.
        read_keys: inputs; those that are numbers are cleared in padding.
        state_keys: recurrent states, zero where ``init_key`` is set and in padding.
        init_key: where the state restarts.
        done_key: under ``"next"``, where a segment ends.
        lookahead: steps at the end that are not trained; if ``stored_once``, the last one is among them.
        stored_once: the form.
    """
    init, done = _flag(tensordict, init_key) & valid, _flag(tensordict["next"], done_key)
    read = {key: tensordict[key] for key in read_keys}
    states = {key: _clear(tensordict[key], init | ~valid) for key in state_keys}
    if stored_once:
        inputs = _inputs(read, {**states, init_key: init.unsqueeze(-1)}, valid, tensordict.device)
        cut = done[:, :-1] | ~valid[:, 1:] | init[:, 1:]
        return Sequences(inputs, valid, tensordict[:, :-1], valid[:, :-1], init[:, :-1], cut, lookahead - 1)
    seen = torch.cat([valid[:, :1], valid], 1)
    read = {key: _joined(now, tensordict[unravel_key(("next", key))], valid) for key, now in read.items()}
    states = {key: _with_nothing(state) for key, state in states.items()}
    kept = {**states, init_key: _with_nothing(init).unsqueeze(-1)}
    inputs = _inputs(read, kept, seen, tensordict.device)
    return Sequences(inputs, seen, tensordict, valid, init, done & ~last_real(valid), lookahead)


def _inputs(
    read: Mapping[NestedKey, Tensor],
    kept: Mapping[NestedKey, Tensor],
    seen: Tensor,
    device: torch.device | None,
) -> TensorDict:
    """Inputs ``read``, cleared in padding, and those that are ``kept`` as they are."""
    inputs, padding = TensorDict({}, seen.shape, device=device), _padding(seen)
    for key, stream in read.items():
        inputs.set(key, stream if padding is None or not stream.is_floating_point() else _clear(stream, padding))
    for key, value in kept.items():
        inputs.set(key, value)
    return inputs


def _joined(now: Tensor, following: Tensor, valid: Tensor) -> Tensor:
    """The T + 1 inputs of T steps; after the last valid one stands what followed it."""
    stream = torch.cat([now, following[:, -1:]], 1)
    if _padding(valid) is None:
        return stream
    return torch.where(expand_as_right(_with_nothing(valid), stream), stream, torch.cat([now[:, :1], following], 1))


def step_of(value: Tensor, tensordict: TensorDictBase) -> Tensor:
    """An entry with one number per step of a tensordict, without its trailing dimension."""
    return value if value.ndim == tensordict.ndim else value.squeeze(-1)


def last_real(valid: Tensor) -> Tensor:
    """The steps that padding or the end of the sequence follows, ``[B, T]`` bool, of ``valid`` ``[B, T]``.

    Examples:
        >>> last_real(torch.tensor([[True, True, False], [True, True, True]]))
        tensor([[False,  True, False],
                [False, False,  True]])
    """
    return valid & ~torch.cat([valid[:, 1:], torch.zeros_like(valid[:, :1])], 1)


def _flag(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    return step_of(tensordict[key], tensordict)


def _padding(valid: Tensor) -> Tensor | None:
    """The steps that are not valid; ``None`` if the host knows that there are none."""
    return None if on_host(valid) and bool(valid.all()) else ~valid


def _clear(value: Tensor, void: Tensor) -> Tensor:
    """Entries ``[B, T, ...]``, zero where they are ``void``."""
    return value.masked_fill(expand_as_right(void, value), 0.0)


def _with_nothing(value: Tensor) -> Tensor:
    """Entries ``[B, T, ...]`` with one more step at the end, where they are zero or false."""
    return torch.cat([value, torch.zeros_like(value[:, :1])], 1)
