"""Two phases of training (section IV-D): first the sub level alone, then all levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase

from hdrqn_torchrl.envs import SubgoalSet
from hdrqn_torchrl.keys import OptionKeys
from hdrqn_torchrl.learning.learner import Learner
from hdrqn_torchrl.learning.legs import LegCounter
from hdrqn_torchrl.learning.monitors import Monitor, VisitCounter
from hdrqn_torchrl.modules import EpsilonGreedy, SubgoalSuccess, SuccessEpsilonGreedy
from hdrqn_torchrl.modules.sizes import check_size


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

    Examples:
        >>> PhaseOne(success=0.9, max_frames=200_000)
        PhaseOne(success=0.9, min_options=100, max_frames=200000, window=100)
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
        check_size("min_options", self.min_options, 100)
        check_size("window", self.window, 100)


class Phases:
    """Holds the upper levels while the first phase lasts: they choose at random and do not learn. (A monitor.)

    Args:
        settings: how long that is.
        num_subgoals: G, of the set that the sub level pursues.
        explorations: the upper levels'; they must start at epsilon 1 to choose at random. The meta level's is the last.
        learners: the upper levels', where they have their own.
        names: entries of the set that the sub level pursues.
        upper_names: those of the set that the level above pursues; ``None``: it pursues the task.

    Raises:
        ValueError: if an upper level would not choose at random.

    Examples:
        >>> from tensordict import TensorDict
        >>> meta_exploration = EpsilonGreedy(1.0, 0.1)
        >>> phases = Phases(PhaseOne(max_frames=16), 2, [meta_exploration], learners=[])
        >>> phases.phase, meta_exploration.held
        (1, True)
        >>> no, subgoal = torch.zeros(2, 8, 1, dtype=torch.bool), torch.zeros(2, 8, dtype=torch.int64)
        >>> step = {"active_subgoal": subgoal, "option_done": no, "subgoal_reached": no}
        >>> phases.observe(TensorDict({"subgoal_mask": torch.ones(2, 8, 2).bool(), "next": step}, [2, 8]))
        >>> phases.phase, meta_exploration.held
        (2, False)
    """

    def __init__(
        self,
        settings: PhaseOne,
        num_subgoals: int,
        explorations: Sequence[EpsilonGreedy],
        learners: Sequence[Learner],
        *,
        names: OptionKeys = OptionKeys(),  # noqa: B008 (frozen)
        upper_names: OptionKeys | None = None,
    ) -> None:
        for name, each in zip([*["middle"] * (len(explorations) - 1), "meta"], explorations, strict=True):
            if each.start != 1.0:
                raise ValueError(f"{name}_exploration.start must be 1.0 with phase_one, got {each.start}.")
            if isinstance(each, SuccessEpsilonGreedy):
                raise ValueError(
                    f"{name}_exploration must choose at random with phase_one, got SuccessEpsilonGreedy, which follows "
                    "success; use EpsilonGreedy."
                )
        self.settings, self.explorations, self.learners = settings, explorations, learners
        success = SubgoalSuccess(num_subgoals, window=settings.window, names=names, upper_names=upper_names)
        self.success = success.to(explorations[-1].epsilon.device)
        self.frames = 0
        self._hold(True)

    @property
    def phase(self) -> int:
        """1 or 2."""
        return 1 if self.explorations[-1].held else 2

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
        for exploration in self.explorations:
            exploration.held = held
        for learner in self.learners:
            learner.held = held

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
    settings: PhaseOne | None,
    subgoals: Sequence[SubgoalSet],
    explorations: Sequence[EpsilonGreedy],
    learners: Sequence[Learner] = (),
) -> dict[str, Monitor]:
    """What a training in two phases is watched by; nothing if ``settings`` is ``None``.

    Args:
        settings: how long the sub level learns alone.
        subgoals: the sets that are pursued, from near to far; legs are counted for each.
        explorations, learners: as in :class:`Phases`.

    Examples:
        >>> sets = [SubgoalSet(names=("door",), prefix="doors"), SubgoalSet(names=("key", "goal"))]
        >>> list(phase_monitors(PhaseOne(), sets, [EpsilonGreedy(), EpsilonGreedy()]))
        ['phases', 'doors_legs', 'legs', 'visits']
    """
    if settings is None:
        return {}
    near, *farther = subgoals
    upper_names = farther[0].keys if farther else None
    return {
        "phases": Phases(settings, len(near), explorations, learners, names=near.keys, upper_names=upper_names),
        **{each.keys.of("legs"): LegCounter(len(each), names=each.keys) for each in subgoals},
        "visits": VisitCounter(),
    }
