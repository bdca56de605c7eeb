"""What both pictures and terminal text show of a frame: names, scales and lengths of bars, the caption."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple

from hdrqn_torchrl.rendering.frames import Decision, Frame, Pursuit
from hdrqn_torchrl.rendering.style import Colour

ACTION_COLOUR = (32, 32, 32)


class BarSpans(NamedTuple):
    """The difference that a full bar stands for, by level: bars show how far a Q-value lies below the best one.

    Q-values of actions differ by a hundredth (one step of discount) around a common level, so that bars from zero
    would all look the same.
    """

    action: float = 1.0
    subgoal: float = 1.0


def bar_spans(frames: Sequence[Frame]) -> BarSpans:
    """Round numbers that fit the Q-values of a recording: at least the median distance from best to worst.

    Examples:
        >>> bar_spans([])
        BarSpans(action=1.0, subgoal=1.0)
    """
    actions = _span(frame.action for frame in frames if not frame.outcome)
    farthest = [frame.pursuits[-1] for frame in frames if frame.pursuits]
    return BarSpans(actions, _span(pursuit.decision for pursuit in farthest if pursuit.steps == 0))


def _span(decisions: Iterable[Decision]) -> float:
    spreads = []
    for decision in decisions:
        values = [value for value, allowed in zip(decision.values, decision.allowed, strict=True) if allowed]
        if len(values) > 1:
            spreads.append(max(values) - min(values))
    if not spreads:
        return 1.0
    least = max(median(spreads), 1e-3)
    power = 10.0 ** math.floor(math.log10(least))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= least)


@dataclass(frozen=True)
class Level:
    """One level of a frame: its Q-values, what to write above them, their names, colours and scale."""

    verb: str
    symbol: str
    decision: Decision
    names: Sequence[str]
    colours: Sequence[Colour]
    span: float
    note: str = ""
    brief: bool = False
    """Whether it takes one line only: the choice, without bars."""

    def bar(self, index: int) -> float:
        """Length of a bar in [0, 1]: 1 for the best, 0 for a choice that is worse by ``span`` or more, or excluded."""
        if not self.decision.allowed[index]:
            return 0.0
        below = self.decision.values[self.decision.best] - self.decision.values[index]
        return min(max(1.0 - below / self.span, 0.0), 1.0)

    def remark(self, index: int) -> str:
        """Why a choice has no bar."""
        return "" if self.decision.allowed[index] else "not now"


def levels_of(frame: Frame, spans: BarSpans) -> list[Level]:
    """What each level decided, from the farthest subgoals to the action; those between are brief."""
    scene = frame.scene
    symbol, ink = "Q" if frame.subgoal is None else "Qˢ", [ACTION_COLOUR] * len(scene.action_names)
    note = _chance(frame.action)
    levels = [Level("does", symbol, frame.action, scene.action_names, ink, spans.action, note)]
    for nearer in frame.pursuits[:-1]:
        ink = [ACTION_COLOUR] * len(nearer.names)
        levels.insert(0, Level("by way of", "Q", nearer.decision, nearer.names, ink, 1.0, _note(nearer), brief=True))
    if frame.pursuits:
        farthest = frame.pursuits[-1]
        drawn = farthest.names == scene.subgoal_names
        ink = list(scene.subgoal_colours) if drawn else [ACTION_COLOUR] * len(farthest.names)
        levels.insert(0, Level("wants", "Qᴹ", farthest.decision, farthest.names, ink, spans.subgoal, _note(farthest)))
    return levels


def _note(pursuit: Pursuit) -> str:
    """Whether chance chose, and how long ago."""
    since = f"for {_count(pursuit.steps, 'step')}" if pursuit.steps else "just chosen"
    return " ".join(part for part in (_chance(pursuit.decision), since) if part)


def caption(frame: Frame) -> str:
    """What just happened, in one line."""
    told = [frame.event]
    if frame.outcome:
        told.append(f"{frame.outcome}, return {frame.score.total:.2f}")
    elif frame.subgoal is not None and frame.pursuits[-1].steps == 0:
        told.append(f"chooses {frame.pursuits[-1].name}")
    return "; ".join(part for part in told if part)


def _chance(decision: Decision) -> str:
    return "at random" if decision.explores else ""


def _count(number: int, noun: str) -> str:
    """``1 step``, ``2 steps``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
