"""Specs that all environments share."""

from __future__ import annotations

import torch
from torchrl.data import Binary, Composite, Unbounded

from hdrqn_torchrl import keys


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
