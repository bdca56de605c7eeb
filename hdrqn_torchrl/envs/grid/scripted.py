"""Scripted players of the grid tasks: what full information, perfect memory and chance achieve.

A player is a policy for one :class:`~hdrqn_torchrl.envs.MultiGoalGridEnv`: it reads a tensordict and writes ``action``,
for all worlds at once. All but the random one follow cheapest paths (:mod:`~hdrqn_torchrl.envs.grid.planning`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import step_mdp

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.grid.environment import MultiGoalGridEnv
from hdrqn_torchrl.envs.grid.planning import plan
from hdrqn_torchrl.envs.grid.rules import ACTIONS
from hdrqn_torchrl.envs.grid.searching import EgocentricSearch, PerfectMemorySearch

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


def play_episodes(env: MultiGoalGridEnv, player: Player) -> dict[str, float]:
    """Plays one episode in every world of ``env``.

    Args:
        env: the environment; it is reset first.
        player: any policy that writes ``action``.

    Returns:
        ``return_mean``, ``success_rate`` (share of episodes with all goals reached in order), ``steps_mean`` and
        ``episodes``.
    """
    returns = torch.zeros(env.num_envs, dtype=torch.float64, device=env.device)
    steps, success = torch.zeros_like(returns), torch.zeros_like(returns)
    playing = torch.ones_like(returns)
    tensordict = env.reset()
    for _ in range(env.max_steps):
        tensordict = env.step(player(tensordict))
        reward, done, won = (tensordict["next", key].squeeze(-1) for key in (keys.REWARD, keys.DONE, keys.SUCCESS))
        returns += playing * reward
        steps += playing
        success += playing * won
        playing *= ~done
        if not playing.any():
            break
        tensordict = step_mdp(tensordict)
    return {
        "return_mean": returns.mean().item(),
        "success_rate": success.mean().item(),
        "steps_mean": steps.mean().item(),
        "episodes": env.num_envs,
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
        episodes: number of episodes, all played at once.
        seed: seed of the worlds.

    Returns:
        ``return_mean``, ``success_rate`` (share of episodes with all goals reached in order), ``steps_mean`` and
        ``episodes``.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> scripted_ceiling("planner", episodes=100)["success_rate"]
        1.0
    """
    if player not in PLAYERS:
        raise ValueError(f"player must be one of {sorted(PLAYERS)}, got {player!r}.")
    if episodes < 1:
        raise ValueError(f"episodes must be >= 1, got {episodes}; use 1000 for an error of about 1 %.")
    env = MultiGoalGridEnv(
        episodes,
        layout=layout,
        num_goals=num_goals,
        view=view,
        max_steps=max_steps,
        obstacle=obstacle,
        num_obstacles=num_obstacles,
        seed=seed,
    )
    return play_episodes(env, PLAYERS[player](env))
