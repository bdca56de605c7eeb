"""What is counted besides the learning: one protocol, and visits of subgoals as its simplest case."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys


class Monitor(Protocol):
    """Something that watches the collected steps, and may act on them.

    An :class:`~hdrqn_torchrl.algorithms.Algorithm` has them by name; the trainer logs, clears and stores all alike.
    """

    def observe(self, batch: TensorDictBase) -> None:
        """Takes in a collected batch ``[N, T]``."""

    def metrics(self) -> dict[str, float]:
        """Columns of the next row; reading them changes nothing."""

    def clear(self) -> None:
        """Begins the next row. It is called when the last one is written, no sooner."""

    def state_dict(self) -> dict[str, Any]:
        """All that a resumed training needs."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""


class VisitCounter:
    """How often each episode attained each subgoal, over the episodes that ended since the last row.

    Args:
        attained_key: below ``"next"``, ``[G]`` bool.

    Examples:
        >>> from tensordict import TensorDict
        >>> attained, done = torch.tensor([[[True, False], [True, False]]]), torch.tensor([[[False], [True]]])
        >>> visits = VisitCounter()
        >>> visits.observe(TensorDict({"next": {"attained": attained, "done": done}}, [1, 2]))
        >>> visits.metrics()["behaviour/visits_0"]
        2.0
    """

    def __init__(self, *, attained_key: NestedKey = keys.ATTAINED) -> None:
        self.attained_key = attained_key
        self._open: Tensor | None = None  # [N, G]: visits of the episodes in progress
        self._ended: list[Tensor] = []  # [M, G] each

    def observe(self, batch: TensorDictBase) -> None:
        """Takes in a collected batch ``[N, T]``."""
        after = batch.get("next")
        attained, done = after.get(self.attained_key).float(), after.get(keys.DONE)
        visits, sums = torch.zeros_like(attained[:, 0]) if self._open is None else self._open, []
        if (init := batch.get(keys.IS_INIT, None)) is not None:
            visits = visits.masked_fill(init[:, 0], 0.0)  # an episode in progress was lost between two batches
        for now, end in zip(attained.unbind(1), done.unbind(1), strict=True):
            sums.append(visits + now)
            visits = sums[-1].masked_fill(end, 0.0)
        self._open = visits
        self._ended.append(torch.stack(sums, 1)[done.squeeze(-1)])

    def metrics(self) -> dict[str, float]:
        """Share of episodes that attained each subgoal, and how often they did; nothing if none has ended."""
        ended = torch.cat(self._ended) if self._ended else None
        if ended is None or not len(ended):
            return {}
        shares, visits = (ended > 0).float().mean(0).tolist(), ended.mean(0).tolist()
        columns = {f"behaviour/attained_{index}": share for index, share in enumerate(shares)}
        return columns | {f"behaviour/visits_{index}": number for index, number in enumerate(visits)}

    def clear(self) -> None:
        """Forgets the episodes that ended."""
        self._ended = []

    def state_dict(self) -> dict[str, Any]:
        """Episodes in progress, and those that ended since the last row."""
        return {"open": self._open, "ended": list(self._ended)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._open, self._ended = state["open"], list(state["ended"])
