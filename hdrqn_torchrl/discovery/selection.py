"""What chooses the events that are subgoals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from tensordict import TensorDictBase


@dataclass(frozen=True)
class Chosen:
    """What a selection has chosen: the subgoal of each token, and those that an episode attains only once."""

    slots: Mapping[int, int]
    once: Sequence[int] = field(default=())


class Selection(Protocol):
    """Chooses the events that are subgoals."""

    def observe(self, batch: TensorDictBase) -> None:
        """Takes in collected steps ``[N, T]`` with their events."""

    def update(self) -> Chosen:
        """Looks for subgoals, at discovery points alone."""

    def take_over(self, chosen: Chosen) -> None:
        """Begins with subgoals that an agent has already; they keep their slots."""

    def state_dict(self) -> dict[str, Any]:
        """All that a resumed training needs."""

    def load_state_dict(self, state: Any) -> Any:
        """Restores what :meth:`state_dict` returned."""
