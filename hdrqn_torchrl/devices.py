"""How the code depends on the device that it runs on."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

WORKSPACE = "CUBLAS_WORKSPACE_CONFIG"
"""Variable that cuBLAS reads once."""
_WORKSPACES = (":16:8", ":4096:8")  # with which it repeats its sums; cuDNN's LSTM does with the first


def on_host(tensor: Tensor) -> bool:
    """Whether the host can read a tensor without waiting for a device.

    On the CPU, reading a value may save work (``if mask.any(): ...``). On a GPU it would stall the queue of kernels, so
    the work is always done.
    """
    return tensor.device.type == "cpu"


def to_device(data: Any, device: torch.device | None) -> Any:
    """A tensor or TensorDict of the host on a device. A GPU copies it from pinned memory; the host does not wait.

    Args:
        data: where it is now.
        device: where it is to be; ``None``: where it is.

    Examples:
        >>> to_device(torch.ones(2), torch.device("cpu")).tolist()
        [1.0, 1.0]
    """
    if device is None or device.type != "cuda":
        return data if device is None else data.to(device)
    if isinstance(data, TensorDictBase):
        return data.apply(partial(to_device, device=device), device=device)
    return data.pin_memory().to(device, non_blocking=True) if data.device.type == "cpu" else data.to(device)


class Arriving:
    """A tensor on its way to the host, which does other work meanwhile.

    A GPU copies it, as it is now, into pinned memory when it comes to it; a host that asks waits for this copy, and not
    for what was begun since.

    Args:
        tensor: of any device.

    Examples:
        >>> total = torch.ones(2)
        >>> arriving = Arriving(total)
        >>> _ = total.zero_()
        >>> arriving.get().tolist()
        [1.0, 1.0]
    """

    def __init__(self, tensor: Tensor) -> None:
        self._event: torch.cuda.Event | None = None
        if tensor.device.type != "cuda":
            self._copy = tensor.clone()
        else:
            self._copy = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True).copy_(tensor, non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record()

    def get(self) -> Tensor:
        """The tensor on the host."""
        if self._event is not None:
            self._event.synchronize()
        return self._copy

    def truth(self) -> bool:
        """Of a tensor of one element."""
        return bool(self.get())


class LateCheck:
    """Asks whether something is wrong: a host at once, a GPU when the next question is asked.

    The answer has arrived by then, so that the host never waits for the work that it has just begun.

    Examples:
        >>> LateCheck().ask(torch.tensor(True), lambda: print("wrong"))
        wrong
    """

    def __init__(self) -> None:
        self._open: tuple[Arriving, Callable[[], None]] | None = None

    def ask(self, wrong: Tensor, refuse: Callable[[], None]) -> None:
        """Asks one more question, and finds the answer to the last one.

        Args:
            wrong: ``[]`` bool.
            refuse: called if it is so; raises an error that says what is wrong.
        """
        if on_host(wrong):
            if wrong:
                refuse()
            return
        self.settle()
        self._open = Arriving(wrong), refuse

    def settle(self) -> None:
        """Finds the answer to the last question, if it is not known yet."""
        last, self._open = self._open, None
        if last is not None and last[0].truth():
            last[1]()

    def forget(self) -> None:
        """The last question no longer matters."""
        self._open = None


def multiplies_bfloat16(kind: str) -> bool:
    """Whether devices of a kind (``"cpu"``, ``"cuda"``) multiply bfloat16 in hardware."""
    if kind == "cpu":
        has = torch.cpu.get_capabilities()
        return bool(has.get("amx_bf16", False) or has.get("avx512_bf16", False))
    return kind == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)


def is_faster_in_bfloat16(kind: str) -> bool:
    """Whether devices of a kind multiply matrices of bfloat16 faster than those of float32.

    An Intel Xeon with AVX-512 BF16 whose AMX was hidden took twice the time of float32; an AMD with AVX-512 BF16 took
    less.
    """
    if kind != "cpu":
        return multiplies_bfloat16(kind)
    has = torch.cpu.get_capabilities()
    return bool(has.get("amx_bf16") or (has.get("avx512_bf16") and "Intel" not in has.get("cpu_name", "")))


def autocast_dtype(tensor: Tensor) -> torch.dtype | None:
    """The dtype that autocast uses for matrix products on a tensor's device; ``None`` outside autocast."""
    kind = tensor.device.type
    if not torch.amp.is_autocast_available(kind) or not torch.is_autocast_enabled(kind):
        return None
    return torch.get_autocast_dtype(kind)


def set_deterministic(deterministic: bool, kind: str) -> None:
    """Whether a GPU gives the same numbers for the same program, bit for bit; for the whole process.

    Operations that can't are then errors. Captured graphs consist of the kernels that were chosen at their recording,
    so it must be set before. A CPU repeats its numbers anyway: nothing is changed there.

    Args:
        deterministic: ``False``: the fastest kernels, some of which add in any order.
        kind: of device, ``"cpu"`` or ``"cuda"``.

    Raises:
        ValueError: if cuBLAS has begun, or was told, otherwise.
    """
    if kind != "cuda":
        return
    if deterministic:
        _set_workspace()
    torch.use_deterministic_algorithms(deterministic)
    torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = deterministic, False


def _set_workspace() -> None:
    found = os.environ.get(WORKSPACE)
    if found in _WORKSPACES:
        return
    if found is not None or torch.cuda.is_initialized():
        what = "nothing, and the GPU is in use, so that it is too late" if found is None else repr(found)
        raise ValueError(
            f"{WORKSPACE} must be {' or '.join(_WORKSPACES)} with deterministic=true, got {what}; set it before the "
            f"program starts: {WORKSPACE}={_WORKSPACES[0]}."
        )
    os.environ[WORKSPACE] = _WORKSPACES[0]
