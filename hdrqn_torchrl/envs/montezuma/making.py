"""Montezuma's Revenge as an agent sees it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from torchrl.envs import TransformedEnv

from hdrqn_torchrl.envs.montezuma.environment import MontezumaEnv
from hdrqn_torchrl.envs.montezuma.screen import ALL_ACTIONS, SUBGOALS, Box
from hdrqn_torchrl.transforms import Window


def make_montezuma(
    num_envs: int = 8,
    *,
    view: int | None = 70,
    size: int = 44,
    keep_pixels: bool = False,
    subgoals: Sequence[str] | Mapping[str, Box] = SUBGOALS,
    key_and_door: bool = False,
    max_steps: int = 500,
    frame_skip: int = 4,
    sticky: float = 0.0,
    actions: Sequence[int] = ALL_ACTIONS,
    one_life: bool = True,
    locator: Literal["ram", "pixels"] = "ram",
    noops: int = 0,
    practice: float = 0.0,
    practice_steps: int | None = None,
    threads: int = 1,
    seed: int | None = None,
    device: torch.device | str | None = None,
) -> TransformedEnv:
    """Montezuma's Revenge as the paper's agent sees it: through a window around it.

    Args:
        num_envs: number of emulators.
        view: side of the window in pixels of the screen, black beyond its edges; ``None``: the whole screen.
        size: side of the square image that it is resized to.
        keep_pixels: keep the whole screen as well (100 kB for each step).
        subgoals, key_and_door, max_steps, frame_skip, sticky, actions, one_life, locator: as in
            :class:`~hdrqn_torchrl.envs.MontezumaEnv`.
        noops, practice, practice_steps, threads, seed, device: as in :class:`~hdrqn_torchrl.envs.MontezumaEnv`.

    Returns:
        An environment with ``observation`` ``[3, size, size]`` uint8 and the other keys of
        :class:`~hdrqn_torchrl.envs.MontezumaEnv`.

    Examples:
        >>> env = make_montezuma(num_envs=2, seed=0)
        >>> env.rollout(3)["observation"].shape
        torch.Size([2, 3, 3, 44, 44])
    """
    env = MontezumaEnv(
        num_envs,
        subgoals=subgoals,
        key_and_door=key_and_door,
        max_steps=max_steps,
        frame_skip=frame_skip,
        sticky=sticky,
        actions=actions,
        one_life=one_life,
        locator=locator,
        noops=noops,
        practice=practice,
        practice_steps=practice_steps,
        threads=threads,
        seed=seed,
        device=device,
    )
    env.seen = view, size
    return TransformedEnv(env, Window(view=view, size=size, keep_pixels=keep_pixels))
