"""Cards of agents that come trained: what each is, and what it achieves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import read_json
from hdrqn_torchrl.runs.settings.arguments import SettingsError


@dataclass(frozen=True, kw_only=True)
class Card:
    """What is known of an agent.

    Args:
        name: its folder.
        task: of the environment: its layout or id.
        algo: algorithm.
        command: that trained it.
        commit: of the code that did.
        seed: of the training.
        frames: of the training.
        half: whether its weights have 16 bits.
        episodes: greedy episodes that its figures are means of.
        worlds_seed: of their worlds, 50 at a time.
        figures: ``return_mean``, ``success_rate``, ``steps_mean``, as far as the task has them.
        intervals: of each, 95 % over episodes; ``None`` where all were equal.
    """

    name: str
    task: str
    algo: str
    command: str
    commit: str
    seed: int
    frames: int
    half: bool
    episodes: int
    worlds_seed: int
    figures: dict[str, float]
    intervals: dict[str, list[float] | None]


def cards_of(zoo: Path) -> list[Card]:
    """Cards of all agents of a folder, by name.

    Raises:
        SettingsError: if it has none, or one can't be read.
    """
    found = sorted(zoo.glob(f"*/{layout.CARD}")) if zoo.is_dir() else []
    if not found:
        raise SettingsError(f"zoo must be a folder of trained agents, got {zoo}; a checkout has one, zoo/.")
    return [_card(path) for path in found]


def _card(path: Path) -> Card:
    try:
        return Card(**read_json(path))
    except (TypeError, ValueError) as error:
        raise SettingsError(f"{path} must be the card of an agent ({error}).") from error
