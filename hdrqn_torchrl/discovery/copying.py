"""Where the content of each place of an observation comes from, told from counts."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

_CHUNK = 64  # steps that are compared at once
_CHANGING = 0.02  # share of steps in which a place must change to show where it is copied from
_EXPLAINED = 0.6  # share of changes that the source of a place must explain
_MOVED = 0.2  # share of places that a movement moves
_STIRRING = 0.15  # of what the most moving action changes; opening a door changes much, but seldom
_ALIKE = 0.02  # sources that explain almost as many changes are as good


class CopyCounts(nn.Module):
    """How often a place that changed shows what another one showed before, for each action.

    Args:
        num_actions: A.
        places: P.
    """

    LARGEST_WEIGHT: ClassVar[int] = 112
    """Of a place that is copied without fail: 16 times the bits that a failure tells, for 1 in 2**7."""

    taken: Tensor
    changed: Tensor
    matches: Tensor

    def __init__(self, num_actions: int, places: int) -> None:
        super().__init__()
        self.register_buffer("taken", torch.zeros(num_actions, dtype=torch.int64))
        self.register_buffer("changed", torch.zeros((num_actions, places), dtype=torch.int64))
        self.register_buffer("matches", torch.zeros((num_actions, places, places), dtype=torch.int32))

    def add(self, old: Tensor, action: Tensor, new: Tensor) -> None:
        """Counts steps: contents of all places before and after ``[M, P]``, ``action`` ``[M]``."""
        changed = old != new
        self.taken.index_add_(0, action, torch.ones_like(action))
        self.changed.index_add_(0, action, changed.long())
        for rows in torch.arange(len(action), device=action.device).split(_CHUNK):
            same = (old[rows].unsqueeze(-2) == new[rows].unsqueeze(-1)) & changed[rows].unsqueeze(-1)
            self.matches.index_add_(0, action[rows], same.int())


class Copies(NamedTuple):
    """What :func:`fit_copies` finds; the last hypothesis is that nothing moved.

    ``source``, ``weight`` ``[A, P]`` int64: where each place is copied from, and what it costs if it is not.
    ``moves`` ``[A]`` bool: actions that move what is seen. ``trusted``, ``filled`` ``[A + 1, P]`` bool: places whose
    source is known, and of these the ones that hardly change.
    """

    source: Tensor
    weight: Tensor
    moves: Tensor
    trusted: Tensor
    filled: Tensor


def fit_copies(counts: CopyCounts, *, width: int) -> Copies:
    """The most likely source of each place after each action.

    Args:
        counts: of steps.
        width: number of places in a row of the observation.
    """
    actions, places = counts.changed.shape
    device = counts.changed.device
    same = torch.arange(places, device=device)
    fitted = Copies(
        source=same.repeat(actions, 1),
        weight=torch.zeros_like(counts.changed),
        moves=torch.zeros(actions, dtype=torch.bool, device=device),
        trusted=torch.ones((actions + 1, places), dtype=torch.bool, device=device),
        filled=torch.zeros((actions + 1, places), dtype=torch.bool, device=device),
    )
    stirred = counts.changed.double().mean(-1) / counts.taken.clamp(min=1)
    for action in (stirred >= _STIRRING * stirred.max()).nonzero().flatten().tolist():
        ratio = counts.matches[action].double() / counts.changed[action].clamp(min=1).unsqueeze(-1)
        best, source = ratio.max(-1)
        changing = counts.changed[action] >= _CHANGING * counts.taken[action].clamp(min=1)
        known = changing & (best >= _EXPLAINED)
        if known.sum() < _MOVED * places:
            continue
        source, filled = _regular(source, ratio >= best.unsqueeze(-1) - _ALIKE, known, changing, width)
        bits = (-16 * (1 - best).clamp(min=2**-7).log2()).round().long()
        fitted.moves[action] = True
        fitted.source[action] = source
        fitted.weight[action] = torch.where(known, bits, 0).masked_fill(~changing, CopyCounts.LARGEST_WEIGHT)
        fitted.trusted[action] = known | ~changing
        fitted.filled[action] = filled
    return fitted


def _regular(source: Tensor, good: Tensor, known: Tensor, changing: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Sources ``[P]``, shifted alike where that is as good; and places that are shifted like the others, ``[P]``.

    Args:
        source: the best of each place.
        good: sources that are as good, ``[P, P]`` bool.
        known: places whose source is known.
        changing: places that change.
        width: number of places in a row.
    """
    place = torch.arange(len(source), device=source.device)
    row, column = place // width, place % width
    span = 2 * width + 2 * len(source)
    shift = (row[:, None] - row) * span + (column[:, None] - column)  # [place, source], one number for each shift
    shifts, votes = shift[good & known.unsqueeze(-1)].unique(return_counts=True)
    usual = shifts[votes.argmax()]
    if votes.max() * 2 <= known.sum():
        return torch.where(known, source, place), torch.zeros_like(known)
    is_usual = shift == usual
    has, shifted = is_usual.any(-1), is_usual.long().argmax(-1)
    alike = known & has & (good & is_usual).any(-1)
    filled = has & ~changing
    return torch.where(alike | filled, shifted, torch.where(known, source, place)), filled
