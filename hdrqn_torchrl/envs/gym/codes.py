"""Observations that are codes: of what space, from what number on, and how many of them there are."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from hdrqn_torchrl.envs.gym.encoder import Encoder
from hdrqn_torchrl.envs.gym.returned import array_of, check_whole, text_of

_HASHED_WORDS = 255
_MOST = 2**31 - 1


def as_codes(numbers: NDArray, encode: Callable[[Any], NDArray], name: str) -> Encoder:
    """Codes with these numbers of them: a square window as it is, anything else as a vector."""
    if not numbers.size or numbers.max() > _MOST:
        raise ValueError(
            f"{name} must have codes below 2**31 and at least one entry, got {numbers.tolist()} as numbers of codes; "
            "turn it into numbers with a wrapper (gymnasium.wrappers.TransformObservation), or leave it out."
        )
    square = numbers.ndim == 2 and numbers.shape[0] == numbers.shape[1] and len(np.unique(numbers)) == 1
    kept = numbers if square else numbers.reshape(-1)
    dtype: Any = np.uint8 if numbers.max() <= 255 else np.int32
    return Encoder(
        encode=lambda value: encode(value).astype(dtype, copy=False).reshape(kept.shape),
        space=spaces.MultiDiscrete(kept, dtype=dtype),
    )


def code_of(number: int, start: int, name: str) -> Encoder:
    """A single code, checked as a number of Python's, which takes the least time."""
    last = start + number - 1

    def encode(value: Any) -> NDArray:
        if type(value) is not int:
            value = np.asarray(value)
            value = array_of(value.reshape(()) if value.size == 1 else value, (), name).item()
        if not start <= value <= last or value % 1:
            check_whole(np.asarray(value), start, last, name)
        return np.array([int(value) - start])

    return as_codes(np.array([number]), encode, name)


def codes_of(numbers: NDArray, starts: NDArray, name: str) -> Encoder:
    """Codes of an array, each from its start on."""
    moved, lasts = bool(starts.any()), starts + numbers - 1
    if lasts.size and starts.min() >= 0 and lasts.max() <= 255:  # comparing bytes with bytes takes less time
        lasts = lasts.astype(np.uint8)

    def encode(value: Any) -> NDArray:
        array = array_of(value, lasts.shape, name)
        check_whole(array, starts, lasts, name)
        return array - starts if moved else array

    return as_codes(numbers, encode, name)


def codes_of_words(words: Sequence[str] | None, length: int, name: str) -> Encoder:
    """Words of a text as codes."""
    number = _HASHED_WORDS if words is None else len(words) + 1
    known = {word: index for index, word in enumerate(words or (), 1)}

    def code(word: str) -> int:
        return known.get(word, 0) if words is not None else 1 + zlib.crc32(word.encode()) % (number - 1)

    def encode(text: str) -> NDArray:
        found = [code(word) for word in text_of(text, name).lower().replace(",", " ").split()[:length]]
        return np.array(found + [0] * (length - len(found)))

    return as_codes(np.full(length, number), encode, name)


def codes_of_box(space: spaces.Box, codes: int | Sequence[int], name: str) -> Encoder:
    """Integers of a ``Box`` as codes."""
    numbers = np.asarray(codes, np.int64)
    planes = space.shape[-1] if space.shape else 1
    if (numbers < 1).any() or numbers.ndim > 1 or (numbers.ndim and len(numbers) != planes):
        raise ValueError(
            f"codes must be one number >= 1, or one for each of {planes} planes of {list(space.shape)}, got {codes}."
        )
    numbers = np.broadcast_to(numbers, space.shape)
    return codes_of(numbers, np.zeros(space.shape, np.int64), name)
