"""Draws docs/options.svg: ``python docs/drawings.py`` after a change."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

STEPS, STARTS = 12, (0, 5, 9)  # of an episode, and where its options begin
ROWS = {"DRQN": 3.0, "hDRQNv1": 2.0, "hDRQNv2": 1.0, "hDRQNv3": 0.0}
SUB, META, BOTH, INK = "#4c78a8", "#d9822b", "#54a24b", "#333333"


def bar(axes: Axes, start: float, end: float, height: float, colour: str, text: str) -> None:
    """A memory that lasts from one step to another."""
    axes.barh(height, end - start - 0.12, left=start + 0.06, height=0.24, color=colour)
    axes.text((start + end) / 2, height, text, ha="center", va="center", color="white", fontsize=8)


def draw(axes: Axes) -> None:
    """The memories of each algorithm in one episode of three options."""
    ends = (*STARTS[1:], STEPS)
    for number, (start, end) in enumerate(zip(STARTS, ends, strict=True)):
        axes.axvspan(start, end, color="#f3f3f3" if number % 2 else "#e8e8e8", lw=0)
        axes.text(
            (start + end) / 2, 3.98, f"option {number + 1}: subgoal {'ABA'[number]}", ha="center", fontsize=9, color=INK
        )
    for step in range(STEPS):
        axes.plot(step + 0.5, 3.62, "o", color=INK, ms=4)
    axes.text(-0.25, 3.62, "steps: observation, action", ha="right", va="center", fontsize=8, color=INK)
    bar(axes, 0, STEPS, ROWS["DRQN"], SUB, "one memory of all steps, no subgoals")
    for name in ("hDRQNv1", "hDRQNv2"):
        low = ROWS[name] - 0.18
        for number, (start, end) in enumerate(zip(STARTS, ends, strict=True)):
            bar(axes, start, end, low, SUB, "sub" if number else "sub: empty where an option begins")
            axes.plot([start + 0.3], [low + 0.4], "s", color=META, ms=9)
        axes.plot([start + 0.3 for start in STARTS], [low + 0.4] * 3, color=META, lw=2)
        axes.text(2.8, low + 0.54, "meta: one step for each option", ha="center", va="center", fontsize=8, color=META)
    for start in STARTS:
        axes.annotate(
            "", (start + 0.3, 2.32), (start + 0.3, 2.8), arrowprops={"arrowstyle": "->", "color": META, "lw": 1.2}
        )
    for start in STARTS[1:]:
        axes.annotate(
            "", (start + 0.22, 1.15), (start - 0.1, 0.94), arrowprops={"arrowstyle": "->", "color": META, "lw": 1.6}
        )
    bar(axes, 0, STEPS, ROWS["hDRQNv3"], BOTH, "one memory of all steps, which all levels read")
    for start in STARTS:
        axes.plot([start + 0.3], [0.3], "s", color=META, ms=9)
    for name, height in ROWS.items():
        axes.text(-0.25, height, name, ha="right", va="center", fontsize=10, weight="bold", color=INK)
    notes = {"hDRQNv1": "meta reads the observation", "hDRQNv2": "meta reads the state that sub ends with"}
    notes["hDRQNv3"] = "each level has a head"
    for name, note in notes.items():
        axes.text(-0.25, ROWS[name] - 0.24, note, ha="right", va="center", fontsize=8, color=INK)
    axes.set(xlim=(-4.2, STEPS), ylim=(-0.45, 4.25))
    axes.axis("off")


def main() -> None:
    """Writes the file."""
    plt.rcParams["svg.fonttype"] = "none"
    plt.rcParams["svg.hashsalt"] = "options"
    figure, axes = plt.subplots(figsize=(10, 4.2), layout="constrained")
    draw(axes)
    figure.savefig(Path(__file__).parent / "options.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
