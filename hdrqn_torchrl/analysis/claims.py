"""Claims about groups of runs, checked against their final results.

A claim is decided by 95 % intervals of means and of their differences
(:mod:`~hdrqn_torchrl.analysis.intervals`), and ``open`` as long as these allow both outcomes: of claims about equal
groups no more than about 5 % are decided. Each claim is tested by itself; of twenty about equal groups, one may be
decided wrongly. One seed decides nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hdrqn_torchrl.analysis.intervals import CONFIDENCE, difference_interval, mean_interval
from hdrqn_torchrl.analysis.results import Array

Results = Mapping[str, Mapping[str, Array]]
"""Final values ``[runs]`` by quantity (``return``, ``steps``, ...) and group."""
Names = str | Sequence[str]

AGREES, OPEN, DISAGREES = "agrees", "open", "disagrees"


@dataclass(frozen=True)
class Verdict:
    """What the runs say about a claim."""

    claim: str
    outcome: str
    """``agrees``, ``disagrees``, or ``open`` where the seeds do not decide; notes a missing second seed."""
    measured: str
    """Means of the groups, with the half-widths of their intervals."""


class Claim(Protocol):
    """Something that can be checked against results."""

    @property
    def row(self) -> str | None:
        """The row of a study that it refers to; ``None``: its only one."""

    def check(self, results: Results) -> Verdict | None:
        """``None`` if groups that it is about have no results yet."""
        ...


@dataclass(frozen=True)
class Ordered:
    """Groups from the best to the worst; those in one list need not be ordered among themselves.

    Agrees if the interval of every difference lies above 0; that all must do so makes it a strict test. Disagrees if
    one lies below 0, where the intervals are widened for their number (Bonferroni).

    Examples:
        >>> results = {"return": {"v2": np.array([1.6, 1.7, 1.7]), "dqn": np.array([0.2, 0.3, 0.3])}}
        >>> verdict = Ordered("return", ["v2", "dqn"]).check(results)
        >>> verdict.claim, verdict.outcome, verdict.measured
        ('v2 above dqn', 'agrees', 'v2 1.67 ± 0.143, dqn 0.267 ± 0.143')
    """

    quantity: str
    groups: Sequence[Names]
    row: str | None = None

    def check(self, results: Results) -> Verdict | None:
        levels = [[names] if isinstance(names, str) else list(names) for names in self.groups]
        names = [name for level in levels for name in level]
        values = results.get(self.quantity, {})
        if not set(names) <= set(values):
            return None
        pairs = [
            (values[first], values[second])
            for better, worse in itertools.pairwise(levels)
            for first, second in itertools.product(better, worse)
        ]
        lows = [difference_interval(*pair)[0] for pair in pairs]
        highs = [difference_interval(*pair, confidence=1 - (1 - CONFIDENCE) / len(pairs))[1] for pair in pairs]
        outcome = AGREES if all(low > 0 for low in lows) else DISAGREES if any(high < 0 for high in highs) else OPEN
        return _verdict(" above ".join(map(" and ".join, levels)), outcome, names, values)


@dataclass(frozen=True)
class Alike:
    """Two groups whose means differ by no more than ``within``.

    Agrees if the whole interval of the difference lies within, disagrees if all of it lies beyond.

    Examples:
        >>> results = {"return": {"a": np.array([1.62, 1.63, 1.64]), "b": np.array([1.65, 1.66, 1.67])}}
        >>> Alike("return", ["a", "b"]).check(results).outcome
        'agrees'
    """

    quantity: str
    groups: Sequence[str]
    row: str | None = None
    within: float = 0.1

    def check(self, results: Results) -> Verdict | None:
        values = results.get(self.quantity, {})
        if not set(self.groups) <= set(values):
            return None
        first, second = (values[name] for name in self.groups)
        outcome = _within(difference_interval(first, second), self.within)
        return _verdict(" and ".join(self.groups) + f" alike (within {self.within:g})", outcome, self.groups, values)


@dataclass(frozen=True)
class Near:
    """A group's mean is about ``value``.

    Agrees if its whole interval lies within the tolerance, disagrees if all of it lies beyond. Means of skewed values
    that lie at the very edge are misjudged in up to 8 % of cases.

    Examples:
        >>> Near("steps", "v2", 22.0, within=1.5).check({"steps": {"v2": np.array([21.4, 21.5])}}).measured
        'v2 21.4 ± 0.635'
    """

    quantity: str
    group: str
    value: float
    within: float
    row: str | None = None

    def check(self, results: Results) -> Verdict | None:
        values = results.get(self.quantity, {})
        if self.group not in values:
            return None
        outcome = _within(mean_interval(values[self.group] - self.value), self.within)
        claim = f"{self.group} takes {self.value:g} {self.quantity} (within {self.within:g})"
        return _verdict(claim, outcome, [self.group], values)


def _within(interval: tuple[Array, Array], reach: float) -> str:
    """Whether an interval around 0 says that something is no further from it than ``reach``."""
    low, high = interval
    if low >= -reach and high <= reach:
        return AGREES
    return DISAGREES if low > reach or high < -reach else OPEN


def _verdict(claim: str, outcome: str, names: Sequence[str], values: Mapping[str, Array]) -> Verdict:
    one_seed = min(len(values[name]) for name in names) == 1
    measured = ", ".join(f"{name} {_mean_and_reach(values[name])}" for name in names)
    return Verdict(claim, f"{outcome} (one seed)" if one_seed else outcome, measured)


def _mean_and_reach(values: Array) -> str:
    reach = mean_interval(values)[1] - values.mean()
    return f"{values.mean():.3g}" if np.isnan(reach) else f"{values.mean():.3g} ± {reach:.3g}"
