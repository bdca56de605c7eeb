"""Work recorded once as a graph of a GPU and replayed: one call of the driver instead of thousands of small kernels.

Untested on a GPU: the tests replace the recording by a stand-in for the CPU. docs/gpu.md says more.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Any, Literal, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

Capture = Literal["auto"] | bool


class Recording(Protocol):
    """One piece of work that can be replayed on the same memory."""

    def warm_up(self, work: Callable[[], Any]) -> Any:
        """Does the work, as it is."""

    def record(self, work: Callable[[], Any]) -> Any:
        """Records the work without doing it; returns its results, which :meth:`replay` fills."""

    def replay(self) -> None:
        """Does the recorded work."""


class CudaRecording:
    """A ``torch.cuda.CUDAGraph``, warmed up on the stream that it is captured on.

    Args:
        generators: random generators that the work draws from, besides the device's default one; each replay goes on
            where the last one left them.
    """

    def __init__(self, generators: Sequence[torch.Generator] = ()) -> None:
        self._graph, self._stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
        for generator in generators:
            self._graph.register_generator_state(generator)

    def warm_up(self, work: Callable[[], Any]) -> Any:
        """Does the work on the stream of the capture."""
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            result = work()
        torch.cuda.current_stream().wait_stream(self._stream)
        return result

    def record(self, work: Callable[[], Any]) -> Any:
        """Captures the work; its results lie in memory of the graph."""
        with torch.cuda.graph(self._graph, stream=self._stream):
            return work()

    def replay(self) -> None:
        """Replays the graph on the current stream."""
        self._graph.replay()


class Captured:
    """A function of a minibatch, recorded after a few calls and replayed from then on.

    The first calls do the work, as they would without recording: kernels are chosen then, and what the function keeps
    from call to call gets its memory. All minibatches must have the same entries, shapes and dtypes.

    Args:
        function: takes a minibatch and a variant; reads no value on the host, and changes only tensors in place.
        warm_ups: calls before the recording.
        recording: makes a recording.

    Examples:
        See :class:`~hdrqn_torchrl.learning.Learner`.
    """

    def __init__(
        self,
        function: Callable[[TensorDictBase | None, Any], dict[str, Tensor]],
        *,
        warm_ups: int = 3,
        recording: Callable[[], Recording] = CudaRecording,
    ) -> None:
        self._function, self._warm_ups, self._make_recording = function, warm_ups, recording
        self.reset()

    def reset(self) -> None:
        """Forgets all recordings: what the function keeps has been replaced."""
        self._inputs: TensorDictBase | None = None
        self._pieces: dict[Hashable, Replayed] = {}

    def __call__(self, sample: TensorDictBase | None, variant: Hashable = None) -> dict[str, Tensor]:
        """Does the work for ``sample``.

        Args:
            sample: the minibatch; ``None``: the function draws it.
            variant: what the host has decided: there is one recording for each.

        Returns:
            The function's results, which later calls leave alone.
        """
        piece = sample is None, variant
        if piece not in self._pieces:
            self._pieces[piece] = Replayed(self._make_recording(), self._warm_ups)
        inputs = None if sample is None else self._hold(sample)
        return self._pieces[piece](lambda: self._function(inputs, variant))

    def _hold(self, sample: TensorDictBase) -> TensorDictBase:
        """The minibatch in the memory that recordings read."""
        if self._inputs is None:
            self._inputs = sample.clone()
        else:
            _copy(sample, self._inputs)
        return self._inputs


class Replayed:
    """One piece of work on the same memory: done as it is at first, then recorded, and replayed from then on.

    Args:
        recording: not used yet.
        warm_ups: calls before the recording.
    """

    def __init__(self, recording: Recording, warm_ups: int) -> None:
        self._recording, self._left = recording, warm_ups
        self._results: dict[Any, Tensor] | None = None

    def __call__(self, work: Callable[[], dict[Any, Tensor]]) -> dict[Any, Tensor]:
        """Does the work; returns its results, which later calls leave alone."""
        if self._left:
            self._left -= 1
            return self._recording.warm_up(work)
        if self._results is None:
            self._results = self._recording.record(work)
        self._recording.replay()
        return {name: value.clone() for name, value in self._results.items()}


def _copy(sample: TensorDictBase, inputs: TensorDictBase) -> None:
    """Copies a minibatch into the memory that recordings read, with one call for all entries."""
    into = dict(inputs.items(True, True))
    new = {key: sample.get(key) for key in into}
    assert len(list(sample.keys(True, True))) == len(into), "a minibatch has other entries than the first one"
    for key, value in new.items():
        same = (value.shape, value.dtype) == (into[key].shape, into[key].dtype)
        assert same, f"{key} is {list(value.shape)} {value.dtype}, unlike in the first minibatch"
    torch._foreach_copy_(list(into.values()), list(new.values()))


def wants_capture(capture: Capture, kind: str) -> bool:
    """Whether a setting means that work on a kind of device is captured.

    Args:
        capture: ``"auto"`` is ``True`` on a GPU.
        kind: ``"cpu"``, ``"cuda"``.

    Raises:
        ValueError: if it is unknown, or ``True`` without a GPU.

    Examples:
        >>> wants_capture("auto", "cpu"), wants_capture("auto", "cuda"), wants_capture(False, "cuda")
        (False, True, False)
    """
    if capture not in ("auto", True, False):
        raise ValueError(f"capture must be 'auto', True or False, got {capture!r}; 'auto' captures on a GPU.")
    if capture is True and kind != "cuda":
        raise ValueError(
            f"capture must be 'auto' or False on {kind}, got True; only a GPU has graphs: use device=cuda."
        )
    return kind == "cuda" if capture == "auto" else capture
