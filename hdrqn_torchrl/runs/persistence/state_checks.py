"""Entries of a stored state are held against the environment's specs before anything is loaded.

A cell code, an action or a subgoal that does not exist is an index beyond a table, which ends the process or reads
memory that belongs to something else.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite
from torchrl.envs import EnvBase


class Rule(NamedTuple):
    """What an entry must be."""

    dtype: torch.dtype
    shape: tuple[int, ...]
    """After the batch dimensions."""
    values: int | None
    """It lies in [0, values); ``None``: it is not a choice."""


def rules_of(env: EnvBase) -> dict[str, Rule]:
    """Rules for the entries of an environment, by name.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> rules_of(MultiGoalGridEnv(num_envs=2, view=3))["observation"]
        Rule(dtype=torch.uint8, shape=(3, 3), values=5)
    """
    specs: list[Composite] = [
        env.full_observation_spec, env.full_state_spec, env.full_action_spec, env.full_reward_spec, env.full_done_spec
    ]  # fmt: skip
    rules = {}
    for spec in specs:
        for key, leaf in spec.items(True, True):
            values = leaf.space.n if type(leaf) is Categorical else None
            rules[_name(key)] = Rule(leaf.dtype, tuple(leaf.shape[len(env.batch_size) :]), values)
    return rules


def check_entries(state: Any, rules: Mapping[str, Rule], path: str = "") -> None:
    """Checks all entries of all TensorDicts in a state.

    Args:
        state: what a component is going to load.
        rules: see :func:`rules_of`; entries without one are skipped.
        path: where the state stands, for the message.

    Raises:
        ValueError: naming the first entry that is of another type or shape, or lies beyond its choices.
    """
    if isinstance(state, TensorDictBase):
        for key, value in state.items(True, True):
            if (rule := rules.get(_name(key))) is not None:
                _check_entry(value, rule, state.ndim, f"{path}/{'/'.join(key) if isinstance(key, tuple) else key}")
    elif isinstance(state, Mapping):
        for name, item in state.items():
            check_entries(item, rules, f"{path}/{name}")
    elif isinstance(state, (list, tuple)):
        for index, item in enumerate(state):
            check_entries(item, rules, f"{path}/{index}")


def _check_entry(value: Tensor, rule: Rule, batch_dims: int, path: str) -> None:
    shape = tuple(value.shape[batch_dims:])
    if value.dtype != rule.dtype or shape != rule.shape:
        wanted = f"{rule.dtype} {list(rule.shape)}"
        raise ValueError(f"{path[1:]} must be {wanted}, got {value.dtype} {list(shape)}; use another checkpoint.")
    if rule.values is not None and value.numel() and not 0 <= int(value.min()) <= int(value.max()) < rule.values:
        raise ValueError(
            f"{path[1:]} must lie in [0, {rule.values}), got {int(value.min())} to {int(value.max())}; use another one."
        )


def _name(key: Any) -> str:
    return key[-1] if isinstance(key, tuple) else key
