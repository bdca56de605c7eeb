"""Pools of EnvPool: whether it has an environment, and how one is made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hdrqn_torchrl.envs.gym.arguments import settings_error


def spec_of(id: Any, num_envs: int, settings: Mapping[str, Any]) -> Any:
    """EnvPool's specification of N worlds.

    Raises:
        ImportError: if EnvPool is missing.
        ValueError: if it does not have the environment, the settings are not taken, or several players play.
    """
    try:
        import envpool
    except ImportError as error:
        raise ImportError("backend='envpool' needs EnvPool: pip install 'hdrqn_torchrl[envpool]'.") from error
    if not isinstance(id, str) or id not in envpool.list_all_envs():
        raise ValueError(f"id must be one that EnvPool has, got {id!r}; use backend='gymnasium'.")
    try:
        spec = envpool.make_spec(id, num_envs=num_envs, seed=0, **settings)
    except TypeError as error:
        raise settings_error(id, settings, error) from error
    if (players := spec.config.max_num_players) > 1:
        raise ValueError(
            f"id must be that of a task for one player, got {id!r}, which has {players}; wrap the others into a "
            "Gymnasium environment of your own."
        )
    return spec


def pool_of(id: str, num_envs: int, settings: Mapping[str, Any], seed: int) -> Any:
    """N worlds with Gymnasium's interface."""
    import envpool

    return envpool.make(id, env_type="gymnasium", num_envs=num_envs, seed=seed, **settings)
