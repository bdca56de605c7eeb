"""Agents that come trained, as Markdown: a table of what each achieves, and how each plays."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hdrqn_torchrl.analysis.commits import short_commit
from hdrqn_torchrl.runs.cards import Card
from hdrqn_torchrl.runs.persistence import layout

HEADER = (
    "| agent | task | algorithm | frames | seed | commit | return | success | steps | episodes |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def gallery(cards: Sequence[Card], zoo: str) -> str:
    """Table, pictures and commands of agents.

    Args:
        cards: of the agents.
        zoo: their folder, as a link from the page leads to it.
    """
    rows = "\n".join(row(card) for card in cards)
    return "\n\n".join([f"{HEADER}\n{rows}", *(section(card, zoo) for card in cards)])


def row(card: Card) -> str:
    """Line of the table."""
    cells = (
        *(f"[{card.name}](#{card.name})", card.task, card.algo, f"{card.frames / 1000:.0f}k", card.seed),
        ", ".join(map(short_commit, card.commit.split(", "))),
        *(shown(card, "return_mean"), shown(card, "success_rate", "{:.1%}"), shown(card, "steps_mean", "{:.1f}")),
        card.episodes,
    )
    return f"| {' | '.join(map(str, cells))} |"


def shown(card: Card, figure: str, form: str = "{:.4g}") -> str:
    """A figure with its interval, if the task has it and its episodes differ.

    Args:
        card: of the agent.
        figure: its name.
        form: of each number.
    """
    if figure not in card.figures:
        return ""
    write: Callable[[float], str] = form.format
    value, interval = write(card.figures[figure]), card.intervals[figure]
    return value if interval is None else f"{value} ({write(interval[0])} to {write(interval[1])})"


def section(card: Card, zoo: str) -> str:
    """How an agent plays, and the command that trains it again."""
    picture = f"![Greedy play of {card.name}]({zoo}/{card.name}/{layout.PLAY})"
    return f"### {card.name}\n\n{picture}\n\n```text\n{card.command}\n```"
