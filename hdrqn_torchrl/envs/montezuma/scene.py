"""Screens of Montezuma's Revenge as scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from rich.text import Text

from hdrqn_torchrl.envs.montezuma.environment import MontezumaEnv
from hdrqn_torchrl.envs.montezuma.screen import ACTION_NAMES, BOXES, DOORS, Box
from hdrqn_torchrl.envs.scene import Colour
from hdrqn_torchrl.transforms.window import cut_out, resized

_COLOURS: tuple[Colour, ...] = (
    (230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66), (213, 94, 0), (204, 121, 167),
)  # fmt: skip  # Okabe and Ito
_OUTLINE: Colour = (255, 255, 255)
_COLUMNS = 53  # of the screen in a terminal; half a character is as wide as it is high


@dataclass(frozen=True, eq=False)
class ScreenScene:
    """One screen at one moment."""

    screen: NDArray[np.uint8]
    """``[210, 160, 3]``"""
    position: tuple[float, float]
    boxes: Mapping[str, Sequence[Box]]
    """Of each subgoal."""
    actions: tuple[int, ...]
    seen: tuple[int | None, int] | None
    """Side of the agent's window (``None``: it sees the whole screen) and of the image made of it."""
    subgoal: int | None

    hazard = "died"

    @classmethod
    def of(cls, env: MontezumaEnv, subgoal: int | None) -> ScreenScene:
        """The present screen of the first emulator."""
        x, y = env.positions()[0].tolist()
        screen = env.emulators.screens[0].copy()
        boxes: Mapping[str, Sequence[Box]] = {name: (box,) for name, box in env.subgoals.items()}
        if env.key_and_door:
            boxes = {"key": (BOXES["key"],), "door": [BOXES[door] for door in DOORS]}
        return cls(screen, (x, y), boxes, env.action_numbers, env.seen, subgoal)

    @property
    def action_names(self) -> tuple[str, ...]:
        """Those of the actions that the agent has."""
        return tuple(ACTION_NAMES[action] for action in self.actions)

    @property
    def subgoal_names(self) -> tuple[str, ...]:
        """``bottom_left_ladder_bottom`` becomes ``left ladder, foot``."""
        return tuple(_shortened(name) for name in self.boxes)

    @property
    def subgoal_colours(self) -> tuple[Colour, ...]:
        """One for each, in turn."""
        return tuple(_COLOURS[index % len(_COLOURS)] for index in range(len(self.boxes)))

    def outcome(self, success: bool, terminated: bool) -> str:
        """How an episode ended."""
        return "door opened" if success else "died" if terminated else "time is up"

    def draw_world(self, size: int) -> Image.Image:
        """The screen as on a television, with the boxes (the active one filled) and the agent's window."""
        shape = size, size * 3 // 4
        image = Image.fromarray(self.screen).resize(shape, Image.Resampling.NEAREST)
        draw = ImageDraw.Draw(image, "RGBA")
        for index, (boxes, colour) in enumerate(zip(self.boxes.values(), self.subgoal_colours, strict=True)):
            active = index == self.subgoal
            fill = (*colour, 90) if active else None
            for box in boxes:
                draw.rectangle(self._scaled(box, shape), outline=colour, width=3 if active else 1, fill=fill)
        if self.seen is not None and self.seen[0] is not None:
            x, y = self.position
            half = self.seen[0] / 2
            draw.rectangle(self._scaled((x - half, y - half, x + half, y + half), shape), outline=_OUTLINE)
        return image

    def _scaled(self, box: tuple[float, ...], shape: tuple[int, int]) -> tuple[float, ...]:
        height, width, _ = self.screen.shape
        left, top, right, bottom = box
        x, y = shape[0] / width, shape[1] / height
        return left * x, top * y, right * x - 1, bottom * y - 1

    def draw_view(self, size: int) -> Image.Image:
        """What the agent sees, in its own few pixels."""
        return Image.fromarray(self._image()).resize((size, size), Image.Resampling.NEAREST)

    def _image(self) -> NDArray[np.uint8]:
        """What the agent sees, ``[size, size, 3]``."""
        if self.seen is None:
            return self.screen
        pixels, (view, size) = torch.tensor(self.screen), self.seen
        if view is not None:
            pixels = cut_out(pixels, torch.tensor(self.position), view)
        return resized(pixels, size).permute(1, 2, 0).numpy()

    def write_world(self) -> Text:
        """The screen in coloured half characters."""
        return _in_characters(self.screen, _COLUMNS)

    def write_view(self) -> Text:
        """What the agent sees."""
        return _in_characters(self._image(), 22)


def _shortened(name: str) -> str:
    for end, short in (("_ladder_bottom", " ladder, foot"), ("_ladder_top", " ladder, head")):
        if name.endswith(end):
            return name.removesuffix(end).removeprefix("bottom_") + short
    return name.replace("_", " ")


def _in_characters(screen: NDArray[np.uint8], columns: int) -> Text:
    height, width, _ = screen.shape
    rows = columns * height * 3 // (width * 4) // 2 * 2
    small = np.asarray(Image.fromarray(screen).resize((columns, rows), Image.Resampling.BOX))
    text = Text()
    for row in range(0, rows, 2):
        for upper, lower in zip(small[row], small[row + 1], strict=True):
            colours = ("#" + "".join(f"{part:02x}" for part in each) for each in (upper, lower))
            text.append("▀", " on ".join(colours))
        text.append("\n" if row + 2 < rows else "")
    return text
