"""The symmetries of a grid task: turns and mirrors of its map that show the same map."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import torch
from torch import Tensor

from hdrqn_torchrl.envs.grid.layouts import map_rows
from hdrqn_torchrl.envs.grid.rules import MOVES
from hdrqn_torchrl.envs.symmetry import Symmetry


def grid_symmetries(layout: str | Sequence[str], view: int) -> tuple[Symmetry, ...]:
    """Those of the eight turns and mirrors of a square, but for leaving it as it is, that the walls of a map allow.

    Args:
        layout: name or rows of the map.
        view: side of the square window around the agent.

    Examples:
        >>> len(grid_symmetries("open", 5)), len(grid_symmetries(["#####", "#   #", "#####"], 3))
        (7, 3)
    """
    walls = torch.tensor([[cell == "#" for cell in row] for row in map_rows(layout)])
    places = torch.arange(view**2).view(view, view)
    return tuple(
        Symmetry(places=tuple(change(places).flatten().tolist()), actions=_actions(change))
        for change in _changes()
        if torch.equal(change(walls), walls)
    )


def _changes() -> Iterator[Callable[[Tensor], Tensor]]:
    """The seven ways to turn and mirror a picture ``[rows, columns]``."""
    for mirrored in (False, True):
        for quarters in range(4):
            if mirrored or quarters:
                yield partial(_changed, mirrored=mirrored, quarters=quarters)


def _changed(picture: Tensor, *, mirrored: bool, quarters: int) -> Tensor:
    return torch.rot90(picture.flip(1) if mirrored else picture, quarters)


def _actions(change: Callable[[Tensor], Tensor]) -> tuple[int, ...]:
    """Where each action leads from the middle of three times three cells, once these are changed."""
    cells = torch.full((3, 3), -1)
    for action, (down, right) in enumerate(MOVES):
        cells[1 + down, 1 + right] = action
    changed = change(cells)
    instead = {int(changed[1 + down, 1 + right]): other for other, (down, right) in enumerate(MOVES)}
    return tuple(instead[action] for action in range(len(MOVES)))
