"""A stand-in for CUDA graphs that runs on a CPU: operations are recorded with the tensors that they read and wrote.

Like a graph, a replay repeats the operations on the same memory: whatever the host put in (a learning rate, a counter,
a branch) is what it was at the recording. So a function whose replays give the same numbers as calls would can be
captured, as far as its operations can.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from waits import HostWaits


class Tape(TorchDispatchMode):
    """A recording (see :class:`hdrqn_torchrl.learning.captured.Recording`) made on a CPU.

    A capture does not do the work, but a CPU can't help it: all memory that existed before is put back afterwards.

    Args:
        generators: random generators that the work draws from, besides torch's default one.

    Examples:
        >>> tape, x, total = Tape(), torch.ones(2), torch.zeros(2)
        >>> y = tape.record(lambda: total.add_(x) * 2)
        >>> total.tolist()
        [0.0, 0.0]
        >>> _ = x.fill_(3.0)
        >>> tape.replay()
        >>> total.tolist(), y.tolist()
        ([3.0, 3.0], [6.0, 6.0])
    """

    def __init__(self, generators: Sequence[torch.Generator] = ()) -> None:
        super().__init__()
        self._generators = [torch.default_generator, *generators]
        self._calls: list[tuple[Callable, tuple, dict, list[tuple[Tensor, bool]], bool]] = []
        self._before: dict[int, tuple[torch.UntypedStorage, torch.UntypedStorage]] = {}
        self._made: set[int] = set()

    def warm_up(self, work: Callable[[], Any]) -> Any:
        return work()

    def record(self, work: Callable[[], Any]) -> Any:
        states = [each.get_state() for each in self._generators]
        with HostWaits() as waits, self:
            result = work()
        assert waits.found == []
        for storage, kept in self._before.values():
            storage.copy_(kept)
        for each, state in zip(self._generators, states, strict=True):
            each.set_state(state)
        return result

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        read = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        for tensor in read:  # as they were before anything was done to them
            storage = tensor.untyped_storage()
            if storage._cdata not in self._made and storage._cdata not in self._before:
                self._before[storage._cdata] = storage, storage.clone()
        known = {tensor.untyped_storage()._cdata for tensor in read}
        result = function(*args, **kwargs)
        written = [leaf for leaf in tree_leaves(result) if isinstance(leaf, Tensor)]
        fresh = [(tensor, tensor.untyped_storage()._cdata not in known) for tensor in written]
        self._made |= {tensor.untyped_storage()._cdata for tensor, is_new in fresh if is_new}
        self._calls.append((function, args, kwargs, fresh, torch.is_grad_enabled()))
        return result

    def replay(self) -> None:
        for function, args, kwargs, outputs, grad in self._calls:
            with torch._C._AutoDispatchBelowAutograd(), torch.set_grad_enabled(grad):  # kernels only
                results = [leaf for leaf in tree_leaves(function(*args, **kwargs)) if isinstance(leaf, Tensor)]
                for (output, is_new), result in zip(outputs, results, strict=True):
                    if is_new:
                        output.copy_(result)
