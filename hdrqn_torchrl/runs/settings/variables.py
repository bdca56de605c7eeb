"""Variables of the environment, for programs that this one starts."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager


@contextmanager
def variables(changes: Mapping[str, str]) -> Iterator[None]:
    """Changes variables of the environment for a while.

    Examples:
        >>> with variables({"COLOUR": "red"}):
        ...     print(os.environ["COLOUR"])
        red
        >>> "COLOUR" in os.environ
        False
    """
    before = dict(os.environ)
    os.environ.update(changes)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def search_path() -> dict[str, str]:
    """The variable by which another Python finds what this one finds."""
    return {"PYTHONPATH": os.pathsep.join(sys.path)}
