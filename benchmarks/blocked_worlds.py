"""Where a trained agent of a grid task loses reward: ``python benchmarks/blocked_worlds.py run=RUN_DIR``.

In some worlds an obstacle or a later goal stands on every way, so that even a player who sees all of it loses reward or
does not finish. The agent's greedy episodes are told apart by what that player earned in the same worlds. Prints one
JSON line for each kind of world: its share, and the agent's and the player's averages there.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass

import torch
from omegaconf import MISSING
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.cli.command_line import command_line
from hdrqn_torchrl.envs import FullInformationPlanner, MultiGoalGridEnv
from hdrqn_torchrl.runs import load_agent
from hdrqn_torchrl.runs.evaluation import play
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.building import build_env


@dataclass
class Settings:
    """Arguments; the module's docstring explains them."""

    run: str = MISSING
    checkpoint: str = "last"
    episodes: int = 1000
    num_envs: int = 250
    seed: int = 1_000_001


class Scripted(TensorDictModuleBase):
    """A scripted player as a policy."""

    def __init__(self, player: Callable[[TensorDictBase], TensorDictBase]) -> None:
        super().__init__()
        self.in_keys: list[str] = []
        self.out_keys, self.player = [keys.ACTION], player

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action``."""
        return self.player(tensordict)


def averages(played: TensorDictBase, chosen: Tensor) -> dict[str, float]:
    """Of the chosen episodes."""
    names = ("return", "success", "steps")
    return {name: round(played[name].flatten()[chosen].double().mean().item(), 3) for name in names}


def run(settings: Settings) -> None:
    """Plays and compares."""
    torch.set_num_threads(1)
    agent = load_agent(settings.run, checkpoint=settings.checkpoint, num_envs=settings.num_envs)
    world = build_env(agent.config, {"num_envs": settings.num_envs, "device": "cpu"})
    if not isinstance(world, MultiGoalGridEnv):
        raise SettingsError(f"run must be of a grid task, got {settings.run}; others have no player who sees all.")
    best = play(world, Scripted(FullInformationPlanner(world)), episodes=settings.episodes, seed=settings.seed)
    own_world = agent.algorithm.transform(world)
    own = play(own_world, agent.algorithm.policy, episodes=settings.episodes, seed=settings.seed)
    blocked = best["return"].flatten() < world.rules.num_goals - 0.5
    for name, chosen in (("open", ~blocked), ("blocked", blocked)):
        told = {"worlds": name, "share": round(chosen.double().mean().item(), 3)}
        print(json.dumps(told | {"agent": averages(own, chosen), "sees_all": averages(best, chosen)}))


if __name__ == "__main__":
    command_line(Settings, __doc__ or "", run)
