"""Scripted players of the grid tasks: what full information, perfect memory and chance achieve.

A player is a policy for one :class:`~hdrqn_torchrl.envs.MultiGoalGridEnv`: it reads a tensordict and writes ``action``,
for all worlds at once. All but the random one follow cheapest paths (:mod:`~hdrqn_torchrl.envs.grid.planning`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from time import monotonic
from typing import Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.grid.environment import MultiGoalGridEnv
from hdrqn_torchrl.envs.grid.planning import plan
from hdrqn_torchrl.envs.grid.rules import ACTIONS
from hdrqn_torchrl.envs.grid.searching import EgocentricSearch, PerfectMemorySearch

_WORLDS = 250  # played at the same time: what is known of them then fits into a processor's cache

Player = Callable[[TensorDictBase], TensorDictBase]
PlayerName = Literal["planner", "memory", "egocentric", "random"]


class FullInformationPlanner:
    """Knows the whole state and walks the shortest way to the goals in their order.

    It avoids obstacles and later goals. Where an obstacle blocks every way it takes the -1, unless that costs more
    than the remaining goals bring; where later goals do, it gives up the order and collects what is left.

    Args:
        env: the environment it plays.

    Examples:
        >>> env = MultiGoalGridEnv(num_envs=8, seed=0)
        >>> rollout = env.rollout(50, FullInformationPlanner(env), break_when_any_done=False)
        >>> rollout["next", "hazard"].any().item()
        False
    """

    def __init__(self, env: MultiGoalGridEnv) -> None:
        self.env = env

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` ``[N]`` int64; reads nothing, the state is taken from the environment."""
        rules, state = self.env.rules, self.env.state
        collected = state.objects[:, rules.num_obstacles :] == rules.nowhere
        codes = rules.whole_map(state).flatten(1)
        return tensordict.set(keys.ACTION, plan(rules, state.agent, codes, collected, state.in_order))


class UniformRandom:
    """Chooses among the four actions with equal probability.

    Args:
        env: the environment it plays.
        seed: seed of its own random numbers.

    Examples:
        >>> env = MultiGoalGridEnv(num_envs=8, seed=0)
        >>> env.rollout(50, UniformRandom(env, seed=0), break_when_any_done=False)["action"].shape
        torch.Size([8, 50])
    """

    def __init__(self, env: MultiGoalGridEnv, seed: int = 0) -> None:
        self.env, self._generator = env, torch.Generator(env.device).manual_seed(seed)

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` ``[N]`` int64; reads nothing."""
        shape, device = (self.env.num_envs,), self.env.device
        return tensordict.set(keys.ACTION, torch.randint(len(ACTIONS), shape, generator=self._generator, device=device))


PLAYERS: dict[PlayerName, Callable[[MultiGoalGridEnv], Player]] = {
    "planner": FullInformationPlanner,
    "memory": PerfectMemorySearch,
    "egocentric": EgocentricSearch,
    "random": UniformRandom,
}


def play_episodes(env: MultiGoalGridEnv, player: Player, *, seconds: float | None = None) -> dict[str, float]:
    """Plays one episode in every world of ``env``.

    Args:
        env: the environment; it is reset first.
        player: any policy that writes ``action``.
        seconds: how long it may take; ``None``: as long as it takes.

    Returns:
        ``return_mean``, ``success_rate`` (share of episodes with all goals reached in order), ``steps_mean`` and
        ``episodes``.

    Raises:
        TimeoutError: if the time is up.

    Examples:
        >>> env = MultiGoalGridEnv(num_envs=8, seed=0)
        >>> played = play_episodes(env, FullInformationPlanner(env))
        >>> played["success_rate"], played["episodes"]
        (1.0, 8)
    """
    played = _play(env, player, _deadline(seconds))
    return _summary([played])


class _Played(NamedTuple):
    """One episode in each world, ``[N]`` each."""

    returns: Tensor
    success: Tensor
    steps: Tensor


def _play(env: MultiGoalGridEnv, player: Player, deadline: float) -> _Played:
    returns = torch.zeros(env.num_envs, dtype=torch.float64, device=env.device)
    steps, success = torch.zeros_like(returns), torch.zeros_like(returns)
    playing = torch.ones_like(returns)
    tensordict = env.reset()
    for _ in range(env.max_steps):
        if monotonic() > deadline:
            raise TimeoutError("the time for scripted players is up.")
        tensordict = env.step(player(tensordict))
        reward, done, won = (tensordict["next", key].squeeze(-1) for key in (keys.REWARD, keys.DONE, keys.SUCCESS))
        returns += playing * reward
        steps += playing
        success += playing * won
        playing *= ~done
        if not playing.any():
            break
        tensordict = step_mdp(tensordict)
    return _Played(returns, success, steps)


def _deadline(seconds: float | None) -> float:
    return math.inf if seconds is None else monotonic() + seconds


def _summary(played: list[_Played]) -> dict[str, float]:
    returns, success, steps = (torch.cat(column) for column in zip(*played, strict=True))
    return {
        "return_mean": returns.mean().item(),
        "success_rate": success.mean().item(),
        "steps_mean": steps.mean().item(),
        "episodes": len(returns),
    }


def scripted_ceiling(
    player: PlayerName = "planner",
    *,
    layout: str | Sequence[str] = "open",
    num_goals: int = 2,
    view: int | None = 5,
    max_steps: int = 50,
    obstacle: Literal["stay", "teleport"] = "stay",
    num_obstacles: int = 2,
    episodes: int = 1000,
    seed: int = 0,
    seconds: float | None = None,
) -> dict[str, float]:
    """What a scripted player achieves on a task, by simulation.

    Args:
        player: ``"planner"``, ``"memory"``, ``"egocentric"`` or ``"random"``.
        layout: as in :class:`~hdrqn_torchrl.envs.MultiGoalGridEnv`, like all up to ``num_obstacles``.
        num_goals: K.
        view: side of the window in cells; only the memory players look through it.
        max_steps: step limit of an episode.
        obstacle: ``"stay"`` or ``"teleport"``.
        num_obstacles: number of obstacles.
        episodes: number of episodes; they are played in batches.
        seed: seed of the worlds, which are the same for all players.
        seconds: how long it may take; ``None``: as long as it takes.

    Returns:
        ``return_mean``, ``success_rate`` (share of episodes with all goals reached in order), ``steps_mean`` and
        ``episodes``.

    Raises:
        ValueError: if an argument breaks its rule.
        TimeoutError: if the time is up.

    Examples:
        >>> scripted_ceiling("planner", episodes=100)["success_rate"]
        1.0
    """
    if player not in PLAYERS:
        raise ValueError(f"player must be one of {sorted(PLAYERS)}, got {player!r}.")
    if episodes < 1:
        raise ValueError(f"episodes must be >= 1, got {episodes}; use 1000 for an error of about 1 %.")
    deadline, played = _deadline(seconds), []
    for begun in range(0, episodes, _WORLDS):
        env = MultiGoalGridEnv(
            min(_WORLDS, episodes - begun),
            layout=layout,
            num_goals=num_goals,
            view=view,
            max_steps=max_steps,
            obstacle=obstacle,
            num_obstacles=num_obstacles,
            places=False,
            seed=seed + begun,
        )
        chosen = UniformRandom(env, seed + begun) if player == "random" else PLAYERS[player](env)
        played.append(_play(env, chosen, deadline))
    return _summary(played)
