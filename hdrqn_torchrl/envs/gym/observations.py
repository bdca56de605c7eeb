"""From what a Gymnasium environment shows to the one tensor that an agent sees.

There are four kinds: a window of cell codes ``[V, V]``, an image ``[C, H, W]``, a vector ``[D]`` of floats, and a
vector of codes ``[D]`` with a number of codes for each entry.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torchrl.data import Bounded, Categorical, TensorSpec, Unbounded

from hdrqn_torchrl.envs.observations import LARGEST_FLOAT, MOST_COLOURS

Channels = Literal["first", "last"]
_HASHED_WORDS = 255


@dataclass(frozen=True, kw_only=True)
class Encoder:
    """Makes one array of fixed shape of an observation.

    Attributes:
        encode: takes an observation of the environment.
        space: of what it returns: a ``Box`` (image or vector) or ``MultiDiscrete`` (codes).
    """

    encode: Callable[[Any], NDArray]
    space: spaces.Box | spaces.MultiDiscrete

    @property
    def is_image(self) -> bool:
        return isinstance(self.space, spaces.Box) and len(self.space.shape) == 3

    def spec(self, num_envs: int, *, device: torch.device | None = None) -> TensorSpec:
        """TorchRL's spec of a batch of what it returns."""
        space, shape = self.space, (num_envs, *self.space.shape)
        dtype = torch.from_numpy(np.empty(0, space.dtype)).dtype
        if isinstance(space, spaces.MultiDiscrete):
            if space.nvec.ndim == 2:  # a window: the same number for all cells
                return Categorical(int(space.nvec.max()), shape=shape, dtype=dtype, device=device)
            highest = torch.as_tensor(np.array(space.nvec), dtype=dtype, device=device) - 1
            return Bounded(torch.zeros_like(highest).expand(shape), highest.expand(shape), dtype=dtype, device=device)
        if not np.isfinite(space.low).all() or not np.isfinite(space.high).all():
            return Unbounded(shape=shape, dtype=dtype, device=device)
        low, high = (torch.as_tensor(bound, device=device).expand(shape) for bound in (space.low, space.high))
        return Bounded(low, high, shape=shape, dtype=dtype, device=device)


