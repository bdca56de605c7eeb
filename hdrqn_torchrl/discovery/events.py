"""Which events are subgoals: those that pay, what has to happen before, and what only an action of its own does."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.discovery.changes import ChangeDetector
from hdrqn_torchrl.discovery.control import Control
from hdrqn_torchrl.discovery.history import History, Occurrences, events_of
from hdrqn_torchrl.discovery.selection import Chosen
from hdrqn_torchrl.modules.sizes import check_size

PAYS, LEADS, DEED = 1, 2, 3
"""Why an event is a subgoal: it pays; it comes before one that does; it is something that an action does."""
_ROWS = 200_000  # that are kept at most, of steps with an event
_MICRO = 1_000_000
_SHARE = 0.03  # of rewarded steps that an event that pays has to have


class EventSelection:
    """Chooses events as subgoals. (A :class:`~hdrqn_torchrl.discovery.Selection`.)

    1. Events that pay: at least half of the steps with them have a positive reward. Without any event that does, a
       reward is one itself.
    2. Events without which a kept one hardly happens: they come before it more often than chance has it
       (:meth:`~hdrqn_torchrl.discovery.history.Occurrences.evidence`), given those found so far. So the chain grows
       backwards from the reward: goal, door, key.
    3. While slots are free: deeds, that is, changes made by actions that move nothing, the rarest last. What they are
       good for may not be known before they can be brought about.

    Events with a negative reward, or with hazards, are none. A subgoal keeps its slot. It is dropped if pursuing it
    does not bring it about (:class:`~hdrqn_torchrl.discovery.control.Control`); a deed is, too, if its slot is needed.

    Args:
        detector: whose tokens they are.
        max_subgoals: number of slots, numbered from 1.
        least: number of times that an event has to be seen.
        deeds: whether free slots go to deeds.

    Raises:
        ValueError: if a number breaks its rule.
    """

    def __init__(self, detector: ChangeDetector, *, max_subgoals: int = 8, least: int = 3, deeds: bool = True) -> None:
        check_size("max_subgoals", max_subgoals, 8)
        check_size("least", least, 3)
        self.detector, self.max_subgoals, self.least, self.deeds = detector, max_subgoals, least, deeds
        self.slots: dict[int, int] = {}
        """Slot by token."""
        self.reasons: dict[int, int] = {}
        """Why each token is a subgoal."""
        self.control = Control(max_subgoals + 1)
        self._dropped: list[int] = []
        self._rows: list[Tensor] = []
        self._kept = 0  # rows in all of these
        self._ends: list[Tensor] = []
        self._clock = 0
        self._since = 0

    def observe(self, batch: TensorDictBase) -> None:
        """Takes in collected steps ``[N, T]``, with the events of each."""
        after, action = batch.get("next"), batch.get(keys.ACTION)
        tokens, reward = after.get(keys.EVENTS), after.get(keys.EXTRINSIC_REWARD).squeeze(-1)
        micro = (reward.double() * _MICRO).round().long()
        if (hazard := after.get(keys.HAZARD, None)) is not None:
            micro = torch.where(hazard.squeeze(-1), -_MICRO, micro)
        acted = ~self.detector.moves[action]
        worlds, steps = torch.meshgrid(
            torch.arange(action.shape[0], device=action.device),
            self._clock + torch.arange(action.shape[1], device=action.device),
            indexing="ij",
        )
        rows = torch.cat([torch.stack([worlds, steps, acted.long(), micro], -1), tokens], -1)  # [N, T, 4 + K]
        told = (tokens > 0).any(-1) | (micro != 0)
        self._rows.append(rows[told].cpu())
        self._kept += len(self._rows[-1])
        ends = after.get(keys.DONE).squeeze(-1)
        self._ends.append(torch.stack([worlds[ends], steps[ends]], -1).cpu())
        self._clock += action.shape[1]
        self.control.observe(batch)
        if self._kept > 2 * _ROWS:
            self._forget()

    def update(self) -> Chosen:
        """Looks for subgoals in all that happened so far."""
        self._drop()
        history = self._history()
        events = events_of(history, self.detector.precedence(), least=self.least)
        found = Occurrences(history, events)
        allowed = [token not in self._dropped for token in events]
        for index, reason in self._wanted(found, history):
            if allowed[index]:
                self._keep(events[index], reason)
        seldom = found.repeated * 20 < found.happened
        once = {token for token, is_once in zip(events, seldom.tolist(), strict=True) if is_once}
        return Chosen(slots=dict(self.slots), once=sorted(slot for token, slot in self.slots.items() if token in once))

    def _wanted(self, found: Occurrences, history: History) -> list[tuple[int, int]]:
        """Events that could be subgoals, and why, the most important first."""
        often = max(2, int((history.reward > 0).sum()) * _SHARE)
        pays = (found.rewarded * 2 >= found.counts) & (found.reward > 0) & (found.rewarded >= often)
        kept = pays.nonzero().flatten().tolist()
        wanted = [(index, PAYS) for index in kept]
        touching = torch.tensor([self.detector.at_agent(token) for token in found.events], dtype=torch.bool)
        deeds = (found.acted * 10 >= found.counts * 9) & (found.reward >= 0)
        possible = deeds | (touching & (found.reward >= 0))
        for index in kept:  # which grows
            for other in before(found, index, possible):
                if other not in kept:
                    kept.append(other)
                    wanted.append((other, LEADS))
        if self.deeds:
            common = found.happened.argsort(descending=True, stable=True).tolist()
            wanted += [(index, DEED) for index in common if deeds[index] and index not in kept]
        return wanted

    def _keep(self, token: int, reason: int) -> None:
        """Gives an event a slot, if there is one."""
        if token in self.slots:
            self.reasons[token] = min(self.reasons[token], reason)
            return
        free = sorted(set(range(1, self.max_subgoals + 1)) - set(self.slots.values()))
        if not free and reason != DEED:
            deeds = [each for each in self.slots if self.reasons[each] == DEED]
            free = [self._free(deeds[-1])] if deeds else []
        if free:
            self.slots[token], self.reasons[token] = free[0], reason

    def _free(self, token: int) -> int:
        """Takes its slot from an event."""
        del self.reasons[token]
        slot = self.slots.pop(token)
        self.control.reset(slot)
        return slot

    def _drop(self) -> None:
        """Drops what pursuing does not bring about."""
        for token, slot in list(self.slots.items()):
            if self.control.fails(slot):
                self._dropped.append(token)
                self._free(token)

    def _history(self) -> History:
        """Steps by episode."""
        rows = torch.cat(self._rows) if self._rows else torch.zeros((0, 4 + self.detector.num_tokens)).long()
        ends = torch.cat(self._ends) if self._ends else torch.zeros((0, 2)).long()
        worlds = 1 + int(max(rows[:, 0].max() if len(rows) else 0, ends[:, 0].max() if len(ends) else 0))
        span = self._clock + 1
        last = torch.arange(worlds) * span + self._clock - 1  # of episodes that have not ended
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
            "clock": self._clock,
            "since": self._since,
            "slots": dict(self.slots),
            "reasons": dict(self.reasons),
            "dropped": list(self._dropped),
            "control": self.control.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._rows, self._ends = ([] if state[name] is None else [state[name].cpu()] for name in ("rows", "ends"))
        self._kept = sum(map(len, self._rows))
        self._clock, self._since = state["clock"], state["since"]
        self.slots, self.reasons = dict(state["slots"]), dict(state["reasons"])
        self._dropped = list(state["dropped"])
        self.control.load_state_dict(state["control"])


def before(found: Occurrences, event: int, possible: Tensor) -> list[int]:
    """Events that have to happen before an event, as indices, the plainest first; of the ``possible`` ones ``[M]``."""
    known: list[int] = []
    least = 3.0 + math.log(max(1, int(possible.sum())))
    while True:
        evidence, share = found.evidence(event, known)
        evidence = evidence.masked_fill(~possible, 0.0)
        evidence[[event, *known]] = 0.0
        evidence[share < 0.5] = 0.0
        if len(known) == len(found.events) or not evidence.numel() or evidence.max() < least:
            return known
        known.append(int(evidence.argmax()))
