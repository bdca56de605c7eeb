"""Scores the subgoals that a training has found so far, while its agent plays.

    python benchmarks/discovery/trained.py run=RUN_DIR frames=20_000

run         folder of a training with algo.subgoals=discovered
frames      steps of all worlds together (default 20,000)
checkpoint  last (default), best, or a path
epsilon     probability of a random choice, at every level (default: that of the checkpoint; 0: greedy)
num_envs    number of worlds (default 32)
seed        of the worlds and the actions (default 1)

The environment's own ``attained`` is renamed before the agent's transforms, so that nothing of the agent can read it,
and compared with what the agent says. See matching.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from matching import matches, show
from omegaconf import MISSING
from torchrl.envs import ExplorationType, TransformedEnv
from torchrl.envs.transforms import RenameTransform

from hdrqn_torchrl import keys
from hdrqn_torchrl.cli.command_line import command_line
from hdrqn_torchrl.envs import task_of
from hdrqn_torchrl.runs import load_agent
from hdrqn_torchrl.runs.isolation import isolated
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.building import build_env

TOLD = "told"


@dataclass
class Settings:
    """Arguments; the module's docstring explains them."""

    run: str = MISSING
    frames: int = 20_000
    checkpoint: str = "last"
    epsilon: float | None = None
    num_envs: int = 32
    seed: int = 1


def run(settings: Settings) -> None:
    """Plays and scores."""
    torch.set_num_threads(1)
    agent = load_agent(settings.run, checkpoint=settings.checkpoint, num_envs=settings.num_envs)
    if agent.algorithm.found is None:
        raise SettingsError(f"run must be of an agent that finds its subgoals, got {settings.run}; theirs are given.")
    for exploration in agent.algorithm.explorations.values():
        exploration.fixed = settings.epsilon
    world = build_env(agent.config, {"num_envs": settings.num_envs, "device": "cpu"})
    names = task_of(world).subgoals[-1].names
    env = agent.algorithm.transform(TransformedEnv(world, RenameTransform([keys.ATTAINED], [TOLD])))
    policy, steps = agent.algorithm.policy, []
    with torch.no_grad(), isolated(env, policy, seed=settings.seed, exploration_type=ExplorationType.RANDOM):
        state = env.reset()
        for _ in range(settings.frames // settings.num_envs):
            step, state = env.step_and_maybe_reset(policy(state))
            steps.append(step.get("next").select(TOLD, keys.ATTAINED, keys.DONE).clone())
    played = torch.stack(steps, 1)
    matched, found = matches(
        played[TOLD],
        played[keys.ATTAINED],
        played[keys.DONE].squeeze(-1),
        names=names,
        events=list(agent.algorithm.levels[-1].choice_names),
    )
    show(matched, found, run=settings.run, frames=played.numel(), found_after=agent.algorithm.found)


if __name__ == "__main__":
    command_line(Settings, __doc__ or "", run)
