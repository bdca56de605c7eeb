"""Evaluates a trained agent and prints one JSON object.

    python evaluate.py run=RUN_DIR [episodes=1000] [key=value ...]

    run             run folder
    checkpoint      best (default), last, or the path of a checkpoint or weights file
    episodes        episodes to play, rounded up to a multiple of num_envs (1000)
    num_envs        worlds that are played at the same time (250)
    seed            of the worlds; the same seed gives the same episodes (1_000_001, that of a run's own summary)
    epsilon         probability of a random choice, at each level (0: greedy)
    env.KEY         setting of the task that shall differ from the run's, e.g. env.view=3 env.layout=four_rooms
    out             file to write the object to as well
    allowed_targets own builders that the run's settings may name, e.g. [my_package.MyEnv]

Each figure is a mean over episodes; "intervals" are 95 % bootstrap intervals, "references" what scripted players
achieve on the same task ("memory" has the agent's own view: the ceiling; "egocentric" must also find out where it is).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import MISSING, OmegaConf

from configuration import SettingsError, command_line, load_agent


@dataclass
class Settings:
    """Arguments of the command line."""

    run: str = MISSING
    checkpoint: str = "best"
    episodes: int = 1000
    num_envs: int = 250
    seed: int = 1_000_001
    epsilon: float = 0.0
    env: dict[str, Any] = field(default_factory=dict)
    out: str | None = None
    threads: int = 1
    allowed_targets: list[str] = field(default_factory=list)


def main(settings: Settings) -> None:
    """Evaluates as asked and prints the result."""
    for name, least in (("episodes", 1), ("num_envs", 1), ("threads", 1)):
        if getattr(settings, name) < least:
            raise SettingsError(f"{name} must be >= {least}, got {getattr(settings, name)}.")
    if not 0.0 <= settings.epsilon <= 1.0:
        raise SettingsError(f"epsilon must lie in [0, 1], got {settings.epsilon}; 0 is greedy.")
    result = json.dumps(evaluate_run(settings), indent=2)
    print(result)
    if settings.out is not None:
        try:
            Path(settings.out).write_text(result + "\n")
        except OSError as error:
            raise SettingsError(f"out must be a file that can be written, got {settings.out} ({error}).") from error


def evaluate_run(settings: Settings) -> dict[str, Any]:
    """What is printed."""
    import torch
    from torchrl.envs import ExplorationType

    from hdrqn_torchrl.evaluation import play, summarise
    from hdrqn_torchrl.run_folder import ceiling_of, references_for

    torch.set_num_threads(settings.threads)
    agent = load_agent(
        settings.run,
        checkpoint=settings.checkpoint,
        num_envs=min(settings.num_envs, settings.episodes),
        env_changes=settings.env,
        allowed_targets=settings.allowed_targets,
    )
    for exploration in agent.algorithm.explorations.values():
        exploration.epsilon.fill_(settings.epsilon)
    greedy = settings.epsilon == 0.0
    played = play(
        agent.env,
        agent.algorithm.policy,
        episodes=settings.episodes,
        seed=settings.seed,
        exploration_type=ExplorationType.DETERMINISTIC if greedy else ExplorationType.RANDOM,
    )
    references = references_for(agent.env.base_env)
    return {
        "run": settings.run,
        "checkpoint": settings.checkpoint,
        "env": OmegaConf.to_container(agent.config.env, resolve=True),
        "seed": settings.seed,
        "epsilon": settings.epsilon,
        **summarise(played),
        "ceiling": ceiling_of(references),
        "references": references,
    }


if __name__ == "__main__":
    command_line(Settings, __doc__, main)
