"""Agents that come trained: shows them, copies one, plays one, adds one, writes a page about them.

    python zoo.py list
    python zoo.py get NAME [out=FOLDER]
    python zoo.py watch NAME [out=episode.gif] [episodes=3] [seed=0]
    python zoo.py add NAME run=RUN_DIR [episodes=500] [checkpoint=best]
    python zoo.py page [out=docs/zoo.md]

list    what there is: task, algorithm, greedy figures with 95 % intervals over episodes
get     copies an agent to a folder of its own (default: its name), which evaluate, watch, export and init_from take as
        run=FOLDER, init_from=FOLDER/weights.safetensors
watch   records episodes, as watch.py does; out=terminal shows them at once
add     makes an agent of a run: its best weights, or with checkpoint=last its last (of 16 bits, if the greedy figures
        stay what they are), its settings, play.gif, and a card with the figures; it replaces an agent of this name
page    writes the table of all agents, with their pictures, into a page, between marks (default: docs/zoo.md beside
        the folder of the agents)

zoo             folder of the agents (that of the checkout)
allowed_targets builders of your own that an agent may name: [package.builder]

Nothing in such a folder can run code.
"""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hdrqn_torchrl.cli import recording
from hdrqn_torchrl.cli.command_line import check_place, command_line
from hdrqn_torchrl.cli.marks import put
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import write_whole
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.commands import as_called

ACTIONS = ("list", "get", "watch", "add", "page")
FOLDER = Path(__file__).parents[2] / "zoo"
MARK = "agents"
"""Of the part of a page that ``page`` writes."""


@dataclass
class Settings:
    """Arguments; the module's docstring explains them."""

    action: str = "list"
    name: str | None = None
    zoo: str = str(FOLDER)
    out: str | None = None
    run: str | None = None
    checkpoint: str = "best"
    episodes: int | None = None
    seed: int = 0
    allowed_targets: list[str] = field(default_factory=list)


def run(settings: Settings) -> None:
    """Does what the action says."""
    if settings.action not in ACTIONS:
        raise SettingsError(f"action must be one of {', '.join(ACTIONS)}, got {settings.action!r}.")
    if settings.episodes is not None and settings.episodes < 1:
        raise SettingsError(f"episodes must be >= 1, got {settings.episodes}.")
    {"list": show, "get": copy, "watch": watch, "add": add, "page": write_page}[settings.action](settings)


def show(settings: Settings) -> None:
    """One line for each agent."""
    from hdrqn_torchrl.runs.cards import cards_of

    for card in cards_of(Path(settings.zoo)):
        figures = "  ".join(
            f"{figure.partition('_')[0]} {value:.3g}{_interval(card.intervals[figure])}"
            for figure, value in card.figures.items()
        )
        print(f"{card.name:24} {card.task:28} {card.algo:5} {figures}")


def _interval(interval: list[float] | None) -> str:
    return "" if interval is None else f" [{interval[0]:.3g}, {interval[1]:.3g}]"


def folder_of(settings: Settings) -> Path:
    """The folder of the agent that is named."""
    folder = Path(settings.zoo) / str(settings.name)
    if settings.name is None or not (folder / layout.CARD).is_file():
        known = ", ".join(sorted(path.parent.name for path in Path(settings.zoo).glob(f"*/{layout.CARD}")))
        raise SettingsError(f"name must be one of {known or 'the agents of zoo=FOLDER'}, got {settings.name}.")
    return folder


def copy(settings: Settings) -> None:
    """Copies an agent."""
    folder = folder_of(settings)
    out = Path(settings.out or folder.name)
    if out.exists():
        raise SettingsError(f"out must be a new folder, got {out}; remove it, or name another one.")
    shutil.copytree(folder, out)
    print(as_called(f"python evaluate.py run={out} episodes=100"))


def watch(settings: Settings) -> None:
    """Records an agent, with the program that does so for runs."""
    recording.run(
        recording.Settings(
            run=str(folder_of(settings)),
            out=settings.out or recording.Settings.out,
            episodes=settings.episodes or recording.Settings.episodes,
            seed=settings.seed,
            allowed_targets=settings.allowed_targets,
        )
    )


def add(settings: Settings) -> None:
    """Makes an agent of a run."""
    if settings.run is None or settings.name is None:
        raise SettingsError("run and name must be given: add NAME run=RUN_DIR.")
    from hdrqn_torchrl.analysis.zoo import add_agent, check_new

    zoo = Path(settings.zoo)
    try:
        check_new(settings.name, zoo, Path(settings.run))
    except ValueError as error:
        raise SettingsError(str(error)) from error
    check_place(zoo / "agents", "zoo")
    try:
        card = add_agent(
            Path(settings.run),
            zoo,
            settings.name,
            checkpoint=settings.checkpoint,
            episodes=settings.episodes or 500,
            allowed_targets=settings.allowed_targets,
        )
    except (OSError, ValueError, KeyError) as error:
        raise SettingsError(f"run must be that of a finished training, got {settings.run} ({error}).") from error
    size = (zoo / settings.name / layout.WEIGHTS).stat().st_size
    print(f"{card.name}: {size / 1000:.0f} kB, {'16' if card.half else '32'} bits, {card.figures}")
    place = "" if zoo == FOLDER else f" zoo={shlex.quote(str(zoo))}"
    print(as_called(f"python zoo.py page{place}") + f"  # shows it in {zoo.parent / 'docs/zoo.md'}")


def write_page(settings: Settings) -> None:
    """Writes the part of a page that shows all agents."""
    from hdrqn_torchrl.analysis.gallery import gallery
    from hdrqn_torchrl.runs.cards import cards_of

    zoo = Path(settings.zoo)
    out = Path(settings.out or zoo.parent / "docs/zoo.md")
    check_place(out, "out")
    cards = cards_of(zoo)
    text = out.read_text() if out.exists() else "# Agents that come trained\n\n## The agents\n"
    write_whole(out, put(text, MARK, gallery(cards, Path(os.path.relpath(zoo, out.parent)).as_posix())))
    print(f"{out}: {', '.join(card.name for card in cards)}")


def as_settings(arguments: Sequence[str]) -> list[str]:
    """``key=value`` for the action and the name, which need no key.

    Examples:
        >>> as_settings(["get", "gridworld-v3", "out=agent"])
        ['action=get', 'name=gridworld-v3', 'out=agent']
    """
    words = [word for word in arguments if "=" not in word and not word.startswith("-")][:2]
    named = [f"{key}={word}" for key, word in zip(("action", "name"), words, strict=False)]
    return named + [argument for argument in arguments if argument not in words]


def main() -> None:
    """Runs with the arguments of the command line."""
    sys.argv[1:] = as_settings(sys.argv[1:])
    command_line(Settings, __doc__ or "", run)
