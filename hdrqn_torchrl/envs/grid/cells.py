"""What a grid cell can hold: codes, colours and drawing."""

from __future__ import annotations

import torch
from torch import Tensor

FLOOR, WALL, OBSTACLE, FIRST_GOAL = 0, 1, 2, 3

_BASE_COLOURS = [(255, 255, 255), (112, 112, 112), (214, 39, 40)]  # floor, wall, obstacle
_GOAL_COLOURS = [(31, 119, 180), (44, 160, 44), (255, 127, 14), (148, 103, 189), (23, 190, 207), (188, 189, 34)]
AGENT_COLOUR = (0, 0, 0)


def palette(num_codes: int) -> Tensor:
    """RGB colour of each cell code, ``[num_codes, 3]`` uint8; goal colours repeat after the sixth."""
    goals = [_GOAL_COLOURS[index % len(_GOAL_COLOURS)] for index in range(max(0, num_codes - FIRST_GOAL))]
    return torch.tensor((_BASE_COLOURS + goals)[:num_codes], dtype=torch.uint8)


def nearest_cell(size: int, num_cells: int) -> Tensor:
    """Index of the cell that each of ``size`` pixels shows when ``num_cells`` share them, ``[size]`` int64."""
    return torch.arange(size) * num_cells // size
