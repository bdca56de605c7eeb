"""Pictures of grid worlds."""

from __future__ import annotations

import torch
from torch import Tensor

from hdrqn_torchrl.envs.grid.cells import AGENT_COLOUR, FIRST_GOAL, palette
from hdrqn_torchrl.envs.grid.rules import GridRules, GridState

_DIMMED = 0.65  # brightness of what the agent does not see


def draw_worlds(rules: GridRules, state: GridState, *, cell_pixels: int = 32) -> Tensor:
    """Draws the whole map of every world: cell colours, dots that count the goals' order, the agent as a disc.

    What lies outside the agent's view is dimmed.

    Args:
        rules: the rules of the grid.
        state: the N worlds.
        cell_pixels: side of a cell in pixels, at least 4.

    Returns:
        ``[N, height * cell_pixels, width * cell_pixels, 3]`` uint8 RGB.

    Raises:
        ValueError: if ``cell_pixels`` is too small.

    Examples:
        >>> rules = GridRules("four_rooms")
        >>> draw_worlds(rules, rules.sample(2), cell_pixels=8).shape
        torch.Size([2, 88, 88, 3])
    """
    if cell_pixels < 4:
        raise ValueError(f"cell_pixels must be >= 4, got {cell_pixels}; use 32 for a picture to look at.")
    codes = rules.whole_map(state).long()
    device, world = codes.device, torch.arange(len(codes), device=codes.device)
    tiles = _tiles(rules.num_codes, cell_pixels).to(device)[codes]  # [N, height, width, pixels, pixels, 3]
    brightness = torch.full((len(codes), rules.nowhere + 1), _DIMMED, device=device)
    brightness.scatter_(1, rules.window_cells[state.agent], 1.0)
    tiles = (tiles * brightness[:, :-1].view(codes.shape)[..., None, None, None]).to(torch.uint8)
    row, column = state.agent // rules.width, state.agent % rules.width
    disc = _disc(cell_pixels, 0.5, 0.5, 0.3).to(device)[..., None]
    agent_colour = torch.tensor(AGENT_COLOUR, dtype=torch.uint8, device=device)
    tiles[world, row, column] = torch.where(disc, agent_colour, tiles[world, row, column])
    return tiles.transpose(2, 3).flatten(3, 4).flatten(1, 2)


def _tiles(num_codes: int, pixels: int) -> Tensor:
    """Picture of each cell code, ``[num_codes, pixels, pixels, 3]``; goal k carries k + 1 white dots."""
    colours = palette(num_codes)[:, None, :]
    tiles = colours[:, None].repeat(1, pixels, pixels, 1)
    for code in range(FIRST_GOAL, num_codes):
        count = code - FIRST_GOAL + 1
        for dot in range(count):
            tiles[code, _disc(pixels, 0.5, (dot + 1) / (count + 1), 0.1)] = 255
    tiles[:, -1] = tiles[:, :, -1] = colours // 8 * 7  # a thin line between cells
    return tiles


def _disc(pixels: int, row: float, column: float, radius: float) -> Tensor:
    """Mask of a disc, ``[pixels, pixels]`` bool; centre and radius are shares of the side."""
    axis = (torch.arange(pixels) + 0.5) / pixels
    return (axis[:, None] - row) ** 2 + (axis[None, :] - column) ** 2 <= radius**2
