"""Facts of the first screen of Montezuma's Revenge: where its places are, and what the bytes of the RAM mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Box = tuple[int, int, int, int]
"""Left, top, right and bottom in pixels of the 160x210 screen, the last two outside."""

BOXES: dict[str, Box] = {
    "middle_ladder_top": (68, 73, 92, 93),
    "middle_ladder_bottom": (70, 112, 90, 136),
    "rope": (107, 96, 118, 148),
    "bottom_right_ladder_top": (122, 116, 148, 139),
    "bottom_right_ladder_bottom": (128, 158, 144, 181),
    "bottom_left_ladder_top": (8, 124, 37, 139),
    "bottom_left_ladder_bottom": (14, 158, 30, 181),
    "key": (10, 100, 22, 124),
    "left_door": (16, 58, 31, 94),
    "right_door": (129, 58, 145, 94),
}
"""Where the agent's centre is when it is at a place. The left ones end early: those who fall off the conveyor belt pass
by on their right."""

SUBGOALS = (
    "middle_ladder_bottom",
    "bottom_right_ladder_bottom",
    "bottom_left_ladder_bottom",
    "key",
    "left_door",
    "right_door",
)
"""The paper's six."""

DOORS = ("left_door", "right_door")
"""They open a step or two after the agent has come into their box with the key, if it goes on."""

DOOR_SCORE = 300.0
"""What a door brings; the key brings 100."""

ALL_ACTIONS = tuple(range(18))
USEFUL_ACTIONS = (0, 1, 2, 3, 4, 5, 11, 12)
"""Nothing, jump, up, right, left, down, jump right, jump left; the other ten do the same in this game."""
ACTION_NAMES = (
    "noop", "jump", "↑ up", "→ right", "← left", "↓ down", "↗ up right", "↖ up left", "↘ down right", "↙ down left",
    "jump ↑", "jump →", "jump ←", "jump ↓", "jump ↗", "jump ↖", "jump ↘", "jump ↙",
)  # fmt: skip
"""Of ALE's actions."""

_ROOM, _X, _Y, _POSE, _DYING, _INVENTORY, _OBJECTS, _FALLING = 3, 42, 43, 53, 55, 65, 66, 88  # bytes of the RAM
_FIRST_ROOM, _KEY, _KEY_IS_THERE = 1, 2, 1
_DEAD_POSES = (22, 30)  # after a fall, by the skull; they last one step longer than _DYING
_AGENT_COLORS = ((200, 72, 72), (210, 182, 86), (228, 111, 111))
_PLAYED_ROWS = slice(22, 181)  # below the score and the lives, which have the agent's colours


class Ram:
    """What the RAM of N emulators says, ``[N]`` each.

    Args:
        ram: its bytes ``[N, 128]``, read again at each call.
    """

    def __init__(self, ram: NDArray[np.uint8]) -> None:
        self._ram = ram

    def positions(self) -> NDArray[np.float32]:
        """Centres of the agents, ``[N, 2]``."""
        ram = self._ram.astype(np.float32)
        return np.stack([ram[:, _X] + 2.5, 317.5 - ram[:, _Y]], -1)

    def in_first_room(self) -> NDArray[np.bool_]:
        return self._ram[:, _ROOM] == _FIRST_ROOM

    def dying(self) -> NDArray[np.bool_]:
        return self._ram[:, _DYING] > 0

    def lies_dead(self) -> NDArray[np.bool_]:
        """Until the next life begins."""
        return np.isin(self._ram[:, _POSE], _DEAD_POSES)

    def falling(self) -> NDArray[np.bool_]:
        return self._ram[:, _FALLING] > 0

    def has_key(self) -> NDArray[np.bool_]:
        return self._ram[:, _INVENTORY] == _KEY

    def key_is_there(self) -> NDArray[np.bool_]:
        return self._ram[:, _OBJECTS] & _KEY_IS_THERE != 0


def boxes_of(subgoals: Sequence[str] | Mapping[str, Box]) -> dict[str, Box]:
    """Boxes by name, of names or of the user's own boxes.

    Raises:
        ValueError: for an unknown name or a box without an area.
    """
    if isinstance(subgoals, Mapping):
        boxes = {str(name): tuple(int(side) for side in box) for name, box in subgoals.items()}
        for name, box in boxes.items():
            if len(box) != 4 or not (box[0] < box[2] and box[1] < box[3]):
                raise ValueError(f"subgoals.{name} must be left, top, right, bottom with an area, got {list(box)}.")
    else:
        if unknown := [name for name in subgoals if name not in BOXES]:
            raise ValueError(f"subgoals must be names among {list(BOXES)} or boxes by name, got {unknown[0]!r}.")
        boxes = {name: BOXES[name] for name in subgoals}
    if not boxes:
        raise ValueError("subgoals must hold at least one place, got none; leave them out for the paper's six.")
    return boxes  # type: ignore[return-value]


def locate(screen: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Centre of the agent on a screen ``[210, 160, 3]`` by its colours alone: x and y ``[2]``.

    Max-pooled, resized or grey screens do not have these colours. Without any of them, the centre of the screen.
    """
    played = screen[_PLAYED_ROWS]
    is_agent = np.zeros(played.shape[:2], bool)
    for color in _AGENT_COLORS:
        is_agent |= (played == np.array(color, np.uint8)).all(-1)
    rows, columns = np.flatnonzero(is_agent.any(1)), np.flatnonzero(is_agent.any(0))
    if not len(rows):
        return np.array([screen.shape[1] / 2, screen.shape[0] / 2], np.float32)
    center = [(columns[0] + columns[-1]) / 2, (rows[0] + rows[-1]) / 2 + _PLAYED_ROWS.start]
    return np.array(center, np.float32)
