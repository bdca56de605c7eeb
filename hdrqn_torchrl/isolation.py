"""Playing beside a training without leaving a trace in it."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import numpy
import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type


@contextmanager
def isolated(
    env: EnvBase, policy: TensorDictModuleBase, *, seed: int, exploration_type: ExplorationType
) -> Iterator[None]:
    """Seeds an environment and everything random; afterwards all of it but the environment is as it was before.

    That is: the random numbers of torch (on the CPU and on the devices of environment and policy), numpy and Python;
    the policy's buffers, and which of its modules are in training mode. Inside, none is.

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
    tensors = [*policy.parameters(), *policy.buffers()]
    devices = {tensor.device for tensor in tensors} | ({env.device} if env.device is not None else set())
    with set_exploration_type(exploration_type), _own_random_numbers(seed, devices), _untouched(policy):
        env.set_seed(seed)
        yield


@contextmanager
def _own_random_numbers(seed: int, devices: Iterable[torch.device]) -> Iterator[None]:
    """Random numbers from a seed, on these devices and on the host; then the streams go on where they were."""
    generators = generators_of(devices)
    states, of_python, of_numpy = [each.get_state() for each in generators], random.getstate(), numpy.random.get_state()
    try:
        for generator in generators:
            generator.manual_seed(seed)
        random.seed(seed)
        numpy.random.seed(seed % 2**32)
        yield
    finally:
        for generator, state in zip(generators, states, strict=True):
            generator.set_state(state)
        random.setstate(of_python)
        numpy.random.set_state(of_numpy)


def generators_of(devices: Iterable[torch.device]) -> list[torch.Generator]:
    """Torch's own generators on the host and on GPUs. (``torch.manual_seed`` reseeds those of all GPUs there are.)"""
    gpus = [device for device in devices if device.type == "cuda"]
    indices = {torch.cuda.current_device() if device.index is None else device.index for device in gpus}
    return [torch.default_generator, *(torch.cuda.default_generators[index] for index in sorted(indices))]


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
