"""Scores what is found in random play.

    python benchmarks/discovery/random_play.py task=doorkey seed=1

task      room, gridworld2, gridworld3, obstacles, four_rooms, doorkey or corridor
seed      of the worlds and the actions (default 1)
frames    steps of all worlds together (default: those of docs/discovery.md)
choice    useful (default), random_events or random_changes

Detector and selection are those of a training with default settings but for the warm-up. All steps are scored, those of
the warm-up, too, by the environment's own ``attained``, which neither of the two sees. See matching.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from matching import matches, show
from omegaconf import MISSING
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.cli.command_line import command_line
from hdrqn_torchrl.discovery import DiscoverySettings, EventCritic
from hdrqn_torchrl.envs import MultiGoalGridEnv, make_minigrid, task_of
from hdrqn_torchrl.runs.settings.arguments import SettingsError

_ROOM = ("#####", "#   #", "#   #", "#   #", "#####")
_STEPS = 20  # of a batch, as in a training


class Play(NamedTuple):
    """A task for random play, and how much of it."""

    make: Callable[[int], EnvBase]
    frames: int
    warmup_frames: int


TASKS = {
    "room": Play(
        lambda seed: MultiGoalGridEnv(32, layout=_ROOM, num_obstacles=0, max_steps=16, view=3, seed=seed), 9_600, 2_000
    ),
    "gridworld2": Play(lambda seed: MultiGoalGridEnv(64, seed=seed), 38_400, 4_000),
    "gridworld3": Play(lambda seed: MultiGoalGridEnv(64, num_goals=3, seed=seed), 38_400, 4_000),
    "obstacles": Play(lambda seed: MultiGoalGridEnv(64, obstacle="teleport", seed=seed), 38_400, 4_000),
    "four_rooms": Play(lambda seed: MultiGoalGridEnv(64, layout="four_rooms", seed=seed), 38_400, 4_000),
    "doorkey": Play(lambda seed: make_minigrid("MiniGrid-DoorKey-8x8-v0", 32, seed=seed), 64_000, 6_000),
    "corridor": Play(lambda seed: make_minigrid("BabyAI-KeyCorridorS3R3-v0", 32, seed=seed), 96_000, 6_000),
}


@dataclass
class Settings:
    """Arguments; the module's docstring explains them."""

    task: str = MISSING
    seed: int = 1
    frames: int = 0
    choice: str = "useful"


def random_play(env: EnvBase, frames: int, seed: int) -> TensorDictBase:
    """Steps with actions of the same probability, ``[N, T]``."""
    generator, state, steps = torch.Generator().manual_seed(seed), env.reset(), []
    for _ in range(frames // env.batch_size[0]):
        state[keys.ACTION] = torch.randint(env.action_spec.space.n, env.batch_size, generator=generator)
        step, state = env.step_and_maybe_reset(state)
        steps.append(step)
    return torch.stack(steps, 1)


def events(critic: EventCritic, steps: TensorDictBase) -> Tensor:
    """Tokens of steps, ``[N, T, K]``."""
    after = steps.get("next")
    reward = after[keys.EXTRINSIC_REWARD]
    return critic.detector(steps[keys.OBSERVATION], steps[keys.ACTION], after[keys.OBSERVATION], reward)


def run(settings: Settings) -> None:
    """Plays, discovers, scores."""
    if settings.task not in TASKS:
        raise SettingsError(f"task must be one of {', '.join(TASKS)}, got {settings.task}.")
    torch.set_num_threads(1)
    torch.manual_seed(settings.seed)
    task = TASKS[settings.task]
    env = task.make(settings.seed)
    steps = random_play(env, settings.frames or task.frames, settings.seed)
    discovery = DiscoverySettings(warmup_frames=task.warmup_frames, choice=settings.choice)  # type: ignore[arg-type]
    critic, selection = discovery.make(env.observation_spec[keys.OBSERVATION], env.action_spec.space.n)
    for batch in steps.split(_STEPS, 1):
        critic.detector.observe(batch[keys.OBSERVATION], batch[keys.ACTION], batch["next", keys.OBSERVATION])
    after = steps.get("next").set(keys.EVENTS, torch.cat([events(critic, each) for each in steps.split(_STEPS, 1)], 1))
    for batch in steps.split(_STEPS, 1):
        selection.observe(batch)
    chosen = selection.update()
    critic.table.assign(chosen.slots, once=chosen.once)
    matched, found = matches(
        after[keys.ATTAINED],
        critic.table.attained(after[keys.EVENTS]),
        after[keys.DONE].squeeze(-1),
        names=task_of(env).subgoals[-1].names,
        events=list(critic.names),
    )
    show(matched, found, task=settings.task, seed=settings.seed, frames=steps.numel(), once=list(chosen.once))


if __name__ == "__main__":
    command_line(Settings, __doc__ or "", run)
