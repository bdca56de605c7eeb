"""Features of code vectors: a dense layer on one-hot codes, computed as a sum of rows of one table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from hdrqn_torchrl.modules.features import Features, dense_layers, on_rows
from hdrqn_torchrl.modules.sizes import check_size, check_widths

_USUAL_ENTRIES = 25


class CodeFeatures(Features):
    """Code vectors, whose entries have numbers of codes of their own, through dense layers.

    The first layer is a dense layer on one-hot codes: each code of each entry has a row of weights, and the rows of
    the codes seen are added up. That costs less than making the one-hot vectors.

    Adam changes the rows of all D entries by about the learning rate at once, so that a longer vector means larger
    steps. For more than 25 entries the sum is therefore scaled by the root of 25 / D, and the initial rows by its
    inverse: steps are then equally large if the entries pull in different directions. (With 25 / D, the rule of
    :class:`CellFeatures`, they would be if all pulled in the same one; but what depends on a few of 150 entries is
    then learned much more slowly.)

    Args:
        num_codes: number of codes of each entry, in the order of the flattened entries.
        widths: sizes of the dense layers.
        num_dims: number of dimensions of the observation.

    Shapes:
        ``[*, ...]`` integers, with ``num_dims`` dimensions behind ``*`` -> ``[*, widths[-1]]``.

    Examples:
        >>> CodeFeatures((11, 6, 3))(torch.zeros(2, 8, 3, dtype=torch.uint8)).shape
        torch.Size([2, 8, 128])
    """

    _first_rows: Tensor

    def __init__(self, num_codes: Sequence[int], widths: tuple[int, ...] = (128,), *, num_dims: int = 1) -> None:
        super().__init__()
        check_size("num_dims", num_dims, 1, least=0)
        sizes, widths = check_widths(num_codes, "num_codes"), check_widths(widths)
        rows = sum(sizes)
        self.num_dims, self.out_features, self.scale = num_dims, widths[-1], _scale(len(sizes))
        self.table = nn.Parameter(torch.empty(rows, widths[0]))
        self.bias = nn.Parameter(torch.empty(widths[0]))
        nn.init.uniform_(self.bias, -(rows**-0.5), rows**-0.5)  # like those of nn.Linear
        nn.init.uniform_(self.table, -(rows**-0.5) / self.scale, rows**-0.5 / self.scale)
        self.dense = dense_layers(widths[0], widths[1:]) if len(widths) > 1 else nn.Sequential()
        first_rows = torch.tensor([0, *sizes[:-1]]).cumsum(0)
        self.register_buffer("_first_rows", first_rows.int(), persistent=False)

    def forward(self, codes: Tensor) -> Tensor:
        batch = codes.shape[: codes.ndim - self.num_dims]
        rows = codes.reshape(-1, len(self._first_rows)).int() + self._first_rows
        first = torch.relu_(torch.add(self.bias, sum_of_rows(self.table, rows), alpha=self.scale))
        return on_rows(self.dense, first).view(*batch, self.out_features)


def _scale(entries: int) -> float:
    return min(1.0, math.sqrt(_USUAL_ENTRIES / entries))


def sum_of_rows(table: Tensor, rows: Tensor) -> Tensor:
    """Sums of rows of a table ``[S, W]``, by their numbers ``[B, D]``: ``[B, W]``.

    ``torch.nn.functional.embedding_bag`` with a backward pass of half its time: the gradient of a row is a sum of
    rows, too, of those gradients in whose sums it took part.

    Examples:
        >>> sum_of_rows(torch.tensor([[1.0], [2.0], [4.0]]), torch.tensor([[0, 2], [1, 1]]))
        tensor([[5.],
                [4.]])
    """
    if torch.compiler.is_exporting():  # ONNX has no sum of rows by number
        return functional.embedding(rows, table).sum(-2)
    return _SumOfRows.apply(table, rows)


class _SumOfRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.num_rows = len(table)
        return functional.embedding_bag(rows, table, mode="sum")

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (rows,) = ctx.saved_tensors
        ordered, order = rows.t().flatten().sort(stable=True)  # by row, then by sum
        numbers = torch.arange(ctx.num_rows, dtype=rows.dtype, device=rows.device)
        begins = torch.searchsorted(ordered, numbers, out_int32=rows.dtype == torch.int32)
        sums = order.to(rows.dtype) % len(rows)
        return functional.embedding_bag(sums, gradient.contiguous(), begins, mode="sum"), None
