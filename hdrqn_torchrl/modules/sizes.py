"""The rule that sizes of networks follow."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral


def check_size(name: str, size: int, usual: int | str, *, least: int = 1) -> None:
    """Refuses a size that is too small, or not a whole number.

    Args:
        name: of the argument.
        size: its value.
        usual: one that works, for the message.
        least: the smallest.

    Raises:
        ValueError: with name, rule, value and a way out.

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


def check_widths(widths: Sequence[int], name: str = "widths") -> tuple[int, ...]:
    """Sizes of several layers, at least one.

    Raises:
        ValueError: if there is none, or one that :func:`check_size` refuses.
    """
    sizes = tuple(widths) if isinstance(widths, Sequence) and not isinstance(widths, str) else ()
    if not sizes:
        raise ValueError(f"{name} must be a list of at least one size, got {widths!r}; use [128].")
    for place, size in enumerate(sizes):
        check_size(f"{name}[{place}]", size, 128)
    return sizes
