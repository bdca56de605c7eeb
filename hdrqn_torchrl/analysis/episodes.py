"""Summary of the episodes of one evaluation: averages with intervals, and results for each subgoal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy
from tensordict import TensorDictBase
from torch import Tensor

from hdrqn_torchrl.analysis.intervals import CONFIDENCE, mean_interval, share_interval
from hdrqn_torchrl.runs.evaluation import columns


def summarise(played: TensorDictBase, *, confidence: float = CONFIDENCE, names: Sequence[str] = ()) -> dict[str, Any]:
    """Averages with intervals over episodes, and results for each subgoal.

    Args:
        played: episodes of :func:`play`.
        confidence: of the intervals.
        names: of the subgoals, if they have any.

    Returns:
        The entries of :func:`evaluate`; ``intervals``: the same names with ``[low, high]``, of rates after Clopper and
        Pearson, else t intervals, or ``None`` where all episodes had the same value; ``per_subgoal``: for each
        subgoal its ``name`` if it has one, ``attained`` (share of episodes in which it was) and, for hierarchical
        agents, ``options`` (per episode) and ``success_rate`` (share of its options that reached it; ``None`` if it
        was never chosen).
    """
    figures = columns(played)
    result: dict[str, Any] = {name: _mean(values) for name, values in figures.items()}
    result |= {"episodes": len(played), "per_subgoal": []}
    for subgoal in range(played["attained"].shape[-1] if "attained" in played else 0):
        entry: dict[str, Any] = {"name": names[subgoal]} if names else {}
        entry["attained"] = _mean((played["attained"][:, subgoal] > 0).float())
        if "chosen" in played:
            options = played["chosen"][:, subgoal].sum().item()
            reached = played["reached"][:, subgoal].sum().item()
            entry |= {"options": options / len(played), "success_rate": reached / options if options else None}
        result["per_subgoal"].append(entry)
    result["intervals"] = {name: _interval(name, values, confidence) for name, values in figures.items()}
    return result


def _interval(name: str, values: Tensor, confidence: float) -> list[float] | None:
    sample = values.cpu().double().numpy()
    if name.endswith("_rate"):
        return list(share_interval(sample.mean().item(), len(sample), confidence=confidence))
    low, high = mean_interval(sample, confidence=confidence)
    return None if numpy.isnan(low) else [low.item(), high.item()]


def _mean(values: Tensor) -> float:
    return values.mean().item()