def make_encoder(
    space: spaces.Space,
    *,
    entries: Sequence[str] | None = None,
    channels: Channels | None = None,
    codes: int | Sequence[int] | None = None,
    words: Sequence[str] | None = None,
    text_length: int = 16,
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
    if text_length < 1:
        raise ValueError(f"text_length must be >= 1, got {text_length}; 16 words are usual.")
    if channels not in (None, "first", "last"):
        raise ValueError(f"channels must be 'first', 'last' or None, got {channels!r}.")
    parts: list[tuple[Any, spaces.Space]]
    if isinstance(space, spaces.Dict):
        names = list(space) if entries is None else list(entries)
        unknown = [name for name in names if name not in space.spaces]
        if unknown or not names:
            raise ValueError(f"entries must be some of {list(space)}, got {entries}; None means all of them.")
        parts = [(name, space[name]) for name in names]
    elif entries is not None:
        raise ValueError(f"entries must be None for observations that are no Dict, got {list(entries)}.")
    elif isinstance(space, spaces.Tuple):
        parts = list(enumerate(space.spaces))
    else:
        return _encoder_of(space, channels, codes, words, text_length)
    make = partial(make_encoder, channels=channels, codes=codes, words=words, text_length=text_length)
    return _joined({name: make(part) for name, part in parts})


def _encoder_of(
    space: spaces.Space,
    channels: Channels | None,
    codes: int | Sequence[int] | None,
    words: Sequence[str] | None,
    text_length: int,
) -> Encoder:
    """Of a space that is not made of others."""
    if isinstance(space, spaces.Discrete):
        start = int(space.start)
        return _codes(np.array([space.n]), lambda value: np.array([int(value) - start]))
    if isinstance(space, spaces.MultiDiscrete):
        starts = np.asarray(space.start)
        return _codes(np.array(space.nvec), lambda value: np.asarray(value) - starts)
    if isinstance(space, spaces.MultiBinary):
        return _codes(np.full(space.shape, 2), np.asarray)
    if isinstance(space, spaces.Text) or (space.dtype is not None and space.dtype.kind == "U"):  # MiniGrid's missions
        return _words(words, text_length)
    if isinstance(space, spaces.Box):
        return _box(space, channels) if codes is None or space.dtype.kind not in "iu" else _box_of_codes(space, codes)
    raise ValueError(
        f"observation space must be a Box, Discrete, MultiDiscrete, MultiBinary, Text, Dict or Tuple, got {space}; "
        "turn it into one of them with a wrapper (gymnasium.wrappers.TransformObservation)."
    )


def _codes(numbers: NDArray, encode: Callable[[Any], NDArray]) -> Encoder:
    """Codes with these numbers of them: a square window as it is, anything else as a vector."""
    square = numbers.ndim == 2 and numbers.shape[0] == numbers.shape[1] and len(np.unique(numbers)) == 1
    kept = numbers if square else numbers.reshape(-1)
    dtype: Any = np.uint8 if numbers.max() <= 255 else np.int32
    return Encoder(
        encode=lambda value: encode(value).astype(dtype, copy=False).reshape(kept.shape),
        space=spaces.MultiDiscrete(kept, dtype=dtype),
    )


def _words(words: Sequence[str] | None, length: int) -> Encoder:
    number = _HASHED_WORDS if words is None else len(words) + 1
    known = {word: index for index, word in enumerate(words or (), 1)}

    def code(word: str) -> int:
        return known.get(word, 0) if words is not None else 1 + zlib.crc32(word.encode()) % (number - 1)

    def encode(text: str) -> NDArray:
        found = [code(word) for word in text.lower().replace(",", " ").split()[:length]]
        return np.array(found + [0] * (length - len(found)))

    return _codes(np.full(length, number), encode)


def _box(space: spaces.Box, channels: Channels | None) -> Encoder:
    shape, is_byte = space.shape, space.dtype == np.uint8
    about_one = bool(np.isfinite(space.high).all() and space.high.max() <= LARGEST_FLOAT)
    if len(shape) == 2 and is_byte:
        return _image((1, *shape), np.dtype(np.uint8), lambda value: np.asarray(value)[None])
    if len(shape) == 3 and (is_byte or (np.issubdtype(space.dtype, np.floating) and about_one)):
        dtype = np.dtype(np.uint8) if is_byte else np.dtype(np.float32)
        if (channels or _place_of_channels(shape)) == "last":
            order = (shape[2], *shape[:2])
            return _image(order, dtype, lambda value: np.ascontiguousarray(np.moveaxis(np.asarray(value), -1, 0)))
        return _image(shape, dtype, np.asarray)
    size = int(np.prod(shape))
    low, high = (bound.reshape(size).astype(np.float32) for bound in (space.low, space.high))
    return Encoder(
        encode=lambda value: np.asarray(value, np.float32).reshape(size), space=spaces.Box(low, high, dtype=np.float32)
    )


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


def _box_of_codes(space: spaces.Box, codes: int | Sequence[int]) -> Encoder:
    numbers = np.asarray(codes, np.int64)
    planes = space.shape[-1] if space.shape else 1
    if (numbers < 1).any() or numbers.ndim > 1 or (numbers.ndim and len(numbers) != planes):
        raise ValueError(
            f"codes must be one number >= 1, or one for each of {planes} planes of {list(space.shape)}, got {codes}."
        )
    return _codes(np.broadcast_to(numbers, space.shape or (1,)), np.asarray)


def _joined(encoders: dict[Any, Encoder]) -> Encoder:
    """One vector of several parts, or the only part as it is."""
    parts = list(encoders.items())
    if len(parts) == 1:
        ((name, only),) = parts
        return Encoder(encode=lambda value: only.encode(value[name]), space=only.space)
    images = [name for name, each in parts if each.is_image]
    if images:
        raise ValueError(
            f"entries must not mix an image with others, got {[name for name, _ in parts]} with the image {images[0]!r}"
            f"; choose some (entries=[{images[0]}]), or give their numbers of codes (codes=...) if they hold codes."
        )
    if all(isinstance(each.space, spaces.MultiDiscrete) for _, each in parts):
        numbers = np.concatenate([np.asarray(each.space.nvec).reshape(-1) for _, each in parts])  # type: ignore[union-attr]
        return _codes(
            numbers, lambda value: np.concatenate([each.encode(value[name]).reshape(-1) for name, each in parts])
        )
    floats = {name: _as_floats(each) for name, each in parts}
    low, high = (np.concatenate([getattr(each.space, end) for each in floats.values()]) for end in ("low", "high"))
    return Encoder(
        encode=lambda value: np.concatenate([each.encode(value[name]) for name, each in floats.items()]),
        space=spaces.Box(low, high, dtype=np.float32),
    )


def _as_floats(encoder: Encoder) -> Encoder:
    """Codes as ones and zeros."""
    if isinstance(encoder.space, spaces.Box):
        return encoder
    numbers = np.asarray(encoder.space.nvec).reshape(-1)
    firsts, size = np.cumsum(numbers) - numbers, int(numbers.sum())

    def encode(value: Any) -> NDArray:
        vector = np.zeros(size, np.float32)
        vector[firsts + encoder.encode(value).reshape(-1)] = 1.0
        return vector

    return Encoder(encode=encode, space=spaces.Box(0.0, 1.0, (size,), np.float32))
