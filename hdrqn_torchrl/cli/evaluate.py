"""Evaluates a trained agent and prints one JSON object.

    python evaluate.py run=RUN_DIR [episodes=1000] [key=value ...]

    run             run folder
    checkpoint      best (default), last, or the path of a checkpoint or weights file
    episodes        episodes to play, rounded up to a multiple of num_envs (1000)
    num_envs        worlds that are played at the same time (250)
    seed            of the worlds (default: that of the run's own summary, evaluation.seed + 1). With the same seed,
                    num_envs and env.KEY episode i begins in the same world for every agent. The best checkpoint was
                    chosen in the worlds of evaluation.seed itself: there it looks better than it is
    max_steps       steps after which an episode is cut off, if it has not ended (the run's evaluation.max_steps)
    epsilon         probability of a random choice, at each level (0: greedy)
    env.KEY         setting of the task to change from the run's, e.g. env.view=3 env.layout=four_rooms
    out             file to write the object to as well
    figures         folder for pictures: how often options lead from one subgoal to another (legs.png) and, where
                    there is a screen, where the agent was (places.png)
    ceilings        report what scripted players achieve (true); where that has not been measured, they play first
    ceiling_seconds time limit for each of these players (the run's evaluation.ceiling_seconds)
    allowed_targets builders of your own that the run's settings may name, e.g. [my_package.MyEnv]

Each figure is a mean over episodes. "intervals" are 95 % intervals over the episodes of this one agent (t; of rates
Clopper and Pearson's; null where all episodes had the same value): they do not say how agents of other seeds would do.
"references" are what scripted players achieve on the same task, if it has any, and "ceiling" is the return of one of
them (on the grids: "memory", which has the agent's own view; "egocentric" must also find out where it is).
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import MISSING

from hdrqn_torchrl.cli.command_line import check_place, command_line, results_alone
from hdrqn_torchrl.runs.persistence.files import write_whole
from hdrqn_torchrl.runs.settings.arguments import SettingsError

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from hdrqn_torchrl.learning.legs import LegCounter
    from hdrqn_torchrl.runs import Agent


@dataclass
class Settings:
    """Arguments of the command line."""

    run: str = MISSING
    checkpoint: str = "best"
    episodes: int = 1000
    num_envs: int = 250
    seed: int | None = None
    max_steps: int | None = None
    epsilon: float = 0.0
    env: dict[str, Any] = field(default_factory=dict)
    out: str | None = None
    figures: str | None = None
    ceilings: bool = True
    ceiling_seconds: float | None = None
    threads: int = 1
    allowed_targets: list[str] = field(default_factory=list)


def run(settings: Settings) -> None:
    """Evaluates as asked and prints the result."""
    for name, least in (("episodes", 1), ("num_envs", 1), ("threads", 1)):
        if getattr(settings, name) < least:
            raise SettingsError(f"{name} must be >= {least}, got {getattr(settings, name)}.")
    if not 0.0 <= settings.epsilon <= 1.0:
        raise SettingsError(f"epsilon must lie in [0, 1], got {settings.epsilon}; 0 is greedy.")
    if settings.out is not None:
        check_place(Path(settings.out), "out")
    if settings.figures is not None:
        check_place(Path(settings.figures) / "legs.png", "figures")
    with results_alone():
        played, agent, observers = evaluate_run(settings)
    result = json.dumps(played, indent=2)
    print(result, flush=True)  # first: no later error can lose it
    try:
        if settings.out is not None:
            write_whole(Path(settings.out), result + "\n")
        if settings.figures is not None:
            draw(observers, agent, Path(settings.figures))
    except (OSError, ValueError) as error:
        raise SettingsError(f"out and figures must be places that can be written to ({error}).") from error


def evaluate_run(settings: Settings) -> tuple[dict[str, Any], Agent, dict[str, Any]]:
    """The result to print, the agent that played, and the counts made on the way."""
    import torch
    from torchrl.envs import ExplorationType

    from hdrqn_torchrl.analysis.episodes import summarise
    from hdrqn_torchrl.envs import task_of
    from hdrqn_torchrl.runs import load_agent
    from hdrqn_torchrl.runs.evaluation import play
    from hdrqn_torchrl.runs.references import ceiling_of, references_for

    torch.set_num_threads(settings.threads)
    agent = load_agent(
        settings.run,
        checkpoint=settings.checkpoint,
        num_envs=min(settings.num_envs, settings.episodes),
        env_changes=settings.env,
        allowed_targets=settings.allowed_targets,
    )
    for exploration in agent.algorithm.explorations.values():
        exploration.fixed = settings.epsilon
    greedy = settings.epsilon == 0.0
    seed = agent.config.evaluation.seed + 1 if settings.seed is None else settings.seed
    observers = observers_of(agent.env)
    try:
        played = play(
            agent.env,
            agent.algorithm.policy,
            episodes=settings.episodes,
            seed=seed,
            exploration_type=ExplorationType.DETERMINISTIC if greedy else ExplorationType.RANDOM,
            observers=list(observers.values()),
            max_steps=agent.config.evaluation.max_steps if settings.max_steps is None else settings.max_steps,
        )
    except ValueError as error:
        raise SettingsError(str(error)) from error
    task = task_of(agent.env.base_env)
    seconds = settings.ceiling_seconds or agent.config.evaluation.ceiling_seconds
    references = references_for(task, seconds=seconds, tell=tell) if settings.ceilings else {}
    result = {
        "run": settings.run,
        "checkpoint": settings.checkpoint,
        "frames": agent.frames,
        "env": agent.config.env,
        "seed": seed,
        "epsilon": settings.epsilon,
        **summarise(played, names=names_of(agent), nearer=task.subgoals[:-1]),
        **({"legs": legs_of(observers["legs"])} if "legs" in observers else {}),
        "ceiling": ceiling_of(references, task),
        "references": references,
    }
    return result, agent, observers


def tell(sentence: str) -> None:
    """Announces slow work on the terminal."""
    print(f"{sentence}; ceilings=false leaves that out", file=sys.stderr, flush=True)


def observers_of(env: EnvBase) -> dict[str, Any]:
    """What counts legs (of hierarchical agents) and places (where there is a screen)."""
    from hdrqn_torchrl import keys
    from hdrqn_torchrl.envs import task_of
    from hdrqn_torchrl.learning.legs import LegCounter
    from hdrqn_torchrl.runs.evaluation import PlaceCounter

    spec, screen = env.observation_spec, task_of(env.base_env).screen
    observers: dict[str, Any] = {}
    if spec.get(keys.OPTION_INIT, None) is not None:
        observers["legs"] = LegCounter(spec[keys.ATTAINED].shape[-1])
    if spec.get(keys.POSITION, None) is not None and screen is not None:
        observers["places"] = PlaceCounter(*screen(env.base_env).shape[:2])
    return observers


def legs_of(legs: LegCounter) -> dict[str, list]:
    """Counts ``[G + 1][G]``: from each subgoal, last from the start, to each."""
    return {"options": legs.options.tolist(), "reached": legs.reached.tolist()}


def names_of(agent: Agent) -> Sequence[str]:
    """Names of the farthest subgoals: those that the agent pursues or, if it pursues none, the task's."""
    from hdrqn_torchrl.envs import task_of

    levels, subgoals = agent.algorithm.levels, task_of(agent.env.base_env).subgoals
    own = tuple(levels[-1].choice_names) if levels else ()
    return own or (subgoals[-1].names if subgoals else ())


def draw(observers: dict[str, Any], agent: Agent, folder: Path) -> None:
    """Writes the pictures."""
    from hdrqn_torchrl.analysis.figures import plot_legs, plot_places
    from hdrqn_torchrl.envs import task_of

    if "legs" in observers:
        legs = observers["legs"]
        plot_legs(legs.options.numpy(), legs.reached.numpy(), names_of(agent), folder / "legs.png")
    base = agent.env.base_env
    screen = task_of(base).screen
    if "places" in observers and screen is not None:
        plot_places(observers["places"].counts.numpy(), screen(base), folder / "places.png")


def main() -> None:
    """Runs with the arguments of the command line."""
    command_line(Settings, __doc__, run)
