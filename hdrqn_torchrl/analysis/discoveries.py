"""When the subgoals of runs were found, where agents find them themselves."""

from __future__ import annotations

import numpy as np

from hdrqn_torchrl.analysis.results import Array, Run

_FOUND = "discovery/found_"


def found_at(run: Run, *, axis: str = "frames") -> Array:
    """Where a run found its subgoals, in ascending order; those that it gave up later, too.

    Args:
        run: the run.
        axis: column that positions are taken from; those between two log points lie on the line between them.

    Returns:
        ``[F]``; empty if its subgoals were given.

    Examples:
        >>> from pathlib import Path
        >>> metrics = {"frames": np.array([10.0, 20.0]), "discovery/found_1": np.array([0.0, 15.0])}
        >>> found_at(Run(Path("run"), {**metrics, "updates": np.array([0.0, 100.0])}), axis="updates")
        array([50.])
    """
    slots = [np.unique(column) for name, column in run.metrics.items() if name.startswith(_FOUND)]
    frames = np.sort(np.concatenate([np.empty(0), *slots]))
    frames = frames[frames > 0]  # NaN and 0: none
    x, y = run.metrics.get("frames", np.empty(0)), run.metrics.get(axis, np.empty(0))
    return np.interp(frames, x, y) if len(x) == len(y) > 0 else np.empty(0)
