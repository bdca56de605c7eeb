"""Finds, on a CPU, operations that would make the host wait for a GPU."""

from __future__ import annotations

import sys

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

_ALWAYS = {
    "_local_scalar_dense", "is_nonzero", "nonzero", "masked_select", "equal", "_pack_padded_sequence",
    "_unique2", "unique_dim", "unique_consecutive", "unique_dim_consecutive", "bincount", "histc",
}  # fmt: skip
_FROM_DEVICE = {"tolist", "numpy", "cpu", "__array__"}  # on a CPU they read without any operation
_TO_DEVICE = {"tensor", "as_tensor", "new_tensor"}  # of numbers: copied from the host's memory


class HostWaits(TorchDispatchMode):
    """Collects each such operation in ``found``, with the place in the package that called it.

    Args:
        package: where to look for the place.

    Examples:
        >>> with HostWaits() as waits:
        ...     if torch.zeros(3).any():
        ...         pass
        >>> [wait.split()[0] for wait in waits.found]
        ['_local_scalar_dense']
    """

    def __init__(self, package: str = "hdrqn_torchrl") -> None:
        super().__init__()
        self.package, self.found = package, []
        self._methods = _Methods(self)

    def __enter__(self):
        self._methods.__enter__()
        return super().__enter__()

    def __exit__(self, *error):
        super().__exit__(*error)
        self._methods.__exit__(*error)

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.overloadpacket.__name__
        if _waits(name, function, args, kwargs or {}):
            self.note(name)
        return function(*args, **(kwargs or {}))

    def note(self, name: str) -> None:
        frame, place = sys._getframe(), "elsewhere"
        while frame is not None and place == "elsewhere":
            if f"/{self.package}/" in frame.f_code.co_filename:
                place = f"{frame.f_code.co_filename.rpartition(self.package + '/')[2]}:{frame.f_code.co_name}"
            frame = frame.f_back
        self.found.append(f"{name} {place}")


class _Methods(TorchFunctionMode):
    def __init__(self, waits: HostWaits) -> None:
        super().__init__()
        self.waits = waits

    def __torch_function__(self, function, types, args=(), kwargs=None):
        name = getattr(function, "__name__", "")
        reads = name in _FROM_DEVICE and isinstance(args[0], torch.Tensor)
        if reads or (name in _TO_DEVICE and not isinstance(args[-1], torch.Tensor)):
            self.waits.note(name)
        return function(*args, **(kwargs or {}))


def _waits(name: str, function, args, kwargs) -> bool:
    if name in _ALWAYS:
        return True
    if name in ("index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index"):
        masked = any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in args[1])
        return masked and not (name.startswith(("index_put", "_index_put")) and args[2].numel() == 1)  # masked_fill
    if name == "repeat_interleave":
        return function._overloadname != "self_int" and kwargs.get("output_size") is None
    if name == "multinomial":
        return len(args) < 3 or not args[2] or args[1] == 1
    if name in ("_to_copy", "copy_"):
        devices = {leaf.device.type for leaf in tree_leaves(args) if isinstance(leaf, torch.Tensor)}
        return len(devices | {torch.device(kwargs.get("device") or next(iter(devices))).type}) > 1
    return False
