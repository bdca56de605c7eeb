"""Replayed sequences as a loss needs them, whichever way their inputs are stored."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.utils import unravel_key
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


def stored_once(
    tensordict: TensorDictBase,
    valid: Tensor,
    *,
    read_keys: Sequence[NestedKey],
    state_keys: Sequence[NestedKey],
    init_key: NestedKey,
    done_key: NestedKey,
    lookahead: int,
) -> Sequences:
    """Takes apart sequences ``[B, T + 1]`` that hold their inputs at the root only.

    Args:
        tensordict: the sequences.
        valid: which of their steps are not padding, ``[B, T + 1]`` bool.
        read_keys: inputs; those that are numbers are cleared in padding.
        state_keys: recurrent states, zero where ``init_key`` is set and in padding.
        init_key: where the state restarts.
        done_key: under ``"next"``, where a segment ends.
        lookahead: steps at the end that are not trained, the last one included.
    """
    init, done = _flag(tensordict, init_key) & valid, _flag(tensordict["next"], done_key)
    inputs = TensorDict({}, tensordict.batch_size, device=tensordict.device)
    padding = _padding(valid)
    for key in read_keys:
        stream = tensordict[key]
        if padding is not None and stream.is_floating_point():
            stream = stream.masked_fill(_expand(padding, stream), 0.0)
        inputs.set(key, stream)
    for key in state_keys:
        inputs.set(key, _first_states(tensordict[key], init | ~valid))
    inputs.set(init_key, init.unsqueeze(-1))
    cut = (done | last_real(valid))[:, :-1] | init[:, 1:]
    return Sequences(inputs, valid, tensordict[:, :-1], valid[:, :-1], init[:, :-1], cut, lookahead - 1)


def stored_twice(
    tensordict: TensorDictBase,
    valid: Tensor,
    *,
    read_keys: Sequence[NestedKey],
    state_keys: Sequence[NestedKey],
    init_key: NestedKey,
    done_key: NestedKey,
    lookahead: int,
) -> Sequences:
    """Takes apart standard sequences ``[B, T]``: what followed the last valid step stands under its ``"next"``.

    Args:
        tensordict: the sequences.
        valid: which of their steps are not padding, ``[B, T]`` bool.
        read_keys, state_keys, init_key, done_key: as in :func:`stored_once`.
        lookahead: steps at the end that are not trained.
    """
    init, done = _flag(tensordict, init_key) & valid, _flag(tensordict["next"], done_key)
    own, reached = _with_nothing(valid, at="end"), _with_nothing(valid, at="start")  # seen at, or after, a valid step
    inputs = TensorDict({}, (tensordict.shape[0], tensordict.shape[1] + 1), device=tensordict.device)
    padding = _padding(own | reached)
    for key in read_keys:
        now, following = tensordict[key], tensordict[unravel_key(("next", key))]
        stream = torch.cat([now, following[:, -1:]], 1)
        if padding is not None:
            stream = torch.where(_expand(own, stream), stream, torch.cat([now[:, :1], following], 1))
            if stream.is_floating_point():
                stream = stream.masked_fill(_expand(padding, stream), 0.0)
        inputs.set(key, stream)
    for key in state_keys:
        state = _first_states(tensordict[key], init | ~valid)
        inputs.set(key, torch.cat([state, torch.zeros_like(state[:, :1])], 1))
    inputs.set(init_key, _with_nothing(init, at="end").unsqueeze(-1))
    seen = torch.cat([valid[:, :1], valid], 1)
    return Sequences(inputs, seen, tensordict, valid, init, done & ~last_real(valid), lookahead)


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


def _first_states(state: Tensor, void: Tensor) -> Tensor:
    """Stored states ``[B, T, ...]``, zero where they are ``void``."""
    return state.masked_fill(_expand(void, state), 0.0)


def _with_nothing(mask: Tensor, *, at: Literal["start", "end"]) -> Tensor:
    """A mask ``[B, T]`` with one more step, where it is false."""
    nothing = torch.zeros_like(mask[:, :1])
    return torch.cat([nothing, mask] if at == "start" else [mask, nothing], 1)


def _expand(mask: Tensor, like: Tensor) -> Tensor:
    return mask.view(mask.shape + (1,) * (like.ndim - mask.ndim))
