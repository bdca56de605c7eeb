"""Agents that come trained: folders of settings, weights, a picture of play and a card with what they achieve.

Such a folder is read like that of a run: ``load_agent``, ``evaluate``, ``watch`` and ``export`` take it.
"""

from __future__ import annotations

import json
import math
import shlex
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from hdrqn_torchrl.analysis.commits import commits_of
from hdrqn_torchrl.analysis.episodes import summarise
from hdrqn_torchrl.rendering import excerpt, record_episodes, write_video
from hdrqn_torchrl.runs import Agent, load_agent, play, save_weights
from hdrqn_torchrl.runs.cards import Card
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import read_json, write_whole
from hdrqn_torchrl.runs.settings.stored_settings import read_settings

WORLDS = 50
"""Played at the same time."""
_OWN = (
    "hydra", "sweep", "output_root", "resume", "resume_override", "init_from", "init_checkpoint", "logger",
    "collector.address", "device", "seeds", "threads",
)  # fmt: skip
"""Settings of a command, with those below them, that only say where and how it ran."""
EPISODES, FRAMES, WIDTH = 3, 40, 440
"""Of ``play.gif``: episodes and frames at most, pixels."""
_FIGURES = ("return_mean", "success_rate", "steps_mean")


def score(agent: Agent, *, episodes: int, seed: int) -> dict[str, Any]:
    """What an agent achieves in greedy episodes (:func:`~hdrqn_torchrl.analysis.episodes.summarise`)."""
    limit = agent.config.evaluation.max_steps
    played = play(agent.env, agent.algorithm.policy, episodes=episodes, seed=seed, max_steps=limit)
    return summarise(played)


def disagreement(card: Card, scored: dict[str, Any]) -> list[str]:
    """Figures that differ from a card by more than four standard errors of both samples.

    Args:
        card: of the agent.
        scored: what :func:`score` found.
    """
    found = []
    for name, value in card.figures.items():
        interval = card.intervals[name]
        half_width = 0.01 * abs(value) if interval is None else max(abs(bound - value) for bound in interval)
        margin = 2 * half_width * (1 + math.sqrt(card.episodes / scored["episodes"]))
        if abs(scored[name] - value) > margin:
            found.append(f"{name} must be {value:.3f} within {margin:.3f}, got {scored[name]:.3f}")
    return found


def check_new(name: str, zoo: Path, run: Path) -> None:
    """Refuses a name for an agent whose folder would take the place of something else.

    Args:
        name: of the agent.
        zoo: folder of agents.
        run: that it is made of.

    Raises:
        ValueError: if it is not the name of one folder, or that folder is there and is no agent, or is or holds the
            run.
    """
    folder = zoo / name
    if Path(name).name != name or name == "..":
        raise ValueError(f"name must be that of one folder, got {name!r}; for example gridworld-v3.")
    if folder.resolve() in (run.resolve(), *run.resolve().parents):
        raise ValueError(f"name must not be that of the run's own folder, got {name!r}; its files would be lost.")
    is_agent = (folder / layout.CARD).is_file() and not folder.is_symlink()
    if folder.exists() and (not is_agent or layout.holds_training(folder)):
        raise ValueError(
            f"name must be a new one, or that of an agent, which is then replaced, got {name!r}: {folder} holds "
            "something else, which would be lost; choose another name."
        )


def add_agent(
    run: Path,
    zoo: Path,
    name: str,
    *,
    checkpoint: str = "best",
    episodes: int = 500,
    allowed_targets: Sequence[str] = (),
) -> Card:
    """Makes an agent of a run.

    Weights are rounded to 16 bits if the greedy figures in the same worlds then stay within the intervals of those of
    the run's own weights.

    Args:
        run: run folder.
        zoo: folder of agents.
        name: of the new one; an old one of this name is replaced.
        checkpoint: ``"best"``, ``"last"``, or the path of one.
        episodes: greedy episodes of its figures.
        allowed_targets: builders of your own that the run may name.

    Raises:
        ValueError: if the run can't be read, or by :func:`check_new`.
    """
    check_new(name, zoo, run)
    origin, summary = read_json(run / layout.ORIGIN), read_json(run / layout.SUMMARY)  # before minutes of play
    agent = load_agent(run, checkpoint=checkpoint, num_envs=WORLDS, allowed_targets=allowed_targets)
    seed = agent.config.evaluation.seed + 1
    full = score(agent, episodes=episodes, seed=seed)
    zoo.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=zoo) as place:  # an old agent stays whole until the new one is
        folder = Path(place) / name
        folder.mkdir()
        _write_settings(run, folder)
        for half in (True, False):
            save_weights(agent.algorithm.policy, folder / layout.WEIGHTS, half=half)
            again = load_agent(folder, num_envs=WORLDS, allowed_targets=allowed_targets)
            scored = score(again, episodes=episodes, seed=seed)
            if all(_within(full, scored, figure) for figure in _FIGURES if figure in full):
                break
        write_play(folder, seed=seed, allowed_targets=allowed_targets)
        card = _make_card(origin, summary, agent, name, half, seed, scored)
        write_whole(folder / layout.CARD, json.dumps(asdict(card), indent=2) + "\n")
        if (zoo / name).exists():
            shutil.rmtree(zoo / name)
        folder.rename(zoo / name)
    return card


