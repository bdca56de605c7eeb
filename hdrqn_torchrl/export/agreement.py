"""Whether an exported decision is the policy's, in whole episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, ExplorationType

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs import task_of
from hdrqn_torchrl.export.step import NEXT, DecisionStep, name_of
from hdrqn_torchrl.modules import writing_values
from hdrqn_torchrl.modules.sizes import check_size
from hdrqn_torchrl.runs.evaluation import LONGEST_EPISODE
from hdrqn_torchrl.runs.isolation import isolated


@dataclass(frozen=True)
class Agreement:
    """What was found.

    Args:
        episodes: number of episodes.
        decisions: number of decisions in them.
        other_actions: number of decisions in which another action was chosen.
        largest_difference: of any Q-value of any level.
    """

    episodes: int
    decisions: int
    other_actions: int
    largest_difference: float


@torch.no_grad()
def agreement_with(
    decide: Callable[[Mapping[str, Tensor]], dict[str, Tensor]],
    step: DecisionStep,
    env: EnvBase,
    *,
    seed: int = 0,
    max_steps: int | None = None,
) -> Agreement:
    """Plays one greedy episode in each world, and asks an exported decision at every step for what it would do.

    Args:
        decide: the exported decision (:func:`~hdrqn_torchrl.export.load_step`).
        step: the agent's own, for the names of the inputs.
        env: environment ``[N]`` with the agent's transforms.
        seed: of the worlds.
        max_steps: steps after which an episode is cut off; ``None``: as the task has it.

    Examples:
        >>> from hdrqn_torchrl.algorithms import make_drqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> env = MultiGoalGridEnv(num_envs=2, max_steps=5)
        >>> agent = make_drqn(env, compact_network(8, (8,)))
        >>> step = DecisionStep(agent, agent.transform(env))
        >>> agreement_with(step, step, agent.transform(env)).other_actions  # or what load_step returns, then step
        0
    """
    if max_steps is not None:
        check_size("max_steps", max_steps, "None for whole episodes")
    policy = step.policy
    longest = max_steps or task_of(env).max_steps or LONGEST_EPISODE
    example = step.example()
    number = env.batch_size[0]
    state = {part.name: _zeros(example[part.name], number) for part in step.carried}
    given = {name_of(key): _zeros(example[name_of(key)], number) for key in step.observed}
    playing, decisions, others, largest = torch.ones(number, dtype=torch.bool), 0, 0, 0.0
    with isolated(env, policy, seed=seed, exploration_type=ExplorationType.DETERMINISTIC), writing_values(policy):
        tensordict = env.reset()
        for _ in range(longest):
            given |= _shown(step, tensordict)
            found = decide({**given, **state})
            tensordict, following = env.step_and_maybe_reset(policy(tensordict))
            others += int((found[keys.ACTION] != tensordict.get(keys.ACTION))[playing].sum())
            decisions += int(playing.sum())
            for level in step.levels:
                apart = found[name_of(level.value_key)] - tensordict.get(level.value_key)
                largest = max(largest, apart[playing].abs().max().item())
            state = {name: found[NEXT + name] for name in state}
            given |= _shown(step, tensordict.get("next"))  # rewards, which a root does not have
            playing = playing & ~tensordict.get(("next", keys.DONE)).squeeze(-1)
            tensordict = following
            if not playing.any():
                break
    return Agreement(number, decisions, others, largest)


def _shown(step: DecisionStep, tensordict: TensorDictBase) -> dict[str, Tensor]:
    """The inputs that are among the entries."""
    found = {name_of(key): tensordict.get(key, None) for key in step.observed}
    return {name: value for name, value in found.items() if value is not None}


def _zeros(like: Tensor, number: int) -> Tensor:
    return torch.zeros((number, *like.shape[1:]), dtype=like.dtype)
