"""Checks of the sizes that networks are built from."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral, Real


def check_size(name: str, size: int, usual: int | str, *, least: int = 1, most: int | None = None) -> None:
    """Refuses a size that is too small, too large or not a whole number.

    Args:
        name: name of the argument, for the message.
        size: its value.
        usual: a value that works, for the message.
        least: the smallest valid size.
        most: the largest, if there is one.

    Raises:
        ValueError: if the size is not valid.

    Examples:
        >>> check_size("hidden_size", 0, 64)
        Traceback (most recent call last):
        ...
        ValueError: hidden_size must be >= 1, got 0; use 64.
    """
    if not isinstance(size, Integral) or isinstance(size, bool):
        raise ValueError(f"{name} must be a whole number >= {least}, got {size!r}; use {usual}.")
    if size < least:
        raise ValueError(f"{name} must be >= {least}, got {size}; use {usual}.")
    if most is not None and size > most:
        raise ValueError(f"{name} must be <= {most:,}, got {size}; use {usual}.")


def check_number(name: str, value: float, usual: float | str) -> None:
    """Refuses what is no number, such as text that holds one.

    Args:
        name: name of the argument, for the message.
        value: its value.
        usual: a value that works, for the message.

    Raises:
        ValueError: if it is none.
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        raise ValueError(f"{name} must be a number, got {value!r}; use {usual}.")


def check_memory_span(steps: int) -> None:
    """Checks the steps that a new memory keeps things for (:func:`~hdrqn_torchrl.modules.lstm.remember_for`).

    Raises:
        ValueError: if they are neither 0 nor a whole number of at least 3.
    """
    usual = "the steps between a hint and its use, or 0 for PyTorch's own biases"
    check_size("memory_span", steps, usual, least=0 if steps == 0 else 3)


def check_widths(widths: Sequence[int], name: str = "widths") -> tuple[int, ...]:
    """Checks the sizes of several layers, and returns them as a tuple.

    Raises:
        ValueError: if the list is empty, or :func:`check_size` refuses one of them.
    """
    sizes = tuple(widths) if isinstance(widths, Sequence) and not isinstance(widths, str) else ()
    if not sizes:
        raise ValueError(f"{name} must be a list of at least one size, got {widths!r}; use [128].")
    for place, size in enumerate(sizes):
        check_size(f"{name}[{place}]", size, 128)
    return sizes


def check_sides(size: int | tuple[int, int], usual: int | str) -> tuple[int, int]:
    """Checks the side of a square, or height and width of an image, and returns height and width.

    Raises:
        ValueError: if it is neither, or :func:`check_size` refuses one of them.
    """
    if not isinstance(size, Sequence) or isinstance(size, str):
        check_size("size", size, usual)
        return size, size
    if len(size) != 2:
        raise ValueError(f"size must be one number, or height and width, got {size!r}; use {usual}.")
    for place, side in enumerate(size):
        check_size(f"size[{place}]", side, usual)
    return size[0], size[1]
