"""From what a Gymnasium environment shows to the one tensor that an agent sees.

There are four kinds: a window of cell codes ``[V, V]``, an image ``[C, H, W]``, a vector ``[D]`` of floats, and a
vector of codes ``[D]`` with a number of codes for each entry.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.gym.codes import as_codes, code_of, codes_of, codes_of_box, codes_of_words
from hdrqn_torchrl.envs.gym.encoder import Encoder
from hdrqn_torchrl.envs.gym.given import check_list, check_whole_number
from hdrqn_torchrl.envs.gym.returned import array_of, check_whole, part_of
from hdrqn_torchrl.envs.observations import LARGEST_FLOAT, MOST_COLOURS

Channels = Literal["first", "last"]
_MOST_FLOATS = 1_000_000


def make_encoder(
    space: spaces.Space,
    *,
    entries: Sequence[str] | None = None,
    channels: Channels | None = None,
    codes: int | Sequence[int] | None = None,
    words: Sequence[str] | None = None,
    text_length: int = 16,
    name: str = keys.OBSERVATION,
) -> Encoder:
    """Chooses how observations of a space become one tensor.

    - ``Discrete``, ``MultiDiscrete`` and ``MultiBinary`` are codes.
    - A ``Box`` of bytes with three dimensions (or of floats of about 1) is an image. With two dimensions it is an image
      of one channel. Any other ``Box`` is a vector of floats.
    - With ``codes``, a ``Box`` of integers holds codes: a square ``[V, V]`` is a window of cells, anything else becomes
      a vector of codes.
    - A ``Text`` is a sequence of codes, one for each word.
    - A ``Dict`` or ``Tuple`` whose parts are all codes becomes one vector of codes; otherwise one vector of floats, in
      which a code has as many entries as there are codes. An image may only stand alone.

    Args:
        space: of the environment's observations.
        entries: of a ``Dict``, those that the agent sees, in this order; ``None``: all of them.
        channels: whether images have their channels ``"first"`` or ``"last"``; ``None``: at the end that is at most 4.
        codes: number of codes of a ``Box`` of integers; a list has one number for each plane, the last dimension.
        words: of texts, numbered from 1; others are 0. ``None``: words are numbered by a checksum below 255.
        text_length: number of words of a text that are seen.
        name: of the observation in errors.

    Raises:
        ValueError: if there is no such entry, the space is none of these, or an image's shape does not tell where its
            channels are.

    Examples:
        >>> make_encoder(spaces.Box(0, 255, (210, 160, 3), np.uint8)).space.shape
        (3, 210, 160)
        >>> make_encoder(spaces.Box(0, 255, (7, 7, 3), np.uint8), codes=(11, 6, 3)).space.nvec[:4]
        array([11,  6,  3, 11], dtype=uint8)
        >>> make_encoder(spaces.Text(20), words=("go", "left"), text_length=3).encode("go far left")
        array([1, 0, 2], dtype=uint8)
    """
    check_whole_number("text_length", text_length, remedy="16 words are usual")
    check_list("words", words, str, "words")
    check_list("entries", entries, str, "names of entries")
    if channels not in (None, "first", "last"):
        raise ValueError(f"channels must be 'first', 'last' or None, got {channels!r}.")
    parts: list[tuple[Any, spaces.Space]]
    if isinstance(space, spaces.Dict):
        chosen = list(space) if entries is None else list(entries)
        unknown = [each for each in chosen if each not in space.spaces]
        if unknown or not chosen:
            raise ValueError(f"entries must be some of {list(space)}, got {entries}; None means all of them.")
        parts = [(each, space[each]) for each in chosen]
    elif entries is not None:
        raise ValueError(f"entries must be None for observations that are no Dict, got {list(entries)}.")
    elif isinstance(space, spaces.Tuple):
        parts = list(enumerate(space.spaces))
    else:
        _check_used(space, channels, codes, name)
        return _encoder_of(space, channels, codes, words, text_length, name)
    make = partial(make_encoder, channels=channels, codes=codes, words=words, text_length=text_length)
    return _joined({key: make(part, name=f"{name}[{key!r}]") for key, part in parts}, name)


def _check_used(space: spaces.Space, channels: Channels | None, codes: object, name: str) -> None:
    """Refuses options that a single observation does not use."""
    if name != keys.OBSERVATION:  # one of several, of which others may use them
        return
    if codes is not None and not (isinstance(space, spaces.Box) and space.dtype.kind in "iu"):
        raise ValueError(f"codes must be None for observations that are no Box of integers, got {codes} for {space}.")
    if channels is not None and not (isinstance(space, spaces.Box) and len(space.shape) == 3):
        raise ValueError(f"channels must be None for observations that are no image, got {channels!r} for {space}.")


def _encoder_of(
    space: spaces.Space,
    channels: Channels | None,
    codes: int | Sequence[int] | None,
    words: Sequence[str] | None,
    text_length: int,
    name: str,
) -> Encoder:
    """Of a space that is not made of others."""
    if isinstance(space, spaces.Discrete):
        return code_of(int(space.n), int(space.start), name)
    if isinstance(space, spaces.MultiDiscrete):
        return codes_of(np.array(space.nvec), np.asarray(space.start), name)
    if isinstance(space, spaces.MultiBinary):
        return codes_of(np.full(space.shape, 2), np.zeros(space.shape, np.int64), name)
    kind = space.dtype.kind if isinstance(space, spaces.Space) and space.dtype is not None else None
    if isinstance(space, spaces.Text) or kind == "U":  # MiniGrid's missions
        return codes_of_words(words, text_length, name)
    if isinstance(space, spaces.Box):
        if codes is None or space.dtype.kind not in "iu":
            return _box(space, channels, name)
        return codes_of_box(space, codes, name)
    raise ValueError(
        f"observation space must be a Box, Discrete, MultiDiscrete, MultiBinary, Text, Dict or Tuple, got {space}; "
        "turn it into one of them with a wrapper (gymnasium.wrappers.TransformObservation)."
    )


def _box(space: spaces.Box, channels: Channels | None, name: str) -> Encoder:
    if not np.prod(space.shape):
        raise ValueError(f"{name} must have at least one entry, got {space}; leave it out (entries=[...]).")
    shape, is_byte = space.shape, space.dtype == np.uint8
    about_one = bool(np.isfinite(space.high).all() and space.high.max() <= LARGEST_FLOAT)
    if len(shape) == 2 and is_byte:
        return _image((1, *shape), np.dtype(np.uint8), lambda value: _pixels(value, shape, name)[None])
    if len(shape) == 3 and (is_byte or (np.issubdtype(space.dtype, np.floating) and about_one)):
        dtype = np.dtype(np.uint8) if is_byte else np.dtype(np.float32)
        read = partial(_pixels if is_byte else array_of, shape=shape, name=name)
        if (channels or _place_of_channels(shape)) == "last":
            order = (shape[2], *shape[:2])
            return _image(order, dtype, lambda value: np.ascontiguousarray(np.moveaxis(read(value), -1, 0)))
        return _image(shape, dtype, read)
    size = int(np.prod(shape))
    low, high = (bound.reshape(size).astype(np.float32) for bound in (space.low, space.high))
    return Encoder(
        encode=lambda value: array_of(value, shape, name).astype(np.float32, copy=False).reshape(size),
        space=spaces.Box(low, high, dtype=np.float32),
    )


def _pixels(value: Any, shape: tuple[int, ...], name: str) -> NDArray:
    """An image of bytes: bytes, or whole numbers that fit into them."""
    array = array_of(value, shape, name)
    if array.dtype != np.uint8:
        check_whole(array, 0, 255, name)
    return array


def _place_of_channels(shape: Sequence[int]) -> Channels:
    first, last = (shape[end] <= MOST_COLOURS for end in (0, -1))
    if first == last:
        raise ValueError(
            f"channels must be 'first' or 'last' for images of shape {list(shape)}, which does not tell where its "
            "channels are, got None."
        )
    return "first" if first else "last"


def _image(shape: tuple[int, ...], dtype: np.dtype, encode: Callable[[Any], NDArray]) -> Encoder:
    high = 255 if dtype == np.uint8 else LARGEST_FLOAT
    low = 0 if dtype == np.uint8 else -LARGEST_FLOAT
    return Encoder(
        encode=lambda value: encode(value).astype(dtype, copy=False), space=spaces.Box(low, high, shape, dtype.type)
    )


def _joined(encoders: dict[Any, Encoder], where: str) -> Encoder:
    """One vector of several parts, or the only part as it is."""
    parts = list(encoders.items())
    if len(parts) == 1:
        ((name, only),) = parts
        return Encoder(
            encode=lambda value: only.encode(part_of(value, name, where)), space=only.space, parts=only.parts
        )
    images = [name for name, each in parts if each.is_image]
    if images:
        raise ValueError(
            f"entries must not mix an image with others, got {[name for name, _ in parts]} with the image {images[0]!r}"
            f"; make one vector of all numbers (wrappers=[gymnasium.wrappers.FlattenObservation]), choose some "
            f"(entries=[{images[0]}]), or give their numbers of codes (codes=...) if they hold codes."
        )
    if all(isinstance(each.space, spaces.MultiDiscrete) for _, each in parts):
        numbers = np.concatenate([np.asarray(each.space.nvec).reshape(-1) for _, each in parts])  # type: ignore[union-attr]
        return replace(as_codes(numbers, partial(_concatenated, parts, where), where), parts=_sizes(parts, where))
    floats = [(name, _as_floats(each)) for name, each in parts]
    low, high = (np.concatenate([getattr(each.space, end) for _, each in floats]) for end in ("low", "high"))
    return Encoder(
        encode=partial(_concatenated, floats, where),
        space=spaces.Box(low, high, dtype=np.float32),
        parts=_sizes(floats, where),
    )


def _sizes(parts: Sequence[tuple[Any, Encoder]], where: str) -> tuple[tuple[str, int], ...]:
    return tuple((f"{where}[{name!r}]", math.prod(each.space.shape)) for name, each in parts)


def _concatenated(parts: Sequence[tuple[Any, Encoder]], where: str, value: Any) -> NDArray:
    return np.concatenate([each.encode(part_of(value, name, where)).reshape(-1) for name, each in parts])


def _as_floats(encoder: Encoder) -> Encoder:
    """Codes as ones and zeros."""
    if isinstance(encoder.space, spaces.Box):
        return encoder
    numbers = np.asarray(encoder.space.nvec).reshape(-1)
    firsts, size = np.cumsum(numbers) - numbers, int(numbers.sum(dtype=np.int64))
    if size > _MOST_FLOATS:
        raise ValueError(
            f"observations must have at most {_MOST_FLOATS:,} codes beside numbers, each of which becomes an entry, "
            f"got {size:,}; leave some out (entries=[...])."
        )

    def encode(value: Any) -> NDArray:
        vector = np.zeros(size, np.float32)
        vector[firsts + encoder.encode(value).reshape(-1)] = 1.0
        return vector

    return Encoder(encode=encode, space=spaces.Box(0.0, 1.0, (size,), np.float32))
