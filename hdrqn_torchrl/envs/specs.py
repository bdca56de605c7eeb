"""Specs that all environments share."""

from __future__ import annotations

from itertools import groupby

import torch
from torchrl.data import Binary, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs.observations import code_sizes, observation_kind


def check_is_environment(env: EnvBase) -> None:
    """Refuses what is no TorchRL environment.

    Raises:
        ValueError: if it is something else.
    """
    if not isinstance(env, EnvBase):
        raise ValueError(
            f"env must be a TorchRL environment (EnvBase), got {env!r}; make an instance of a class, and wrap an "
            "environment of Gymnasium: GymWrapper(env, categorical_action_encoding=True)."
        )


def interface(env: EnvBase) -> dict[str, str]:
    """What the networks of an agent are made for: kind and shape of all that it sees and does, of one environment.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> interface(MultiGoalGridEnv(4, view=5))["action"]
        'int64 [] below 4'
        >>> from torchrl.data import MultiCategorical
        >>> _in_words(MultiCategorical([5, 5, 3], shape=(4, 3), dtype=torch.uint8), [3])
        'uint8 [3] below 5 (2 times), 3'
    """
    batch = len(env.batch_size)
    specs = {**dict(env.observation_spec.items(True, True)), **dict(env.full_action_spec.items(True, True))}
    return {
        ".".join(key) if isinstance(key, tuple) else key: _in_words(spec, list(spec.shape[batch:]))
        for key, spec in specs.items()
    }


def _in_words(spec: TensorSpec, shape: list[int]) -> str:
    below = ""
    if type(spec) is not Categorical and observation_kind(spec, shape) == "codes":
        runs = [(size, len(list(run))) for size, run in groupby(code_sizes(spec, shape))]
        below = " below " + ", ".join(f"{size} ({times} times)" if times > 1 else f"{size}" for size, times in runs)
    elif type(spec) is Categorical:  # not of flags
        below = f" below {spec.space.n}"
    return f"{str(spec.dtype).removeprefix('torch.')} {shape}{below}"


def interface_differences(env: EnvBase, other: EnvBase) -> str:
    """In words, what agents made for ``env`` would see or do otherwise in ``other``; empty if nothing."""
    before, after = interface(env), interface(other)
    return ", ".join(
        f"{key} is {after.get(key, 'missing')} instead of {before.get(key, 'missing')}"
        for key in {**before, **after}
        if before.get(key) != after.get(key)
    )


def flags(num_envs: int, size: int, *, device: torch.device | None = None) -> Binary:
    """``[N, size]`` bool."""
    return Binary(shape=(num_envs, size), dtype=torch.bool, device=device)


def rewards(num_envs: int, *, device: torch.device | None = None) -> Composite:
    """The two rewards of a step, ``[N, 1]`` each."""
    return Composite(
        {key: Unbounded(shape=(num_envs, 1), device=device) for key in (keys.REWARD, keys.EXTRINSIC_REWARD)},
        shape=(num_envs,),
        device=device,
    )


def episode_ends(num_envs: int, *, device: torch.device | None = None) -> Composite:
    """The flags of TorchRL's ``done_spec``, ``[N, 1]`` each."""
    return Composite(
        {key: flags(num_envs, 1, device=device) for key in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)},
        shape=(num_envs,),
        device=device,
    )
