"""Where practice begins: at moments of earlier episodes."""

from __future__ import annotations

from typing import Any

import numpy as np

from hdrqn_torchrl.envs.montezuma.emulators import Snapshot


class PracticeStarts:
    """Moments in which subgoals were attained, some of each kind (which subgoal, with or without the key)."""

    def __init__(self, capacity: int = 16) -> None:
        self.capacity, self._moments = capacity, dict[tuple[int, bool], list[Snapshot]]()

    def __len__(self) -> int:
        return len(self._moments)

    def add(self, kind: tuple[int, bool], moment: Snapshot, generator: np.random.Generator) -> None:
        """Keeps a moment; where there are enough of its kind, in place of a random one."""
        moments = self._moments.setdefault(kind, [])
        if len(moments) < self.capacity:
            moments.append(moment)
        else:
            moments[generator.integers(self.capacity)] = moment

    def draw(self, generator: np.random.Generator) -> Snapshot:
        """A moment of a random kind."""
        kinds = sorted(self._moments)
        moments = self._moments[kinds[generator.integers(len(kinds))]]
        return moments[generator.integers(len(moments))]

    def state_dict(self) -> list[dict[str, Any]]:
        return [
            {"subgoal": subgoal, "key": key, "moments": [moment.tensors() for moment in moments]}
            for (subgoal, key), moments in self._moments.items()
        ]

    def load_state_dict(self, state: list[dict[str, Any]]) -> None:
        self._moments = {
            (kind["subgoal"], kind["key"]): [Snapshot.of_tensors(moment) for moment in kind["moments"]]
            for kind in state
        }
