"""What both pictures and terminal text say about a frame: names, scales and lengths of bars, the caption."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple

from hdrqn_torchrl.rendering.episodes import Decision, Frame
from hdrqn_torchrl.rendering.style import Colour

ACTION_COLOUR = (32, 32, 32)


class BarSpans(NamedTuple):
    """What the full length of a bar stands for, by level: bars show how far a Q-value lies below the best one.

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
    return BarSpans(actions, _span(frame.subgoal for frame in frames if frame.subgoal and frame.starts_option))


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

    def bar(self, index: int) -> float:
        """Length of a bar in [0, 1]: 1 for the best, 0 for what is worse by ``span`` or more, or excluded."""
        if not self.decision.allowed[index]:
            return 0.0
        below = self.decision.values[self.decision.best] - self.decision.values[index]
        return min(max(1.0 - below / self.span, 0.0), 1.0)

    def remark(self, index: int) -> str:
        """Why a choice has no bar."""
        return "" if self.decision.allowed[index] else "reached"


def levels_of(frame: Frame, spans: BarSpans) -> list[Level]:
    """What each level decided: the upper one first; flat agents have one only."""
    scene = frame.scene
    symbol, ink = "Q" if frame.subgoal is None else "Qˢ", [ACTION_COLOUR] * len(scene.action_names)
    levels = [Level("does", symbol, frame.action, scene.action_names, ink, spans.action, _chance(frame.action))]
    if frame.subgoal is not None:
        since = "just chosen" if frame.starts_option else f"for {_count(frame.score.option_steps, 'step')}"
        note = " ".join(part for part in (_chance(frame.subgoal), since) if part)
        names, colours = scene.subgoal_names, scene.subgoal_colours
        levels.insert(0, Level("wants", "Qᴹ", frame.subgoal, names, colours, spans.subgoal, note))
    return levels


def caption(frame: Frame) -> str:
    """What just happened, in one line."""
    told = [frame.event]
    if frame.outcome:
        told.append(f"{frame.outcome}, return {frame.score.total:.2f}")
    elif frame.subgoal is not None and frame.starts_option:
        told.append(f"chooses {frame.scene.subgoal_names[frame.subgoal.choice]}")
    return "; ".join(part for part in told if part)


def _chance(decision: Decision) -> str:
    return "at random" if decision.explores else ""


def _count(number: int, noun: str) -> str:
    """``1 step``, ``2 steps``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
