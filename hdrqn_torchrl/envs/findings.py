"""Findings of the check of an environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


class ReturnError(ValueError):
    """An environment returned what its spaces, or the rules of Gymnasium, do not allow."""


@dataclass(frozen=True)
class Finding:
    """Something that an environment does wrong or lacks.

    Attributes:
        what: the fault or the gap.
        severity: ``"wrong"``: against the contract; ``"missing"``: agents can do without it.
        costs: what that costs.
    """

    what: str
    severity: Literal["wrong", "missing"]
    costs: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.what} ({self.costs})"


def wrong(what: str, costs: str) -> Finding:
    """Something against the contract for tasks."""
    return Finding(what, "wrong", costs)


def missing(what: str, costs: str) -> Finding:
    """Something that agents can do without."""
    return Finding(what, "missing", costs)
