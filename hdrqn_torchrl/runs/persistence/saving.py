"""When a training is saved, and what of it: its parts in a checkpoint, once for each place that it has come to."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import CheckpointError

from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints
from hdrqn_torchrl.runs.persistence.components import explained
from hdrqn_torchrl.runs.persistence.serialization import check_storable
from hdrqn_torchrl.runs.persistence.state_checks import Rule


class Saving:
    """Writes checkpoints of a training and reads them.

    Args:
        checkpoints: where they lie; ``None``: nothing is saved.
        parts: all that the training consists of, by name; they are restored in the order of their names.
        place: how far the training has come; it is saved once at each.
        seconds: after which one is written in any case.
    """

    def __init__(
        self,
        checkpoints: Checkpoints | None,
        parts: Callable[[], dict[str, Any]],
        *,
        place: Callable[[], tuple],
        seconds: float,
    ) -> None:
        self.checkpoints, self._parts, self._place, self._seconds = checkpoints, parts, place, seconds
        self._at, self._saved = time.monotonic(), ()
        self._whole = True

    def is_late(self) -> bool:
        """Whether the last one was written too long ago."""
        return time.monotonic() - self._at >= self._seconds

    def save(self, frames: int, *, score: float | None = None) -> None:
        """Writes a checkpoint of the whole training, unless nothing happened since the last one.

        Args:
            frames: of the training.
            score: greedy return of these very weights, if it is the best so far.

        Raises:
            CheckpointError: if it can't be written.
        """
        if self.checkpoints is not None and self._place() != self._saved:
            self.checkpoints.save(self._parts(), step=frames, score=score)
            self._take_note()

    def check_storable(self, name: str) -> None:
        """Tries whether a part can be stored: at the first checkpoint a failure would cost all that came before.

        Args:
            name: of the part.

        Raises:
            CheckpointError: if it holds what no checkpoint can.
        """
        if self.checkpoints is None:
            return
        try:
            check_storable(self._parts()[name].state_dict(), name)
        except TypeError as error:
            raise CheckpointError(
                f"{error} Where that is the environment's, change what its state_dict returns; nothing was trained yet."
            ) from error

    def save_after(self, error: Exception, frames: int, *, given_up: bool = False) -> None:
        """Writes one though something has failed; the error takes note if it can't be written, either.

        Nothing is written after an error :meth:`in_parts`.

        Args:
            error: what was raised.
            frames: of the training.
            given_up: whether the collector has forgotten its episodes since: those of a checkpoint that was written at
                this very place would lead into the same error again.
        """
        if not self._whole:
            return
        if given_up:
            self._saved = ()
        try:
            self.save(frames)
        except Exception as failed:  # that which came first is to be told
            error.add_note(f"The training could not be saved, either: {failed}")

    @contextmanager
    def in_parts(self) -> Iterator[None]:
        """Inside, an error leaves a training that belongs to no place: half of a batch is stored."""
        self._whole = False
        yield
        self._whole = True

    def load(self, path: Path, *, device: torch.device, rules: Mapping[str, Rule]) -> list[str]:
        """Restores everything from a checkpoint.

        Args:
            path: of the checkpoint.
            device: where tensors are put.
            rules: what entries of TensorDicts must be (:func:`~hdrqn_torchrl.runs.persistence.state_checks.rules_of`).

        Returns:
            Names of the parts that it does not hold.

        Raises:
            CheckpointError: if it is damaged, of another kind of training, or of phases as earlier versions stored
                them.
        """
        assert self.checkpoints is not None
        try:
            missing = self.checkpoints.load(self._parts(), path, device=device, rules=rules)
        except CheckpointError as error:
            raise explained(error, path) from error
        self._take_note()
        return missing

    def _take_note(self) -> None:
        self._at, self._saved = time.monotonic(), self._place()
