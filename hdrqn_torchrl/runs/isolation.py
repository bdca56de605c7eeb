"""Playing during a training without leaving a trace in it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from hdrqn_torchrl.random_numbers import own_random_numbers


@contextmanager
def isolated(
    env: EnvBase, policy: TensorDictModuleBase, *, seed: int, exploration_type: ExplorationType
) -> Iterator[None]:
    """Seeds an environment and everything random; afterwards all of it but the environment is as it was before.

    That is: the random numbers of torch (on the CPU and on GPUs), numpy and Python; the policy's buffers, and which of
    its modules are in training mode. Inside, none is.

    Args:
        env: to be played in. It must not be the one that a training collects from, whose episodes would be lost.
        policy: plays.
        seed: of all random numbers inside.
        exploration_type: of the policy inside.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> env, policy = MultiGoalGridEnv(num_envs=2), TensorDictModule(nn.Identity(), ["observation"], ["action"])
        >>> before = torch.get_rng_state()
        >>> with isolated(env, policy, seed=3, exploration_type=ExplorationType.MODE):
        ...     _ = torch.rand(5)
        >>> torch.equal(torch.get_rng_state(), before)
        True
    """
    with set_exploration_type(exploration_type), own_random_numbers(seed), _untouched(policy):
        env.set_seed(seed)
        yield


@contextmanager
def _untouched(policy: nn.Module) -> Iterator[None]:
    """No module is in training mode; modes and buffers are brought back."""
    modes = [(module, module.training) for module in policy.modules()]
    buffers = [(buffer, buffer.clone()) for buffer in policy.buffers()]
    try:
        policy.eval()
        yield
    finally:
        for module, mode in modes:
            module.training = mode
        with torch.no_grad():
            for buffer, before in buffers:
                buffer.copy_(before)
