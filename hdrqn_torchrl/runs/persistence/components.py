"""The parts of an algorithm that a checkpoint holds, each under its name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from torchrl.checkpoint import Checkpoint, CheckpointError

from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.learning import Learner
from hdrqn_torchrl.runs.persistence.checkpoint import MEMORY


def components_of(algorithm: Algorithm) -> dict[str, Any]:
    """Policy, learners, their memories and monitors."""
    learners = algorithm.learners.items()
    return {
        **{f"learner-{name}": _but_memory(learner) for name, learner in learners},
        **{f"{MEMORY}{name}": _memory(learner) for name, learner in learners},
        **{f"monitor-{name}": monitor for name, monitor in algorithm.monitors.items()},
        "policy": algorithm.policy,
    }


def explained(error: CheckpointError, path: Path) -> CheckpointError:
    """The error itself or, where it is the reason, one that says how earlier versions stored phases."""
    try:
        earlier = "phases" in Checkpoint.manifest(path)["components"]
    except (CheckpointError, OSError, ValueError, TypeError, KeyError):
        return error
    if not earlier:
        return error
    return CheckpointError(
        f"{path} must hold the counts of its phases in parts of their own, got those of an earlier version in one; "
        "go on with the version that wrote it, or begin a training with its weights (init_from)."
    )


class _Part:
    """A component by its two methods."""

    def __init__(self, save: Callable[[], dict[str, Any]], load: Callable[[dict[str, Any]], None]) -> None:
        self.state_dict, self.load_state_dict = save, load


def _but_memory(learner: Learner) -> _Part:
    return _Part(partial(learner.state_dict, memory=False), learner.load_state_dict)


def _memory(learner: Learner) -> _Part:
    return _Part(learner.memory_state_dict, learner.load_memory_state_dict)
