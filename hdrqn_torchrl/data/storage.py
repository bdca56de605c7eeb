"""Where a replay memory keeps its transitions: a ring of rows, with a state from which it continues unchanged."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage


class SequenceStorage(LazyTensorStorage):
    """TorchRL's storage, whose state includes where it was written last.

    Without that, the first samples after a restart join the newest step in the ring to the oldest. TorchRL rounds the
    capacity up to whole rows, too, but only at the first write: a copy that is loaded instead would not know that it is
    full.

    Args:
        capacity: transitions kept, rounded up to whole rows.
        num_envs: N if a row holds a step of each of N environments; ``None`` if a single transition.
        device: where they are kept.

    Examples:
        >>> SequenceStorage(10, num_envs=4).rows
        3
    """

    def __init__(self, capacity: int, *, num_envs: int | None = None, device: torch.device | str = "cpu") -> None:
        self.row_shape = () if num_envs is None else (num_envs,)
        self.rows = -(-capacity // (num_envs or 1))
        super().__init__(self.rows * (num_envs or 1), ndim=1 + len(self.row_shape), device=device)

    newest: int | None = None
    """Row that is about to be written last, if the host knows it; otherwise it would ask the device for it."""

    def _set_last_cursor(self, cursor: Any) -> None:
        super()._set_last_cursor(cursor if self.newest is None else self.newest)

    def check_shape(self, transitions: TensorDictBase) -> None:
        """Refuses transitions that are not ``[N, T]`` of N environments, or ``[M]``.

        Raises:
            ValueError: if so.
        """
        if transitions.ndim != self.ndim or transitions.shape[:-1] != self.row_shape:
            rule = f"[{self.row_shape[0]}, T]" if self.row_shape else "[M]"
            raise ValueError(
                f"transitions must have the shape {rule} that this memory was built for, got "
                f"{list(transitions.shape)}; give each memory the batches of one collector, with the same environments."
            )

    def state_dict(self) -> dict[str, Any]:
        if self._storage is None or not len(self):  # or emptied
            return {"stored": None}
        stored = self[:]  # the part that was written
        return {"stored": stored, "rows": len(self._storage), "last_cursor": self._last_cursor_index}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        stored = state_dict["stored"]
        if stored is not None:
            self._check_state(stored, state_dict["rows"], state_dict["last_cursor"])
        self._bump_mutation_revision()  # samplers must forget the old contents
        self.initialized = stored is not None
        if stored is None:
            self._storage, self._len = None, 0
            return
        self._storage = stored[:1].expand(self.rows, *stored.shape[1:]).clone()
        self._storage[: len(stored)] = stored
        self._len = stored.numel()
        self._set_last_cursor(state_dict["last_cursor"])

    def _check_state(self, stored: TensorDictBase, rows: int, newest: int) -> None:
        if stored.ndim != self.ndim or stored.shape[1:] != self.row_shape or rows != self.rows:
            raise ValueError(
                f"the stored memory must have {self.rows} rows of shape {list(self.row_shape)}, got {rows} of "
                f"{list(stored.shape[1:])}; load it with the capacity and num_envs that it was saved with."
            )
        if not (0 <= newest < len(stored) <= rows):
            raise ValueError(
                f"the stored memory must hold 1 to {rows} rows, the newest among them, got {len(stored)} with the "
                f"newest at {newest}; it is damaged: use another checkpoint."
            )
