"""What an environment returns, checked in every step: cheaply, before anything is learned from it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from traceback import extract_tb
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from hdrqn_torchrl.envs.findings import ReturnError

Flags = NDArray[np.bool_]
_LONGEST = 100  # characters of a value that an error shows
_READERS = (str(Path(gymnasium.__file__).parent / "wrappers"), str(Path(gymnasium.__file__).parent / "utils"))
_RETURNED = {"reset": "(observation, info)", "step": "(observation, reward, terminated, truncated, info)"}
_NUMERIC = "?" + np.typecodes["AllInteger"] + np.typecodes["Float"]
_TRUTHS = (bool, np.bool_)
_NUMBERS = {"reset": 2, "step": 5}


def shown(value: Any) -> str:
    """A value in an error: the shape of an array of many numbers, and no more than a line of anything else."""
    if isinstance(value, np.ndarray) and value.size > 1:
        return f"{value.dtype} {list(value.shape)}"
    text = " ".join(repr(value).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


def array_of(value: Any, shape: tuple[int, ...], name: str) -> NDArray:
    """An array of numbers of this shape.

    Raises:
        ReturnError: if the value is none.
    """
    try:
        array = np.asarray(value)
    except (ValueError, TypeError) as error:  # lists of different lengths
        raise _wrong_shape(value, shape, name) from error
    if array.shape != shape or array.dtype.char not in _NUMERIC:
        raise _wrong_shape(value, shape, name)
    return array


def _wrong_shape(value: Any, shape: tuple[int, ...], name: str) -> ReturnError:
    return ReturnError(
        f"{name} must be numbers of the shape {list(shape)} as its space says, got {shown(value)}; correct what the "
        "environment returns, or its observation space."
    )


def check_whole(array: NDArray, low: Any, high: Any, name: str) -> None:
    """Refuses numbers that are not whole, or outside of ``low`` to ``high`` (numbers, or one for each entry).

    Raises:
        ReturnError: naming the first of them.
    """
    kind = array.dtype.kind
    if kind == "f" and (outside := array % 1 != 0).any():  # not a number, either
        raise _outside(array, outside, low, high, name)
    if np.count_nonzero(array > high):
        raise _outside(array, array > high, low, high, name)
    if kind in "if" and np.count_nonzero(array < low):
        raise _outside(array, array < low, low, high, name)


def _outside(array: NDArray, outside: NDArray, low: Any, high: Any, name: str) -> ReturnError:
    place = tuple(int(each) for each in np.argwhere(outside)[0])
    least, most = (np.broadcast_to(bound, array.shape)[place] for bound in (low, high))
    entry = f"{name}[{', '.join(map(str, place))}]" if place else name
    return ReturnError(
        f"{entry} must be a whole number from {least} to {most}, got {array[place]}; correct what the environment "
        "returns, its observation space, or the numbers of codes (codes=...)."
    )


def part_of(value: Any, key: Any, name: str) -> Any:
    """An entry of a ``Dict``'s or ``Tuple``'s observation.

    Raises:
        ReturnError: if there is none.
    """
    try:
        return value[key]
    except (KeyError, IndexError, TypeError) as error:
        there = f"the entries {list(value)}" if isinstance(value, Mapping) else shown(value)
        raise ReturnError(f"{name} must have the entry {key!r} as its space says, got {there}.") from error


def text_of(value: Any, name: str) -> str:
    """A text.

    Raises:
        ReturnError: if the value is none.
    """
    if not isinstance(value, str):
        raise ReturnError(f"{name} must be a text (str), got {shown(value)}; correct what the environment returns.")
    return value


def number_of(value: Any, name: str) -> float:
    """A finite number; arrays of one number count.

    Raises:
        ReturnError: if the value is none.
    """
    if type(value) is float and math.isfinite(value):  # what it nearly always is
        return value
    if not isinstance(value, Real) and np.size(value) == 1 and hasattr(value, "item"):
        value = value.item()
    if not isinstance(value, Real | np.bool_) or not math.isfinite(value):
        raise ReturnError(f"{name} must be a finite number, got {shown(value)}; correct what returns it.")
    return float(value)


def truth_of(value: Any, name: str) -> bool:
    """A truth value: ``True``, ``False``, 1 or 0; arrays of one of them count.

    Raises:
        ReturnError: if the value is none.
    """
    if value.__class__ in _TRUTHS:
        return bool(value)
    if np.size(value) == 1 and hasattr(value, "item"):
        value = value.item()
    if not isinstance(value, Real) or value not in (0, 1):
        raise ReturnError(f"{name} must be True or False (or 1 or 0), got {shown(value)}; correct what returns it.")
    return bool(value)


def truths_of(values: Any, size: int, name: str) -> Flags:
    """That many truth values.

    Raises:
        ReturnError: if they are others, or more or fewer.
    """
    found = np.asarray(values) if isinstance(values, Sequence | np.ndarray) else np.empty(0)
    if found.shape != (size,):
        raise ReturnError(f"{name} must be {size} truth values, got {shown(values)}; correct what returns them.")
    if found.dtype == np.bool_:
        return found.astype(np.bool_, copy=False)
    return np.fromiter((truth_of(each, name) for each in values), np.bool_, size)


def info_of(info: Any, method: str) -> Mapping[str, Any]:
    """What a method of an environment returned as its info.

    Raises:
        ReturnError: if it is no dictionary.
    """
    if type(info) is not dict and not isinstance(info, Mapping):
        raise ReturnError(f"{method} must return {_RETURNED[method]} with a dictionary as info, got {shown(info)}.")
    return info


def parts_of(returned: Any, method: str) -> tuple:
    """What a method of an environment returned, as many values as Gymnasium's rules say.

    Raises:
        ReturnError: if they are more or fewer.
    """
    if not isinstance(returned, tuple) or len(returned) != _NUMBERS[method]:
        raise ReturnError(f"{method} must return {_RETURNED[method]}, got {shown(returned)}.")
    return returned


def check_readable(error: Exception, method: str) -> None:
    """Says what a method must return if Gymnasium's wrappers could not read it; errors of its own code are left alone.

    Raises:
        ReturnError: if an error is one of these wrappers.
    """
    *_, last = extract_tb(error.__traceback__)
    if isinstance(error, ReturnError) or not last.filename.startswith(_READERS):
        return
    raise ReturnError(f"{method} must return {_RETURNED[method]} as the environment's spaces say: {error}") from error


def begun(env: gymnasium.Env, *, seed: int | None, options: dict[str, Any] | None = None) -> tuple[Any, Mapping]:
    """What an environment's ``reset`` returns: an observation and info.

    Raises:
        ReturnError: if it returns something else.
    """
    try:
        returned = env.reset(seed=seed, options=options)
    except (ValueError, TypeError, AssertionError) as error:
        check_readable(error, "reset")
        raise
    observation, info = parts_of(returned, "reset")
    return observation, info_of(info, "reset")
