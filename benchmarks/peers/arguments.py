"""What a run of a peer is asked for: ``key=value`` on the command line."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields
from math import inf
from pathlib import Path
from typing import Self, get_type_hints


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """The same for every peer.

    Args:
        id: of a MiniGrid or BabyAI task, or the name of a grid world (tasks.py).
        seed: of the training.
        frames: environment steps of the training, all worlds together.
        seconds: processor time after which a training stops, evaluations included; the same command goes on with more.
        bonus: added to the reward for each subgoal attained.
        max_steps: length of an episode; 0: the task's own.
        interval_frames: steps between two evaluations.
        episodes: of an evaluation.
        final_episodes: of the last one.
        runs: folder of checkpoints.
        results: folder of results, one JSON line for each evaluation.
    """

    id: str
    seed: int = 0
    frames: int = 300_000
    seconds: float = inf
    bonus: float = 0.0
    max_steps: int = 0
    interval_frames: int = 50_000
    episodes: int = 100
    final_episodes: int = 500
    runs: Path = Path("outputs/peers")
    results: Path = Path(__file__).parent / "results"

    @classmethod
    def read(cls, words: Sequence[str]) -> Self:
        """Reads ``key=value`` words; ends the program with a sentence if one is wrong."""
        kinds, values = get_type_hints(cls), {}
        for word in words:
            name, _, value = word.partition("=")
            if name not in kinds:
                sys.exit(f"error: arguments must be NAME=VALUE with a name in {sorted(kinds)}, got {word!r}.")
            try:
                values[name] = kinds[name](value)
            except ValueError:
                sys.exit(f"error: {name} must be of type {kinds[name].__name__}, got {value!r}.")
        missing = [each.name for each in fields(cls) if each.default is MISSING and each.name not in values]
        if missing:
            sys.exit(f"error: {' and '.join(missing)} must be given: id=MiniGrid-DoorKey-8x8-v0.")
        return cls(**values)

    @property
    def task(self) -> str:
        """The id, and what else tells the task from others."""
        return f"{self.id}-max_steps{self.max_steps}" if self.max_steps else self.id

    def name_of(self, agent: str) -> str:
        """What tells a run of an agent from all others."""
        return f"{self.task}-{agent}-bonus{self.bonus:g}-seed{self.seed}"
