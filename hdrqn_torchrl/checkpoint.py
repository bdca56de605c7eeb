"""Weights of a run as safetensors files: loading one can't run code."""

from __future__ import annotations

import os
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn


def save_weights(module: nn.Module, path: Path) -> None:
    """Writes a module's parameters and buffers to ``path``, which is either the whole file or the one before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    save_file({name: value.detach().cpu().contiguous().clone() for name, value in module.state_dict().items()}, partial)
    with partial.open("rb+") as file:
        os.fsync(file.fileno())
    partial.replace(path)


def load_weights(module: nn.Module, path: Path) -> None:
    """Reads what :func:`save_weights` wrote into ``module``.

    Raises:
        ValueError: if there is no such file, it is of another kind, or it does not fit the module.
    """
    if not path.is_file():
        raise ValueError(f"path must name a weights file, got {path}; a run keeps its own in checkpoints/.")
    try:
        weights = load_file(path)
    except SafetensorError as error:
        raise ValueError(
            f"{path} must be a safetensors file, got something else ({error}); see checkpoints/."
        ) from error
    try:
        module.load_state_dict(weights)
    except RuntimeError as error:
        raise ValueError(f"{path} does not fit this policy; build it with the settings of its run.\n{error}") from error
