"""Where codes lie in an observation, and the numbers of their changes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Layout(NamedTuple):
    """How codes lie in an observation: ``places`` cells with the same ``planes`` of codes each; others follow.

    A token is the number of a change: a place, a plane of it, its code before and its code after. 0 is none, and the
    last one says that a step was rewarded.

    Examples:
        >>> Layout.of((5,) * 9), Layout.of((11, 6, 4) * 49 + (4,))
        (Layout(places=9, planes=(5,)), Layout(places=49, planes=(11, 6, 4)))
    """

    places: int
    planes: tuple[int, ...]

    @classmethod
    def of(cls, num_codes: Sequence[int]) -> Layout:
        """The layout with the smallest number of planes in which most entries are in a cell."""
        sizes = tuple(num_codes)
        found = cls(0, ())
        for planes in range(1, 9):
            period = sizes[:planes]
            places = 0
            while period and sizes[places * planes : (places + 1) * planes] == period:
                places += 1
            if places >= 4 and places * planes > found.places * len(found.planes):
                found = cls(places, period)
        return found

    @property
    def width(self) -> int:
        """Side of the square that the places fill; all in one row if they fill none."""
        side = math.isqrt(self.places)
        return side if side * side == self.places else max(1, self.places)

    @property
    def tokens_of_place(self) -> int:
        """Number of changes that a place can have."""
        return sum(size * size for size in self.planes)

    @property
    def reward_token(self) -> int:
        """The token of a step with a positive reward."""
        return 1 + self.places * self.tokens_of_place

    def cells(self, observation: Tensor, num_dims: int) -> Tensor:
        """The codes of all places, ``[*, P, planes]`` int64.

        Args:
            observation: ``[*, ...]``, with ``num_dims`` dimensions of its own.
            num_dims: how many.
        """
        flat = observation.flatten(-num_dims).long() if num_dims else observation.unsqueeze(-1).long()
        used = flat[..., : self.places * len(self.planes)]
        return used.unflatten(-1, (self.places, len(self.planes)))

    def first_tokens(self) -> Tensor:
        """The token of "0 -> 0" in each plane of each place, ``[P, planes]``; "a -> b" is ``a * codes + b`` further."""
        squares = torch.tensor(self.planes, dtype=torch.int64).square()
        return 1 + torch.arange(self.places).unsqueeze(-1) * squares.sum() + squares.cumsum(0) - squares

    def place_of(self, token: int) -> int:
        """Where a change is."""
        return (token - 1) // max(1, self.tokens_of_place)

    def name(self, token: int) -> str:
        """An event in words.

        Raises:
            ValueError: if there is no such token.

        Examples:
            >>> Layout.of((5,) * 9).name(116)
            '(1, 1): 3 -> 0'
        """
        if token == self.reward_token:
            return "reward"
        if not 0 < token < self.reward_token:
            raise ValueError(f"token must lie in [1, {self.reward_token}], got {token}.")
        place, rest = divmod(token - 1, self.tokens_of_place)
        plane = 0
        while rest >= self.planes[plane] ** 2:
            rest, plane = rest - self.planes[plane] ** 2, plane + 1
        was, now = divmod(rest, self.planes[plane])
        where = f"({place // self.width}, {place % self.width})"
        return f"{where}{f' plane {plane}' if len(self.planes) > 1 else ''}: {was} -> {now}"
