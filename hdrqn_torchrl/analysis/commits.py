"""Which code a run was made with."""

from __future__ import annotations

from typing import Any

_LENGTH = 7


def codes_of(origin: dict[str, Any]) -> list[dict[str, Any]]:
    """What is recorded of the code of a run, each with ``commit`` and ``versions``: that it began with, then others.

    Args:
        origin: what ``run.json`` holds; the first of the list is this itself.
    """
    later = origin.get("resumed_with")
    return [origin, *(each for each in (later if isinstance(later, list) else []) if isinstance(each, dict))]


def commits_of(origin: dict[str, Any]) -> list[str]:
    """Commits of a run, from its ``run.json``: what it began with, then what it went on with.

    Args:
        origin: what ``run.json`` holds.

    Examples:
        >>> commits_of({"commit": "0123456789", "resumed_with": [{"commit": "89abcdef01-dirty"}]})
        ['0123456789', '89abcdef01-dirty']
    """
    return list(dict.fromkeys(str(code.get("commit")) for code in codes_of(origin)))


def short_commit(commit: str) -> str:
    """A commit's first digits, and whether files were changed after it.

    Args:
        commit: as ``git describe --always --dirty`` names it.

    Examples:
        >>> short_commit("89abcdef01-dirty")
        '89abcde-dirty'
    """
    name, dirty, _ = commit.partition("-dirty")
    return name[:_LENGTH] + dirty
