"""What Montezuma's Revenge states about itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torchrl.envs import EnvBase

from hdrqn_torchrl.envs.montezuma.screen import ACTION_NAMES, ALL_ACTIONS
from hdrqn_torchrl.envs.subgoals import SubgoalSet
from hdrqn_torchrl.envs.task import Task

if TYPE_CHECKING:
    from hdrqn_torchrl.envs.scene import Scene


def montezuma_task(
    places: tuple[str, ...], actions: Sequence[int], *, prefix: str, key_and_door: bool, max_steps: int
) -> Task:
    """The task of the first screen: key and door, for which the score counts 100 and 300.

    Args:
        places: names of the places that are subgoals.
        actions: ALE's numbers of the actions the agent has.
        prefix: of the places' entries.
        key_and_door: whether key and door are a farther set of subgoals.
        max_steps: step limit of an episode.
    """
    subgoals = SubgoalSet(names=places, prefix=prefix, repeatable=True)
    return Task(
        max_steps=max_steps,
        largest_return=400.0,
        largest_extrinsic_return=2.0,
        smallest_extrinsic_return=0.0,
        subgoals=(subgoals, SubgoalSet(names=("key", "door"))) if key_and_door else (subgoals,),
        actions=tuple(ACTION_NAMES[action] for action in actions),
        scene=screen_scene,
        screen=first_screen,
    )


def screen_scene(env: EnvBase, *, subgoal: int | None = None, action: int | None = None) -> Scene:
    """The present screen of a :class:`~hdrqn_torchrl.envs.MontezumaEnv`; it does not show the action."""
    from hdrqn_torchrl.envs.montezuma.scene import ScreenScene  # takes a second: it loads what draws

    return ScreenScene.of(env, subgoal)


def first_screen(env: EnvBase) -> NDArray[np.uint8]:
    """The screen on which an episode begins, ``[210, 160, 3]``."""
    return env.emulators.start.screen


def check_settings(
    *, num_envs: int, max_steps: int, noops: int, practice: float, locator: str, actions: Sequence[int]
) -> None:
    """Refuses settings of a :class:`~hdrqn_torchrl.envs.MontezumaEnv` that break a rule.

    Raises:
        ValueError: naming setting, rule and value.
    """
    if num_envs < 1:
        raise ValueError(f"num_envs must be >= 1, got {num_envs}; use 16 for training on one core.")
    if max_steps < 1:
        raise ValueError(f"max_steps must be >= 1, got {max_steps}; key and door take 167 steps.")
    if noops < 0:
        raise ValueError(f"noops must be >= 0, got {noops}; evaluations use 30.")
    if not 0.0 <= practice <= 1.0:
        raise ValueError(f"practice must lie in [0, 1], got {practice}; it is a share of episodes.")
    if locator not in ("ram", "pixels"):
        raise ValueError(f"locator must be 'ram' or 'pixels', got {locator!r}; 'ram' is exact.")
    if not actions or not set(actions) <= set(ALL_ACTIONS) or len(set(actions)) < len(actions):
        raise ValueError(f"actions must be different numbers from 0 to 17, got {list(actions)}; use USEFUL_ACTIONS.")
