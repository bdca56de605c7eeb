"""What is counted between two log points, and the check of a trainer's counters read back from a checkpoint."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hdrqn_torchrl.learning import Learner
from hdrqn_torchrl.runs.logging import Row

_MOST = 2**53  # the largest count that a number in a table shows exactly


class LogInterval:
    """What happened since the last log point; tensors stay on their device until they are summed up.

    Args:
        frames: of the training at that log point.

    Examples:
        >>> interval = LogInterval(frames=1_000)
        >>> interval.add_update("sub", {"loss": torch.tensor(1.0)})
        >>> interval.add_update("sub", {"loss": torch.tensor(2.0)})
        >>> interval.summary(1_500)["sub/loss"]
        1.5
    """

    def __init__(self, frames: int = 0) -> None:
        self._frames, self._since = frames, time.monotonic()
        self._episodes: list[TensorDictBase] = []
        self._sums: dict[str, dict[str, Tensor]] = {}
        self._counts: dict[str, int] = {}

    def add_episodes(self, found: Sequence[TensorDictBase]) -> int:
        """Takes episodes ``[M]`` that ended (:class:`~hdrqn_torchrl.runs.incoming.Incoming`); returns how many."""
        self._episodes += [episodes for episodes in found if len(episodes)]
        return sum(map(len, found))

    def add_update(self, learner: str, metrics: dict[str, Tensor]) -> None:
        """Takes what one update of a learner returned."""
        sums = self._sums.get(learner)
        self._sums[learner] = metrics if sums is None else {name: sums[name] + value for name, value in metrics.items()}
        self._counts[learner] = self._counts.get(learner, 0) + 1

    def summary(self, frames: int) -> Row:
        """The columns of the next log point, which is at ``frames``."""
        seconds = max(time.monotonic() - self._since, 1e-9)
        row: Row = {"frames_per_second": round((frames - self._frames) / seconds, 1)}
        if self._episodes:
            episodes: TensorDictBase = torch.cat([each.cpu() for each in self._episodes], 0)  # type: ignore[assignment]
            row |= {f"behaviour/{name}": value.mean().item() for name, value in episodes.items()}
        for learner, sums in self._sums.items():
            count = self._counts[learner]
            row |= {f"{learner}/{name}": (total / count).item() for name, total in sums.items()}
            row[f"{learner}/updates_per_second"] = round(count / seconds, 1)
        return row

    def state_dict(self) -> dict[str, Any]:
        """What was counted so far."""
        return {
            "frames": self._frames,
            "seconds": time.monotonic() - self._since,
            "episodes": self._episodes,
            "sums": self._sums,
            "counts": self._counts,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._frames, self._since = state["frames"], time.monotonic() - state["seconds"]
        self._episodes, self._sums, self._counts = state["episodes"], state["sums"], state["counts"]


def crossed(before: int, after: int, interval: int) -> bool:
    """Whether a multiple of ``interval`` lies in (before, after]."""
    return before // interval < after // interval


def warn_of_clipping(row: Row, learners: Mapping[str, Learner]) -> None:
    """Warns of learners whose gradients are clipped in most updates.

    Adam's steps do not depend on the scale of gradients, so clipping all of them slows nothing down. It shrinks those
    the most that hold a rare surprise, such as the end of a long episode, which is then hardly learned from.

    Args:
        row: of a log point.
        learners: by name.
    """
    for name, learner in learners.items():
        norm = row.get(f"{name}/grad_norm")  # reported only where gradients are clipped
        if isinstance(norm, float) and norm > (limit := learner.settings.max_grad_norm or math.inf):
            warnings.warn(  # without the norm: the same text is shown once
                f"max_grad_norm should be above the usual norm of gradients, got {limit} for {name!r}, where most are "
                f"larger ({name}/grad_norm): rare surprises, such as the ends of long episodes, hardly count. Raise "
                "it, or scale rewards to about 1.",
                stacklevel=2,
            )


def check_counters(state: dict[str, Any]) -> None:
    """Refuses a trainer's counters that no training can have.

    Args:
        state: what :meth:`~hdrqn_torchrl.runs.trainer.Trainer.state_dict` returned, read from a file.

    Raises:
        ValueError: if a count or a time is not a number of its kind, or a sum has another shape.
    """
    window, sums = state["window"], state["tracker"]["sums"]
    counts = [state["frames"], state["episodes"], window["frames"], state["completed"] or 0, *window["counts"].values()]
    times = [state["wall_seconds"], state.get("processor_seconds", 0.0), window["seconds"]]
    possible = all(type(count) is int and 0 <= count < _MOST for count in counts)
    possible &= all(isinstance(each, (int, float)) and 0 <= each < _MOST for each in times)
    possible &= isinstance(state["best_return"], float) and state["best_return"] < math.inf
    possible &= sums is None or (isinstance(sums, TensorDictBase) and sums.ndim == 1)
    possible &= all(isinstance(each, TensorDictBase) and each.ndim == 1 for each in window["episodes"])
    if not possible:
        raise ValueError("the stored trainer's counts must be those of a training, got others; use another checkpoint.")
