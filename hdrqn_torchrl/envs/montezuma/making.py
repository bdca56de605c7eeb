"""Montezuma's Revenge as an agent sees it."""

from __future__ import annotations

from typing import Any

from torchrl.envs import TransformedEnv

from hdrqn_torchrl.envs.montezuma.environment import MontezumaEnv
from hdrqn_torchrl.transforms import Window


def make_montezuma(
    num_envs: int = 8,
    *,
    view: int | None = 70,
    size: int = 44,
    keep_pixels: bool = False,
    **settings: Any,
) -> TransformedEnv:
    """Montezuma's Revenge as the paper's agent sees it: through a window around it.

    Args:
        num_envs: number of emulators.
        view: side of the window in pixels of the screen, black beyond its edges; ``None``: the whole screen.
        size: side of the square image that it is resized to.
        keep_pixels: keep the whole screen as well (100 kB for each step).
        settings: for :class:`~hdrqn_torchrl.envs.MontezumaEnv`.

    Returns:
        An environment with ``observation`` ``[3, size, size]`` uint8 and the other keys of
        :class:`~hdrqn_torchrl.envs.MontezumaEnv`.

    Examples:
        >>> env = make_montezuma(num_envs=2, seed=0)
        >>> env.rollout(3)["observation"].shape
        torch.Size([2, 3, 3, 44, 44])
    """
    env = MontezumaEnv(num_envs, **settings)
    env.seen = view, size
    return TransformedEnv(env, Window(view=view, size=size, keep_pixels=keep_pixels))
