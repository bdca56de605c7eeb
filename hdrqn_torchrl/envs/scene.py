"""One moment of a task, ready to be drawn: the world, the agent's view, and the names of things in it.

A task that has a picture of its own names a factory of scenes (:class:`~hdrqn_torchrl.envs.Task`).
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Protocol

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFont
from rich.text import Text

Colour = tuple[int, int, int]

_COLOURS: tuple[Colour, ...] = (
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (213, 94, 0), (204, 121, 167), (0, 114, 178),
)  # fmt: skip  # Okabe and Ito


class Scene(Protocol):
    """What pictures and terminal text need to know about a moment of a task."""

    @property
    def action_names(self) -> tuple[str, ...]:
        """Name of each action."""

    @property
    def subgoal_names(self) -> tuple[str, ...]:
        """Name of each subgoal."""

    @property
    def subgoal_colours(self) -> tuple[Colour, ...]:
        """Colour of each subgoal."""

    @property
    def hazard(self) -> str:
        """What happened when the environment reports a hazard."""

    def outcome(self, success: bool, terminated: bool) -> str:
        """How an episode ended."""

    def draw_world(self, size: int) -> Image.Image:
        """The whole world, at most ``size`` pixels wide and high."""

    def draw_view(self, size: int) -> Image.Image:
        """What the agent sees, at most ``size`` pixels wide and high."""

    def write_world(self) -> Text:
        """The whole world in characters."""

    def write_view(self) -> Text:
        """What the agent sees in characters."""


@cache
def font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name, size)


def colours(number: int) -> tuple[Colour, ...]:
    """Colours that can be told apart; after six they begin anew.

    Args:
        number: of subgoals or whatever has a colour each.
    """
    return tuple(_COLOURS[index % len(_COLOURS)] for index in range(number))


def fitted(
    picture: NDArray[np.uint8], size: int, *, resampling: Image.Resampling = Image.Resampling.NEAREST
) -> Image.Image:
    """A picture whose longer side has ``size`` pixels.

    Args:
        picture: ``[height, width, 3]``.
        size: in pixels.
        resampling: the default keeps the edges of its own pixels.
    """
    image = Image.fromarray(picture)
    scale = size / max(image.size)
    width, height = (max(1, round(side * scale)) for side in image.size)
    return image.resize((width, height), resampling)
