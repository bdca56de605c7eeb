"""The kinds of observations that built-in networks read, told apart by their specs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, OneHot, TensorSpec

ObservationKind = Literal["cells", "codes", "image", "vector"]
ProblemOf = Callable[[TensorSpec, Sequence[int]], tuple[str, str] | None]
"""Takes an observation's spec and its shape without the batch dimensions; see :func:`observation_problem`."""

LARGEST_FLOAT = 10.0
"""Images in float32 with bounds above this are not taken to be scaled to about 1."""
MOST_COLOURS = 4
"""An end of an image's shape that is no larger is taken for its channels."""
_MOST_CODES = 1_000_000  # of all entries of a vector of bounded integers; it has as many rows of weights
READABLE = (
    "a square of cell codes [V, V] (Categorical, integers), other codes (a Bounded vector of integers from 0, "
    "Categorical or MultiCategorical), an image [channels, height, width] (uint8, or float32 of about 1) or a vector "
    "[D] (float32)"
)


def observation_kind(spec: TensorSpec, shape: Sequence[int]) -> ObservationKind | None:
    """What an observation is to the built-in networks.

    Args:
        spec: spec of the observation.
        shape: its shape without the batch dimensions.

    Returns:
        ``"cells"`` (a square of cell codes), ``"codes"`` (any other codes, each entry with its own number of them),
        ``"image"``, ``"vector"``; ``None``: none of these.

    Examples:
        >>> observation_kind(Categorical(5, shape=(8, 3, 3)), [3, 3])
        'cells'
        >>> observation_kind(Bounded(0, torch.tensor([4, 2]).expand(8, 2), shape=(8, 2), dtype=torch.uint8), [2])
        'codes'
        >>> observation_kind(Bounded(0, 255, shape=(8, 3, 44, 60), dtype=torch.uint8), [3, 44, 60])
        'image'
    """
    if isinstance(spec, Binary | OneHot):
        return "vector" if len(shape) == 1 else None
    if isinstance(spec, Categorical):
        if spec.dtype.is_floating_point or not math.prod(shape):
            return None
        is_square = len(shape) == 2 and shape[0] == shape[1]
        return "cells" if is_square and type(spec) is Categorical else "codes"
    if not math.prod(shape):
        return None
    if len(shape) == 1 and not spec.dtype.is_floating_point:
        return "codes" if isinstance(spec, Bounded) and _counts(spec) else None
    if len(shape) == 1:
        return "vector" if spec.dtype == torch.float32 else None
    return "image" if len(shape) == 3 and _is_image(spec, shape) else None


def observation_problem(spec: TensorSpec, shape: Sequence[int]) -> tuple[str, str] | None:
    """Why the built-in networks can't read an observation.

    Args:
        spec: spec of the observation.
        shape: its shape without the batch dimensions.

    Returns:
        What the observation must be and what to do about it; ``None`` if it can be read.
    """
    if observation_kind(spec, shape) is not None:
        return None
    own = "or use an Architecture with your own observation_features"
    return READABLE, f"{_remedy(spec, shape)}, {own}"


def code_sizes(spec: TensorSpec, shape: Sequence[int]) -> tuple[int, ...]:
    """How many codes each entry of an observation has, in the order of its flattened entries.

    Args:
        spec: a ``Categorical``, ``MultiCategorical`` or ``Bounded`` from 0.
        shape: its shape without the batch dimensions.

    Examples:
        >>> code_sizes(MultiCategorical([5, 3], shape=(8, 2)), [2]), code_sizes(Categorical(4, shape=(8, 3)), [3])
        ((5, 3), (4, 4, 4))
    """
    entries = math.prod(shape)
    if isinstance(spec, MultiCategorical):
        return tuple(spec.nvec.expand(spec.shape).reshape(-1, entries)[0].tolist())
    if isinstance(spec, Bounded):
        highest = spec.space.high.expand(spec.shape).reshape(-1, entries)[0].tolist()
        return tuple(int(each) + 1 for each in highest)  # numbers of Python, which don't overflow
    return (int(spec.space.n),) * entries


def _counts(spec: Bounded) -> bool:
    """Whether bounded integers ``[*, D]`` can be taken for codes."""
    if not bool((spec.space.low == 0).all()):
        return False
    return sum(code_sizes(spec, spec.shape[-1:])) <= _MOST_CODES


def _is_image(spec: TensorSpec, shape: Sequence[int]) -> bool:
    if _has_channels_last(shape):
        return False
    if spec.dtype == torch.float32:
        return not isinstance(spec, Bounded) or bool(spec.space.high.max() <= LARGEST_FLOAT)
    return spec.dtype == torch.uint8


def _has_channels_last(shape: Sequence[int]) -> bool:
    return shape[-1] <= MOST_COLOURS < min(shape[0], shape[1])


def _remedy(spec: TensorSpec, shape: Sequence[int]) -> str:
    """What to do about an observation that is of no kind."""
    if spec.dtype == torch.float64:
        return "cast it to float32, for instance with DoubleToFloat"
    if len(shape) == 3 and _has_channels_last(shape):
        return (
            "put the channels first, for instance with ToTensorImage or PermuteTransform (where they are first, "
            "exchange height and width)"
        )
    if len(shape) == 3 and spec.dtype == torch.float32:
        return "divide it by its largest value, for instance with ToTensorImage"
    if len(shape) == 2:
        return (
            "give an image a dimension for its channels with UnsqueezeTransform, make a vector of others by flattening"
        )
    if not spec.dtype.is_floating_point:
        return "cast it to float32 if it holds quantities; number codes from 0, with bounds for each entry (Bounded)"
    return "flatten it, or cast it to float32"
