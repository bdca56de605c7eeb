"""Which settings make two runs different: by their full names, and without those that do not matter."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

BOOKKEEPING = (
    "resume",
    "resume_override",
    "checkpoint",
    "output_root",
    "allowed_targets",
    "evaluation.ceilings",
    "evaluation.ceiling_seconds",
    "collector.address",
    "collector.patience_seconds",
)
"""May differ when a run goes on."""
NOT_LEARNED_FROM = (*BOOKKEEPING, "logger", "device", "deterministic", "threads", "log_frames")
"""These do not affect learning: runs that differ in no other setting are the same training."""
NOT_COMPARED = (*NOT_LEARNED_FROM, "seed", "evaluation")
"""Runs that differ in these may be averaged."""
NOT_THE_TASK = ("num_envs", "seed", "device")
"""Settings of the environment that leave the task as it is."""
NOT_THE_WORLDS = ("subgoals", "backend", "processes")
"""Those that leave a task as it is which an id names: what agents are told of it, and where its worlds run."""


def flat(settings: Any, *, without: Collection[str] = (), path: str = "") -> dict[str, Any]:
    """Settings by their full names.

    Args:
        settings: plain nested dicts.
        without: full names of settings, or of sections, to leave out.
        path: full name of ``settings``.

    Examples:
        >>> flat({"seed": 1, "env": {"view": 5, "walls": {}}, "resume": None}, without=BOOKKEEPING)
        {'seed': 1, 'env.view': 5, 'env.walls': {}}
    """
    if path in without:
        return {}
    if not isinstance(settings, dict) or not settings:
        return {path: settings}
    found: dict[str, Any] = {}
    for key, value in settings.items():
        found |= flat(value, without=without, path=f"{path}.{key}" if path else str(key))
    return found
