"""States of any component as files that can't run code: tensors in safetensors, everything else in JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.checkpoint import CheckpointAdapter

from hdrqn_torchrl.runs.persistence.files import open_file, read_json
from hdrqn_torchrl.runs.persistence.state_checks import Rule, check_entries

TENSORS, STRUCTURE = "tensors.safetensors", "structure.json"
LARGEST_HEADER = 16 << 20  # bytes; a thousand times that of a large training


class SafetensorsAdapter(CheckpointAdapter):
    """Writes a component's ``state_dict`` as one safetensors file and one JSON file.

    TorchRL's own adapter falls back to ``torch.load`` when it meets a pickle; this one has nothing to fall back to.
    A state may nest dicts, lists, tuples, tensors, TensorDicts, arrays of numbers, numbers, strings and ``None``.

    Args:
        rules: what entries of TensorDicts must be, checked before they are loaded
            (:func:`~hdrqn_torchrl.runs.persistence.state_checks.rules_of`).
    """

    adapter_id = "hdrqn_torchrl.safetensors"

    def __init__(self, rules: Mapping[str, Rule] | None = None) -> None:
        self.rules = rules or {}

    def save(self, component: Any, path: Path, *, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> None:
        path.mkdir(parents=True, exist_ok=True)
        tensors: dict[str, Tensor] = {}
        structure = _encode(component.state_dict(), tensors, "")
        save_file(_without_aliases(tensors), path / TENSORS)
        (path / STRUCTURE).write_text(json.dumps(structure))
        (path / TENSORS).chmod((path / STRUCTURE).stat().st_mode)  # safetensors lets nobody else read its files

    def load(
        self,
        component: Any,
        path: Path,
        *,
        map_location: Any,
        tensor_load_kwargs: Mapping[str, Any],
        args: tuple[Any, ...],
        kwargs: Mapping[str, Any],
    ) -> None:
        device = torch.device(map_location or "cpu")
        root = path.parents[1]  # of the checkpoint
        structure = read_json(path / STRUCTURE, root=root)
        check_tensors(path / TENSORS, root=root)
        state = _decode(structure, load_file(path / TENSORS), device)
        check_entries(state, self.rules)
        component.load_state_dict(state)


def check_storable(state: Any, name: str) -> None:
    """Refuses a state that no checkpoint can hold.

    Args:
        state: of any component.
        name: of the component, for the message.

    Raises:
        TypeError: naming what it holds, and where.

    Examples:
        >>> check_storable({"places": [{1, 2}]}, "collector")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        TypeError: a state may hold tensors, ... got <class 'set'> at collector/places/0.
    """
    _encode(state, {}, name)


def check_tensors(path: Path, *, root: Path | None = None) -> None:
    """Refuses a safetensors file that promises more than it holds, before it is mapped.

    Args:
        path: the file.
        root: see :func:`~hdrqn_torchrl.runs.persistence.files.check_file`.

    Raises:
        ValueError: if it is not one, or its header or size is not what the tensors in it need.
    """
    with open_file(path, root=root) as file:
        size = os.fstat(file.fileno()).st_size
        length = int.from_bytes(file.read(8), "little")
        if not 2 <= length <= min(size - 8, LARGEST_HEADER):
            raise ValueError(f"{path} must be a safetensors file, got one whose header would have {length:,} bytes.")
        try:
            header = json.loads(file.read(length))
            ends = [each["data_offsets"][1] for name, each in header.items() if name != "__metadata__"]
            needed = 8 + length + max(ends, default=0)
        except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
            raise ValueError(f"{path} must be a safetensors file, got one with another header ({error}).") from error
    if needed != size:
        raise ValueError(f"{path} must have the {needed:,} bytes that its header promises, got {size:,}.")


def _encode(value: Any, tensors: dict[str, Tensor], name: str) -> Any:
    """``value`` as JSON; its tensors go to ``tensors``, by the path that leads to them."""

    def inner(key: Any, item: Any) -> Any:
        return _encode(item, tensors, f"{name}/{key}" if name else str(key))

    if isinstance(value, Tensor):
        assert name not in tensors, name
        tensors[name] = value.detach()
        return {"tensor": name}
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return {"array": inner("array", torch.from_numpy(value.copy()))["tensor"]}
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, TensorDictBase):
        items = {key: inner(key, item) for key, item in value.items()}
        return {"tensordict": items, "batch_size": list(value.batch_size), "names": list(value.names)}
    if isinstance(value, Mapping):
        return {"dict": [[key, inner(key, item)] for key, item in value.items()]}
    for kind, type_ in (("size", torch.Size), ("tuple", tuple), ("list", list)):
        if isinstance(value, type_):
            return {kind: [inner(index, item) for index, item in enumerate(value)]}
    if isinstance(value, torch.device):
        return {"device": str(value)}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(
        f"a state may hold tensors, arrays of numbers, numbers, strings and containers of them, got {type(value)} at "
        f"{name}."
    )


def _decode(value: Any, tensors: Mapping[str, Tensor], device: torch.device) -> Any:
    """The inverse of :func:`_encode`."""
    if not isinstance(value, dict):
        return value
    kind = next(iter(value))
    content = value[kind]
    if kind == "tensor":
        return tensors[content].to(device, copy=True)  # a copy, as the original is mapped from the file
    if kind == "array":
        return tensors[content].numpy().copy()
    if kind == "tensordict":
        items = {key: _decode(item, tensors, device) for key, item in content.items()}
        names = value["names"] if any(value["names"]) else None
        return TensorDict(items, batch_size=value["batch_size"], device=device, names=names)
    if kind == "dict":
        return {key: _decode(item, tensors, device) for key, item in content}
    if kind == "device":
        return device
    return {"size": torch.Size, "tuple": tuple, "list": list}[kind](_decode(item, tensors, device) for item in content)


def _without_aliases(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Copies tensors that share memory with others, which safetensors refuses; the rest is written from its place."""
    seen: set[int] = set()
    unshared = {}
    for name, tensor in tensors.items():
        tensor = tensor.cpu().contiguous()
        memory = tensor.untyped_storage().data_ptr()
        unshared[name] = tensor.clone() if memory in seen else tensor
        seen.add(memory)
    return unshared
