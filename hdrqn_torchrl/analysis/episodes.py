"""Summary of the episodes of one evaluation: averages with intervals, and results for each subgoal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy
from tensordict import TensorDictBase
from torch import Tensor

from hdrqn_torchrl.analysis.intervals import CONFIDENCE, mean_interval, share_interval
from hdrqn_torchrl.envs import SubgoalSet
from hdrqn_torchrl.keys import OptionKeys
from hdrqn_torchrl.runs.evaluation import columns

_SHARES = ("success_rate", "cut_off_rate")  # of episodes; in_order_rate is a mean of shares of goals


def summarise(
    played: TensorDictBase,
    *,
    confidence: float = CONFIDENCE,
    names: Sequence[str] = (),
    nearer: Sequence[SubgoalSet] = (),
) -> dict[str, Any]:
    """Averages with intervals over episodes, and results for each subgoal.

    Args:
        played: episodes of :func:`play`.
        confidence: of the intervals.
        names: of the farthest subgoals, if they have any.
        nearer: the other sets of subgoals.

    Returns:
        The entries of :func:`evaluate`; ``intervals``: the same names with ``[low, high]``, of shares of episodes
        after Clopper and Pearson, else t intervals, or ``None`` where all episodes had the same value;
        ``per_subgoal``: for each subgoal its ``name`` if it has one, ``attained`` (share of episodes in which it was)
        and, for hierarchical agents, ``options`` (per episode) and ``success_rate`` (share of its options that reached
        it; ``None`` if it was never chosen); ``PREFIX_per_subgoal``: the same for each nearer set.
    """
    figures = columns(played)
    result: dict[str, Any] = {name: _mean(values) for name, values in figures.items()}
    result |= {"episodes": len(played), "per_subgoal": _per_subgoal(played, OptionKeys(), names)}
    for each in nearer:
        result[each.keys.of("per_subgoal")] = _per_subgoal(played, each.keys, each.names)
    result["intervals"] = {name: _interval(name, values, confidence) for name, values in figures.items()}
    return result


def _per_subgoal(played: TensorDictBase, of: OptionKeys, names: Sequence[str]) -> list[dict[str, Any]]:
    """What became of each subgoal of a set."""
    attained, chosen, reached = (played.get(of.of(name), None) for name in ("attained", "chosen", "reached"))
    found = []
    for subgoal in range(0 if attained is None else attained.shape[-1]):
        entry: dict[str, Any] = {"name": names[subgoal]} if names else {}
        entry["attained"] = _mean((attained[:, subgoal] > 0).float())
        if chosen is not None:
            options, won = chosen[:, subgoal].sum().item(), reached[:, subgoal].sum().item()
            entry |= {"options": options / len(played), "success_rate": won / options if options else None}
        found.append(entry)
    return found


def _interval(name: str, values: Tensor, confidence: float) -> list[float] | None:
    sample = values.cpu().double().numpy()
    if name in _SHARES:
        return list(share_interval(sample.mean().item(), len(sample), confidence=confidence))
    low, high = mean_interval(sample, confidence=confidence)
    if name == "in_order_rate":
        low, high = numpy.clip(low, 0.0, 1.0), numpy.clip(high, 0.0, 1.0)
    return None if numpy.isnan(low) else [low.item(), high.item()]


def _mean(values: Tensor) -> float:
    return values.mean().item()
