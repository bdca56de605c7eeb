"""Weights alone: a policy's, from a run's checkpoints or from a file of its own."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torchrl.checkpoint import CheckpointError

from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints, step_of
from hdrqn_torchrl.runs.persistence.durable import sync
from hdrqn_torchrl.runs.persistence.files import replaced
from hdrqn_torchrl.runs.persistence.serialization import check_tensors


def load_policy(policy: nn.Module, directory: str | Path, which: str = "best") -> int | None:
    """Loads a policy's weights from a run.

    Args:
        policy: built with the settings of the run.
        directory: the run's folder of checkpoints; if it is not there, the run's weights beside it are loaded.
        which: ``"best"``, ``"last"``, or the path of a checkpoint or of a file of :func:`save_weights`.

    Returns:
        Environment frames that the weights were trained for; ``None`` for a file of weights alone, which does not say.

    Raises:
        ValueError: if there is none, it is damaged, or it does not fit.

    Examples:
        >>> import tempfile
        >>> trained, policy, run = nn.Linear(2, 1), nn.Linear(2, 1), Path(tempfile.mkdtemp())
        >>> save_weights(trained, run / "weights.safetensors")
        >>> load_policy(policy, run / "checkpoints")
        >>> torch.equal(policy.weight, trained.weight)
        True
    """
    directory = Path(directory)
    alone = directory.with_name(layout.WEIGHTS)
    if which in ("best", "last") and not directory.exists() and alone.is_file():
        load_weights(policy, alone)
        return None
    checkpoints = Checkpoints(directory)
    try:
        path = {"best": checkpoints.best, "last": checkpoints.newest}.get(which, lambda: Path(which))()
        if path is None:
            raise ValueError(f"checkpoint={which} is not in {directory}: the run has not saved anything yet.")
        if path.is_file():
            load_weights(policy, path)
            return None
        checkpoints.load({"policy": policy}, path)
        return step if (step := step_of(path)) >= 0 else None
    except CheckpointError as error:
        raise ValueError(f"checkpoint can't be loaded: {error}") from error


def save_weights(module: nn.Module, path: str | Path, *, half: bool = False) -> None:
    """Writes a module's parameters and buffers to ``path``, which is either the whole file or the one before.

    Args:
        module: whose state is written.
        path: the file.
        half: whether numbers of 32 bits are rounded to 16; they are loaded as 32 bits again.

    Examples:
        >>> import tempfile
        >>> from safetensors.torch import load_file
        >>> path = Path(tempfile.mkdtemp()) / "weights.safetensors"
        >>> save_weights(nn.Linear(2, 1), path, half=True)
        >>> load_file(path)["weight"].dtype
        torch.float16
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    weights = {name: value.detach().cpu().contiguous().clone() for name, value in module.state_dict().items()}
    if half:
        weights = {name: value.half() if value.dtype == torch.float32 else value for name, value in weights.items()}
    with replaced(path) as partial:
        save_file(weights, partial)
    sync(path.parent)


def load_weights(module: nn.Module, path: str | Path) -> None:
    """Reads what :func:`save_weights` wrote into ``module``.

    Raises:
        ValueError: if there is no such file, it is of another kind, or it does not fit the module.

    Examples:
        >>> import tempfile
        >>> trained, other = nn.Linear(2, 1), nn.Linear(2, 1)
        >>> path = Path(tempfile.mkdtemp()) / "weights.safetensors"
        >>> save_weights(trained, path)
        >>> load_weights(other, path)
        >>> torch.equal(other.weight, trained.weight)
        True
    """
    try:
        module.load_state_dict(read_weights(path))
    except RuntimeError as error:
        raise ValueError(f"{path} does not fit this policy; build it with the settings of its run.\n{error}") from error


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """What :func:`save_weights` wrote, by name.

    Raises:
        ValueError: if there is no such file, or it is of another kind.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"path must name a weights file, got {path}; a run keeps its own in checkpoints/.")
    try:
        check_tensors(path)
        return load_file(path)
    except (SafetensorError, ValueError) as error:
        raise ValueError(
            f"{path} must be a safetensors file, got something else ({error}); see checkpoints/."
        ) from error
