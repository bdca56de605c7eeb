"""A set of subgoals of a task, and the names of the entries that an environment writes for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hdrqn_torchrl import keys

TAKEN_PREFIXES = ("sub", "meta", "joint", "flat", "active", "hindsight", "memory", "behaviour", "greedy")
"""Names of levels, learners and columns, and prefixes of other entries' names."""


@dataclass(frozen=True, kw_only=True)
class SubgoalSet:
    """One set of subgoals of a task, and the prefix of the entries that an environment writes for it.

    The environment writes ``attained`` ``[N, G]`` and, if not all of them are worth choosing at all times,
    ``available`` ``[N, G]``, under the names of :class:`~hdrqn_torchrl.keys.OptionKeys`.

    Args:
        names: of its subgoals, at least one, all distinct.
        prefix: of its entries, also the name of the level that chooses among them; empty for the farthest set.
        repeatable: whether a subgoal can be attained more than once in an episode.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> SubgoalSet(names=("north", "south"), prefix="rooms").keys.attained
        'rooms_attained'
    """

    names: tuple[str, ...]
    prefix: str = ""
    repeatable: bool = False

    def __post_init__(self) -> None:
        names = check_names("names", self.names)
        if not names:
            raise ValueError("names must be those of at least one subgoal, got none; leave the set out.")
        object.__setattr__(self, "names", names)
        _check_prefix(self.prefix)
        check_flag("repeatable", self.repeatable)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def keys(self) -> keys.OptionKeys:
        """Names of its entries."""
        return keys.OptionKeys(self.prefix)


def check_names(argument: str, names: Sequence[str]) -> tuple[str, ...]:
    """Names that are shown to people, as a tuple.

    Raises:
        ValueError: if they are not a list of distinct, non-empty strings.
    """
    listed = tuple(names) if isinstance(names, Sequence) and not isinstance(names, str) else None
    if listed is None or not all(isinstance(name, str) and name for name in listed) or len(set(listed)) < len(listed):
        raise ValueError(f'{argument} must be distinct, non-empty strings, got {names!r}; use ("north", "south").')
    return listed


def check_flag(argument: str, value: bool) -> None:
    """Refuses anything but ``True`` and ``False``.

    Raises:
        ValueError: if it is something else.
    """
    if not isinstance(value, bool):
        raise ValueError(f"{argument} must be True or False, got {value!r}.")


def check_sets(sets: Sequence[SubgoalSet]) -> tuple[SubgoalSet, ...]:
    """The sets of a task, as a tuple.

    Raises:
        ValueError: if they are not sets from near to far with distinct entries.
    """
    if not isinstance(sets, Sequence) or not all(isinstance(each, SubgoalSet) for each in sets):
        raise ValueError(f"subgoals must be a tuple of SubgoalSet, got {sets!r}; use (SubgoalSet(names=...),).")
    prefixes = [each.prefix for each in sets]
    if sets and (prefixes[-1] or not all(prefixes[:-1])):
        raise ValueError(
            f"subgoals must go from near to far: the farthest set, and it alone, has no prefix, got the prefixes "
            f"{prefixes}; give each nearer set one."
        )
    for place, prefix in enumerate(prefixes[:-1]):
        for other in prefixes[:place]:
            if f"{prefix}_".startswith(f"{other}_") or f"{other}_".startswith(f"{prefix}_"):
                raise ValueError(
                    f"subgoals must have prefixes of which none begins with another, got {other!r} and {prefix!r}: "
                    "their entries could have one name; rename one of them."
                )
    return tuple(sets)


def _check_prefix(prefix: str) -> None:
    if prefix != "" and not (isinstance(prefix, str) and prefix.isidentifier()):
        raise ValueError(
            f"prefix must be letters, digits and underscores, got {prefix!r}; entries and a level are named after it: "
            'use "rooms", or "" for the farthest set.'
        )
    if prefix in TAKEN_PREFIXES:
        raise ValueError(
            f"prefix must be none of {', '.join(TAKEN_PREFIXES)}, which name other things, got {prefix!r}; use another."
        )
