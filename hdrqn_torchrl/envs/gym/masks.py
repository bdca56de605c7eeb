"""Where worlds tell which actions can be chosen, besides `info['action_mask']`."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

from gymnasium import spaces

_MASKS = ("action_mask", "legal_action_mask")


class MaskPlace(NamedTuple):
    """Where a pool tells which actions can be chosen.

    Attributes:
        part: of what a step returns: the observation, a ``Dict``, or ``info``.
        name: of its entry.
    """

    part: Literal["obs", "info"]
    name: str


def mask_entry_of(space: spaces.Space, num_actions: int) -> str | None:
    """The entry of a ``Dict`` observation that tells which actions can be chosen, as in PettingZoo; ``None``: none."""
    entries = space.spaces if isinstance(space, spaces.Dict) else {}
    return next((name for name in _MASKS if name in entries and entries[name].shape == (num_actions,)), None)


def mask_place_of(spec: Any) -> MaskPlace | None:
    """Where an environment tells which actions can be chosen: Jumanji's show it, Pgx's tell it; ``None``: nowhere."""
    places = [MaskPlace(part, name) for part in ("obs", "info") for name in _MASKS]  # type: ignore[arg-type]
    return next((each for each in places if f"{each.part}:{each.name}" in spec.state_array_spec), None)
