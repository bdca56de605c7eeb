"""Several trainings in one process that share a device, each as if it were alone.

They take turns in one thread: each is a generator that yields where its host would wait for the device
(:meth:`~hdrqn_torchrl.runs.trainer.Trainer.pieces`), and the others' work keeps the device busy meanwhile, as each has
a stream of its own. Threads would not help: Python runs one at a time, and random numbers of the process (torch, numpy,
Python) would be drawn in any order, where here each training finds them as it left them. Nor are the parameters of all
stacked in one: every algorithm would have to know of it, and what a training learns would depend on its neighbours'
rounding.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Mapping
from contextlib import ExitStack
from typing import TypeVar

import torch

from hdrqn_torchrl.random_numbers import host_state, set_host_state
from hdrqn_torchrl.runs.interruption import Interrupted

Result = TypeVar("Result")
Pieces = Generator[None, None, Result]


class Turn:
    """What is global in a process, as one training left it: random numbers and, on a GPU, the stream.

    On a GPU the default generator gets a state of its own for each training: captured graphs read the state that they
    were recorded with, and would otherwise overwrite each other's place in it.

    Args:
        kind: of device, ``"cpu"`` or ``"cuda"``.

    Examples:
        >>> first, second = Turn("cpu"), Turn("cpu")
        >>> numbers = []
        >>> for turn in (first, second, first):
        ...     with turn:
        ...         if len(numbers) < 2:
        ...             _ = torch.manual_seed(3)
        ...         numbers.append(torch.rand(()).item())
        >>> numbers[0] == numbers[1] != numbers[2]
        True
    """

    def __init__(self, kind: str) -> None:
        self._own = host_state()
        self._outside = self._own
        self._stream: torch.cuda.Stream | None = None
        if kind == "cuda":
            torch.cuda.init()
            self._stream = torch.cuda.Stream()
            self._generator = _of_gpu().clone_state()

    def __enter__(self) -> None:
        self._outside = host_state()
        set_host_state(self._own)
        self._leave = ExitStack()
        if self._stream is not None:
            outside = _of_gpu().graphsafe_get_state()
            _of_gpu().graphsafe_set_state(self._generator)
            self._leave.callback(_of_gpu().graphsafe_set_state, outside)
            self._leave.enter_context(torch.cuda.stream(self._stream))

    def __exit__(self, *_: object) -> None:
        self._own = host_state()
        set_host_state(self._outside)
        self._leave.close()


def _of_gpu() -> torch.Generator:
    """The default generator of the GPU in use."""
    return torch.cuda.default_generators[torch.cuda.current_device()]


def finish(pieces: Pieces[Result]) -> Result:
    """Does all that is left of one training; returns its result."""
    while True:
        try:
            next(pieces)
        except StopIteration as end:
            return end.value


def take_turns(
    trainings: Mapping[str, Pieces[Result]], *, kind: str
) -> tuple[dict[str, Result], dict[str, Exception | Interrupted]]:
    """Trains side by side: a piece of each, round by round.

    Once all have begun, one that fails, or was asked to stop, leaves the others alone.

    Args:
        trainings: by name; of each, the first piece builds it.
        kind: of their device, ``"cpu"`` or ``"cuda"``.

    Returns:
        Results of those that were completed, and why the others were not.

    Raises:
        Exception: if one can't begin; nothing has been trained then.
    """
    results: dict[str, Result] = {}
    ended: dict[str, Exception | Interrupted] = {}
    waiting = deque((name, each, Turn(kind)) for name, each in trainings.items())
    try:
        for _, each, turn in waiting:
            with turn:
                next(each)
        while waiting:
            name, each, turn = waiting.popleft()
            try:
                with turn:
                    next(each)
            except StopIteration as end:
                results[name] = end.value
            except (Exception, Interrupted) as error:
                ended[name] = error
            else:
                waiting.append((name, each, turn))
    finally:
        for _, each, _ in waiting:
            each.close()
    return results, ended
