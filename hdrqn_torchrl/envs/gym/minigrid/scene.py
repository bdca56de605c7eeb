"""One moment of a MiniGrid task: the map with what the agent sees lit up, its own view, and its mission."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.text import Text
from torchrl.envs import EnvBase

from hdrqn_torchrl.envs.scene import Colour, colours, fitted

_SMOOTH = Image.Resampling.LANCZOS
_TILE = 32  # pixels


def minigrid_scene(env: EnvBase, *, subgoal: int | None = None, action: int | None = None) -> MiniGridScene:
    """The first world of an environment of :func:`~hdrqn_torchrl.envs.make_minigrid`; it shows neither argument."""
    world = env.world
    return MiniGridScene(
        picture=world.get_full_render(highlight=True, tile_size=_TILE),
        seen=world.get_pov_render(tile_size=_TILE),
        characters=str(world),
        mission=world.mission,
        action_names=env.task.actions,
        subgoal_names=env.task.subgoals[-1].names if env.task.subgoals else (),
    )


@dataclass(frozen=True, eq=False, kw_only=True)  # arrays have no single answer to ==
class MiniGridScene:
    """A moment of a MiniGrid task."""

    picture: NDArray[np.uint8]
    """``[height, width, 3]``"""
    seen: NDArray[np.uint8]
    """What the agent sees, itself below in the middle, ``[height, width, 3]``."""
    characters: str
    """The map as MiniGrid writes it: two characters for each cell."""
    mission: str
    action_names: tuple[str, ...]
    subgoal_names: tuple[str, ...]

    hazard = "lost"

    @property
    def subgoal_colours(self) -> tuple[Colour, ...]:
        """One for each, in turn."""
        return colours(len(self.subgoal_names))

    def outcome(self, success: bool, terminated: bool) -> str:
        """How an episode ended."""
        return f"done: {self.mission}" if success else "failed" if terminated else "time is up"

    def draw_world(self, size: int) -> Image.Image:
        """The whole map."""
        return fitted(self.picture, size, resampling=_SMOOTH)

    def draw_view(self, size: int) -> Image.Image:
        """What the agent sees."""
        return fitted(self.seen, size, resampling=_SMOOTH)

    def write_world(self) -> Text:
        """The map in characters, and the mission."""
        return Text(f"{self.mission}\n{self.characters}")

    def write_view(self) -> Text:
        """The map in characters; MiniGrid does not write what the agent sees."""
        return self.write_world()