def write_play(folder: Path, *, seed: int, allowed_targets: Sequence[str] = ()) -> None:
    """Writes ``play.gif``: an agent's greedy play, as ``watch.py`` shows it, in few frames.

    Args:
        folder: of the agent.
        seed: of the worlds.
        allowed_targets: builders of your own that it may name.
    """
    agent = load_agent(folder, allowed_targets=allowed_targets)
    limit = agent.config.evaluation.max_steps
    frames = record_episodes(agent.env, agent.algorithm, episodes=EPISODES, seed=seed, max_steps=limit)
    write_video(excerpt(frames, FRAMES), folder / layout.PLAY, width=WIDTH)


def training_command(overrides: Sequence[str], *, seed: int, total_frames: int) -> str:
    """The command that trains an agent again: of each setting the last value, without what is of the machine.

    Args:
        overrides: those of the run, in order.
        seed: of the run, which may be one of several that were trained together.
        total_frames: of the run, which may have been lengthened.

    Examples:
        >>> overrides = ["env=gym", "tau=1", "logger=csv", "tau=2", "env.wrappers=[mine.A]", "seeds=0..3"]
        >>> training_command(overrides, seed=2, total_frames=50_000)
        "hdrqn train env=gym tau=2 'env.wrappers=[mine.A]' seed=2 total_frames=50_000"
    """
    last: dict[str, str] = {}
    for override in overrides:
        key = override.partition("=")[0]
        last.pop(key, None)
        if not any(key.lstrip("+~") == own or key.lstrip("+~").startswith((f"{own}.", f"{own}/")) for own in _OWN):
            last[key] = override
    last |= {"seed": f"seed={seed}", "total_frames": f"total_frames={total_frames:_}"}
    return shlex.join(["hdrqn", "train", *last.values()])


def _within(full: dict[str, Any], scored: dict[str, Any], figure: str) -> bool:
    low, high = full["intervals"][figure] or (full[figure], full[figure])
    return low <= scored[figure] <= high


def _write_settings(run: Path, folder: Path) -> None:
    """The run's settings without what is of the machine it ran on."""
    settings = read_settings(run / layout.CONFIG)
    settings |= {"output_root": "outputs", "resume": None, "resume_override": False, "init_from": None}
    settings |= {"device": "auto", "threads": 1}
    settings |= {"collector": {"kind": "local"}, "logger": {"loggers": []}}
    write_whole(folder / layout.CONFIG, yaml.safe_dump(settings, sort_keys=False))


def _make_card(
    origin: dict[str, Any],
    summary: dict[str, Any],
    agent: Agent,
    name: str,
    half: bool,
    seed: int,
    scored: dict[str, Any],
) -> Card:
    env, choices = agent.config.env, origin.get("choices", {})
    figures = [figure for figure in _FIGURES if figure in scored]
    return Card(
        name=name,
        task=str(env.get("id") or choices.get("env")),
        algo=str(choices.get("algo")),
        command=training_command(
            origin.get("overrides", []), seed=agent.config.seed, total_frames=agent.config.total_frames
        ),
        commit=", ".join(commits_of(origin)),
        seed=agent.config.seed,
        frames=int(summary["frames"]),
        half=half,
        episodes=scored["episodes"],
        worlds_seed=seed,
        figures={figure: round(scored[figure], 4) for figure in figures},
        intervals={figure: _rounded(scored["intervals"][figure]) for figure in figures},
    )


def _rounded(interval: list[float] | None) -> list[float] | None:
    return None if interval is None else [round(bound, 4) for bound in interval]
