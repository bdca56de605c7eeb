"""Claims about groups of runs, held against their final results."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hdrqn_torchrl.estimates import RESAMPLES
from hdrqn_torchrl.results import Array

Results = Mapping[str, Mapping[str, Array]]
"""Final values ``[runs]`` by quantity (``return``, ``steps``, ...) and group."""
Names = str | Sequence[str]

AGREES, OPEN, DISAGREES = "agrees", "open", "disagrees"


@dataclass(frozen=True)
class Verdict:
    """What the runs say about a claim."""

    claim: str
    outcome: str
    """``agrees``, ``disagrees``, or ``open`` where the seeds do not tell; says if there is but one seed."""
    measured: str


class Claim(Protocol):
    """Something that can be held against results."""

    row: str | None
    """The row of a study that it is about; ``None``: its only one."""

    def check(self, results: Results) -> Verdict | None:
        """``None`` if groups that it is about have no results yet."""
        ...


def difference(above: Array, below: Array, confidence: float = 0.95) -> tuple[float, float, float]:
    """Difference of two means, with a bootstrap interval (both groups resampled, always in the same way).

    Args:
        above: final values of the first group ``[R]``.
        below: of the second ``[S]``.
        confidence: level of the interval.

    Examples:
        >>> difference(np.array([3.0, 3.0]), np.array([1.0]))
        (2.0, 2.0, 2.0)
    """
    generator = np.random.default_rng(0)
    means = [generator.choice(values, (RESAMPLES, len(values))).mean(1) for values in (above, below)]
    low, high = np.quantile(means[0] - means[1], [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(above.mean() - below.mean()), float(low), float(high)


@dataclass(frozen=True)
class Ordered:
    """Groups from the best to the worst; those in one list need not be ordered among themselves.

    Examples:
        >>> results = {"return": {"v2": np.array([1.6, 1.7]), "dqn": np.array([0.2, 0.3])}}
        >>> verdict = Ordered("return", ["v2", "dqn"]).check(results)
        >>> verdict.claim, verdict.outcome, verdict.measured
        ('v2 above dqn', 'agrees', 'v2 1.65, dqn 0.25')
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
        lows, highs = [], []
        for better, worse in itertools.pairwise(levels):
            for first in better:
                for second in worse:
                    _, low, high = difference(values[first], values[second])
                    lows.append(low)
                    highs.append(high)
        outcome = AGREES if min(lows) > 0 else DISAGREES if min(highs) < 0 else OPEN
        return _verdict(" above ".join(map(" and ".join, levels)), outcome, names, values)


@dataclass(frozen=True)
class Alike:
    """Two groups whose means differ by no more than ``within``, as far as the seeds tell.

    Examples:
        >>> Alike("return", ["a", "b"]).check({"return": {"a": np.array([1.6]), "b": np.array([1.65])}}).outcome
        'agrees (one seed)'
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
        mean, low, high = difference(first, second)
        apart = low > self.within or high < -self.within
        outcome = DISAGREES if apart else AGREES if abs(mean) <= self.within else OPEN
        return _verdict(" and ".join(self.groups) + " alike", outcome, self.groups, values)


@dataclass(frozen=True)
class Near:
    """A group's mean is about ``value``.

    Examples:
        >>> Near("steps", "v2", 22.0, within=1.5).check({"steps": {"v2": np.array([21.4])}}).measured
        'v2 21.4'
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
        near = abs(values[self.group].mean() - self.value) <= self.within
        claim = f"{self.group} takes about {self.value:g} {self.quantity}"
        return _verdict(claim, AGREES if near else DISAGREES, [self.group], values)


def _verdict(claim: str, outcome: str, names: Sequence[str], values: Mapping[str, Array]) -> Verdict:
    one_seed = min(len(values[name]) for name in names) == 1
    measured = ", ".join(f"{name} {values[name].mean():.3g}" for name in names)
    return Verdict(claim, f"{outcome} (one seed)" if one_seed else outcome, measured)
