"""Two phases of training (section IV-D): first the sub level alone, then both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase

from hdrqn_torchrl.learning.learner import Learner
from hdrqn_torchrl.learning.legs import LegCounter
from hdrqn_torchrl.learning.monitors import Monitor, VisitCounter
from hdrqn_torchrl.modules import EpsilonGreedy, SubgoalSuccess


@dataclass(frozen=True, kw_only=True)
class PhaseOne:
    """How long the sub level learns alone.

    Args:
        success: it ends when this share of the last options for every subgoal reached it ...
        min_options: ... and that many options for each have ended, ...
        max_frames: ... or after that many environment frames.
        window: number of options that success is measured over.

    Raises:
        ValueError: if a value breaks its rule.
    """

    success: float = 0.8
    min_options: int = 100
    max_frames: int = 1_000_000
    window: int = 100

    def __post_init__(self) -> None:
        if not 0.0 < self.success <= 1.0:
            raise ValueError(f"success must lie in (0, 1], got {self.success}; use 0.8.")
        if self.max_frames < 1:
            raise ValueError(f"max_frames must be >= 1, got {self.max_frames}; leave phase_one out to have none.")


class Phases:
    """Holds the meta level while the first phase lasts: it chooses subgoals at random and does not learn. (A monitor.)

    Args:
        settings: how long that is.
        num_subgoals: G.
        exploration: the meta level's; it must start at epsilon 1 to choose at random.
        learner: the meta level's, if it has one of its own.

    Raises:
        ValueError: if the meta level would not choose at random.
    """

    def __init__(
        self, settings: PhaseOne, num_subgoals: int, exploration: EpsilonGreedy, learner: Learner | None
    ) -> None:
        if exploration.start != 1.0:
            raise ValueError(f"meta_exploration.start must be 1.0 with phase_one, got {exploration.start}.")
        self.settings, self.exploration, self.learner = settings, exploration, learner
        self.success = SubgoalSuccess(num_subgoals, window=settings.window).to(exploration.epsilon.device)
        self.frames = 0
        self._hold(True)

    @property
    def phase(self) -> int:
        """1 or 2."""
        return 1 if self.exploration.held else 2

    def observe(self, batch: TensorDictBase) -> None:
        """Counts a collected batch ``[N, T]``, and begins the second phase when it is time."""
        self.success.observe(batch)
        self.frames += batch.numel()
        if self.phase == 1:
            tried = (self.success.options >= self.settings.min_options).all()
            good = tried & (self.success.rates >= self.settings.success).all()
            if self.frames >= self.settings.max_frames or good:
                self._hold(False)

    def metrics(self) -> dict[str, float]:
        """Phase, and success of each subgoal's last options (NaN where none ended)."""
        known = self.success.rates.masked_fill(self.success.options == 0, torch.nan)
        return {"phase": self.phase, **{f"phase/success_{index}": rate for index, rate in enumerate(known.tolist())}}

    def clear(self) -> None:
        """Nothing starts again with a row."""

    def _hold(self, held: bool) -> None:
        self.exploration.held = held
        if self.learner is not None:
            self.learner.held = held

    def state_dict(self) -> dict[str, Any]:
        """What it has counted, and which phase it is."""
        return {
            "success": dict(self.success.state_dict()),
            "frames": self.frames,
            "held": self.phase == 1,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self.success.load_state_dict(state["success"])
        self.frames = state["frames"]
        self._hold(state["held"])


def phase_monitors(
    settings: PhaseOne | None, num_subgoals: int, exploration: EpsilonGreedy, learner: Learner | None
) -> dict[str, Monitor]:
    """The monitors of a training in two phases; none if ``settings`` is ``None``.

    Args:
        settings, num_subgoals, exploration, learner: as in :class:`Phases`.

    Examples:
        >>> list(phase_monitors(PhaseOne(), 2, EpsilonGreedy(), None))
        ['phases', 'legs', 'visits']
    """
    if settings is None:
        return {}
    phases = Phases(settings, num_subgoals, exploration, learner)
    return {"phases": phases, "legs": LegCounter(num_subgoals), "visits": VisitCounter()}
