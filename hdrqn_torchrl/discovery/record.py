"""Keeps the steps with events, batch by batch, and puts them together by episode."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.discovery.history import History

_ROWS = 200_000  # that are kept at most, of steps with an event
_MICRO = 1_000_000


class EventRecord:
    """All steps with an event or a reward, up to 200,000 at least, and the ends of episodes.

    Args:
        num_tokens: K, of a step.
    """

    def __init__(self, num_tokens: int) -> None:
        self.num_tokens = num_tokens
        self._rows: list[Tensor] = []
        self._kept = 0  # rows in all of these
        self._ends: list[Tensor] = []
        self._worlds = 1
        self._clock = 0
        self._since = 0

    def add(self, batch: TensorDictBase, *, acted: Tensor | None = None) -> None:
        """Takes in collected steps ``[N, T]``, with the events of each.

        Args:
            batch: the steps.
            acted: whether the action was one that moves nothing, ``[N, T]`` bool; ``None``: none was.
        """
        after, action = batch.get("next"), batch.get(keys.ACTION)
        tokens, reward = after.get(keys.EVENTS), after.get(keys.EXTRINSIC_REWARD).squeeze(-1)
        micro = (reward.double() * _MICRO).round().long()
        if (hazard := after.get(keys.HAZARD, None)) is not None:
            micro = torch.where(hazard.squeeze(-1), -_MICRO, micro)
        worlds, steps = torch.meshgrid(
            torch.arange(action.shape[0], device=action.device),
            self._clock + torch.arange(action.shape[1], device=action.device),
            indexing="ij",
        )
        flags = torch.zeros_like(worlds) if acted is None else acted.long()
        rows = torch.cat([torch.stack([worlds, steps, flags, micro], -1), tokens], -1)  # [N, T, 4 + K]
        told = (tokens > 0).any(-1) | (micro != 0)
        self._rows.append(rows[told].cpu())
        self._kept += len(self._rows[-1])
        ends = after.get(keys.DONE).squeeze(-1)
        self._ends.append(torch.stack([worlds[ends], steps[ends]], -1).cpu())
        if self._clock and (init := batch.get(keys.IS_INIT, None)) is not None:
            began = init[:, 0].squeeze(-1)  # what was in progress there before, if anything, was lost between batches
            self._ends.append(torch.stack([worlds[began, 0], steps[began, 0] - 1], -1).cpu())
        self._worlds = max(self._worlds, action.shape[0])
        self._clock += action.shape[1]
        if self._kept > 2 * _ROWS:
            self._forget()

    def history(self) -> History:
        """Steps by episode."""
        rows = torch.cat(self._rows) if self._rows else torch.zeros((0, 4 + self.num_tokens)).long()
        ends = torch.cat(self._ends) if self._ends else torch.zeros((0, 2)).long()
        span = self._clock + 1
        last = torch.arange(self._worlds) * span + self._clock - 1  # of episodes that have not ended
        ended = torch.cat([ends[:, 0] * span + ends[:, 1], last]).unique()  # sorted
        begin = torch.cat([torch.tensor([-1]), ended[:-1]]) + 1
        begin = torch.where(begin % span == self._clock, begin // span * span + span, begin)  # the next world
        begin = torch.maximum(begin, begin // span * span + self._since)
        place = rows[:, 0] * span + rows[:, 1]
        episode = torch.searchsorted(ended, place)
        return History(
            tokens=rows[:, 4:],
            episode=episode,
            step=place - begin[episode],
            acted=rows[:, 2] > 0,
            reward=rows[:, 3],
            lengths=ended - begin + 1,
        )

    def _forget(self) -> None:
        """Forgets the oldest steps."""
        rows, ends = torch.cat(self._rows), torch.cat(self._ends)
        self._since = int(rows[:, 1].sort().values[-_ROWS])
        self._rows, self._ends = [rows[rows[:, 1] >= self._since]], [ends[ends[:, 1] >= self._since]]
        self._kept = len(self._rows[0])

    def state_dict(self) -> dict[str, Any]:
        """All that a resumed training needs."""
        return {
            "rows": torch.cat(self._rows) if self._rows else None,  # one tensor, where batches had thousands
            "ends": torch.cat(self._ends) if self._ends else None,
            "worlds": self._worlds,
            "clock": self._clock,
            "since": self._since,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._rows, self._ends = ([] if state[name] is None else [state[name].cpu()] for name in ("rows", "ends"))
        self._kept = sum(map(len, self._rows))
        seen = [int(each[:, 0].max()) + 1 for each in (*self._rows, *self._ends) if len(each)]
        self._worlds = state.get("worlds", max(seen, default=1))  # earlier versions did not store it
        self._clock, self._since = state["clock"], state["since"]
