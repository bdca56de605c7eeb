"""Ways to turn or mirror a task's worlds after which all that happened in them could have happened just as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral


@dataclass(frozen=True, kw_only=True)
class Symmetry:
    """One way to change the worlds of a task that leaves the task as it is, as a mirror does.

    Whatever an agent saw, did, attained and was paid, an agent in the changed world could have as well, if it saw

    .. math:: o'[i] = o[\\mathrm{places}[i]], \\qquad a' = \\mathrm{actions}[a] .

    Args:
        places: for each entry of the flattened observation, the one whose value it has in the changed world.
        actions: for each action, the one that does the same in the changed world.

    Raises:
        ValueError: if one of them is not a permutation.

    Examples:
        >>> mirror = Symmetry(places=(2, 1, 0), actions=(1, 0))  # three cells in a row; left, right
    """

    places: tuple[int, ...]
    actions: tuple[int, ...]

    def __post_init__(self) -> None:
        for name in ("places", "actions"):
            object.__setattr__(self, name, _permutation(name, getattr(self, name)))


def check_symmetries(symmetries: Sequence[Symmetry]) -> tuple[Symmetry, ...]:
    """The symmetries of a task, as a tuple.

    Raises:
        ValueError: if they are not symmetries of one observation and one set of actions.
    """
    if not isinstance(symmetries, Sequence) or not all(isinstance(each, Symmetry) for each in symmetries):
        raise ValueError(f"symmetries must be a tuple of Symmetry, got {symmetries!r}; leave out what there is not.")
    sizes = {(len(each.places), len(each.actions)) for each in symmetries}
    if len(sizes) > 1:
        raise ValueError(
            f"symmetries must all be of the same number of places and of actions, got {sorted(sizes)}; write every "
            "place and action of the task in each."
        )
    return tuple(symmetries)


def with_identity(symmetries: Sequence[Symmetry]) -> tuple[Symmetry, ...]:
    """Those of a task, at least one, behind the one that leaves its worlds as they are."""
    first = symmetries[0]
    return Symmetry(places=tuple(range(len(first.places))), actions=tuple(range(len(first.actions)))), *symmetries


def _permutation(name: str, numbers: Sequence[int]) -> tuple[int, ...]:
    listed = tuple(numbers) if isinstance(numbers, Sequence) and not isinstance(numbers, str) else ()
    whole = all(isinstance(each, Integral) and not isinstance(each, bool) for each in listed)
    if not listed or not whole or sorted(listed) != list(range(len(listed))):
        raise ValueError(
            f"{name} must be each of the numbers 0 to their number - 1 once, got {numbers!r}; what stays where it is "
            "has its own number."
        )
    return tuple(int(each) for each in listed)
