"""Runs: the training loop, evaluations, checkpoints, and the folder that they leave behind.

Names are loaded when they are asked for: torch takes seconds, and reading a run's settings needs none of it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hdrqn_torchrl.runs.agents import Agent, load_agent
    from hdrqn_torchrl.runs.collectors.resumable import ResumableCollector
    from hdrqn_torchrl.runs.evaluation import evaluate, play
    from hdrqn_torchrl.runs.interruption import StopRequest
    from hdrqn_torchrl.runs.logging import RunLogger
    from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints
    from hdrqn_torchrl.runs.persistence.weights import load_policy, load_weights, save_weights
    from hdrqn_torchrl.runs.trainer import Trainer

__all__ = [
    "Agent", "Checkpoints", "ResumableCollector", "RunLogger", "StopRequest", "Trainer", "evaluate", "load_agent",
    "load_policy", "load_weights", "play", "save_weights",
]  # fmt: skip
_MODULES = {
    "Agent": "agents",
    "Checkpoints": "persistence.checkpoint",
    "ResumableCollector": "collectors.resumable",
    "RunLogger": "logging",
    "StopRequest": "interruption",
    "Trainer": "trainer",
    "evaluate": "evaluation",
    "load_agent": "agents",
    "load_policy": "persistence.weights",
    "load_weights": "persistence.weights",
    "play": "evaluation",
    "save_weights": "persistence.weights",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
