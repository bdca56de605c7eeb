"""Records what an agent does, as a video, a sheet of its subgoals, or on the terminal: for watch.py and zoo.py."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import MISSING

from hdrqn_torchrl.cli.command_line import check_place
from hdrqn_torchrl.runs.persistence.files import replaced
from hdrqn_torchrl.runs.settings.arguments import SettingsError

if TYPE_CHECKING:
    from hdrqn_torchrl.rendering import Frame
    from hdrqn_torchrl.runs import Agent


@dataclass
class Settings:
    """What to record; :mod:`hdrqn_torchrl.cli.watch` explains the arguments."""

    run: str = MISSING
    out: str = "episode.gif"
    episodes: int = 3
    seed: int = 0
    checkpoint: str = "best"
    epsilon: float = 0.0
    fps: int = 4
    env: dict[str, Any] = field(default_factory=dict)
    allowed_targets: list[str] = field(default_factory=list)


def run(settings: Settings) -> None:
    """Plays, then shows or writes what was played."""
    path = None if settings.out == "terminal" else Path(settings.out)
    if path is not None:
        check_place(path, "out")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
    # torch and torchrl take seconds to load; --help does without them.
    import torch

    from hdrqn_torchrl.rendering import check_video, play_in_terminal

    torch.set_num_threads(1)
    try:
        is_sheet = path is not None and path.suffix.lower() == ".png"
        if not is_sheet:
            check_video(path, fps=settings.fps)
        frames, agent = record(settings)
        if path is not None and is_sheet:
            write_sheet(frames, path, agent)
            return
    except ValueError as error:
        raise SettingsError(str(error)) from error
    if path is not None:
        write(frames, path, settings.fps)
        return
    with suppress(KeyboardInterrupt):  # the user has seen enough
        play_in_terminal(frames, fps=settings.fps)


def record(settings: Settings) -> tuple[list[Frame], Agent]:
    """What the run's agent does, and the agent."""
    from hdrqn_torchrl.rendering import record_episodes
    from hdrqn_torchrl.runs import load_agent

    agent = load_agent(
        settings.run,
        checkpoint=settings.checkpoint,
        env_changes=settings.env,
        allowed_targets=settings.allowed_targets,
    )
    frames = record_episodes(
        agent.env,
        agent.algorithm,
        episodes=settings.episodes,
        seed=settings.seed,
        epsilon=settings.epsilon,
        max_steps=agent.config.evaluation.max_steps,
    )
    return frames, agent


def write(frames: list[Frame], path: Path, fps: int) -> None:
    """Writes a video that is whole or the one before; prints how the episodes ended."""
    from hdrqn_torchrl.rendering import write_video

    with replaced(path) as partial:
        write_video(frames, partial, fps=fps)
    for frame in frames:
        if frame.outcome:
            score = frame.score
            print(f"episode {frame.episode}: {frame.outcome}, return {score.total:.2f}, {score.steps} steps")
    print(f"{path}: {len(frames)} frames, {path.stat().st_size / 1000:.0f} kB")


def write_sheet(frames: list[Frame], path: Path, agent: Agent) -> None:
    """Writes a picture of the agent's subgoals that is whole or the one before."""
    from PIL import Image

    from hdrqn_torchrl.rendering import draw_sheet, subgoal_records

    with replaced(path) as partial:
        Image.fromarray(draw_sheet(subgoal_records(frames), found=agent.algorithm.found)).save(partial)
    print(f"{path}: {frames[-1].episode} episodes")
