"""Operations that ONNX, or onnxruntime, lacks, made of others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.export import ExportedProgram


def where_of_flags(condition: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """``torch.where``, for which onnxruntime has no kernel if it chooses between bools.

    Examples:
        >>> either, none = torch.tensor([True, False]), torch.tensor([False, False])
        >>> where_of_flags(either, none, ~none).tolist()
        [False, True]
    """
    if first.dtype != torch.bool or second.dtype != torch.bool:
        return NotImplemented  # it stays what it is
    return (condition & first) | (~condition & second)


def place_in_order(ascending: Tensor, values: Tensor, **options: Any) -> Tensor:
    """``torch.searchsorted`` in one row: how many of its numbers are smaller.

    Examples:
        >>> place_in_order(torch.tensor([1, 3, 5]), torch.tensor([[0, 3], [4, 9]])).tolist()
        [[0, 1], [2, 3]]
    """
    assert not any(options.values()), options
    return (ascending < values.unsqueeze(-1)).sum(-1)


_DECOMPOSITIONS: dict[Any, Callable[..., Any]] = {
    torch.ops.aten.where.self: where_of_flags,
    torch.ops.aten.searchsorted.Tensor: place_in_order,
}


def for_onnx(program: ExportedProgram) -> ExportedProgram:
    """The same program out of operations that onnxruntime has."""
    return program.run_decompositions(_DECOMPOSITIONS)
