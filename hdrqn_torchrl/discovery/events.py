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
from hdrqn_torchrl.discovery.history import History, Occurrences, events_of, slots_attained_once
from hdrqn_torchrl.discovery.record import EventRecord
from hdrqn_torchrl.discovery.selection import Chosen
from hdrqn_torchrl.modules.sizes import check_size

PAYS, LEADS, DEED = 1, 2, 3
"""Why an event is a subgoal: it pays; it comes before one that does, or was taken over; an action does it."""
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

    Events with a negative reward, or with hazards, are none. A subgoal keeps its slot, but for deeds: one is dropped if
    its slot is needed, or if pursuing it does not bring it about (:class:`~hdrqn_torchrl.discovery.control.Control`);
    then it comes back only if it pays or leads.

    Args:
        detector: whose tokens they are.
        max_subgoals: number of slots, numbered from 1.
        least: number of times that an event has to be seen.
        deeds: whether free slots go to deeds.

    Raises:
        ValueError: if a number breaks its rule.

    Examples:
        >>> from tensordict import TensorDict
        >>> selection = EventSelection(ChangeDetector((5,) * 9, num_actions=4, num_dims=2), max_subgoals=2)
        >>> events, reward, done = torch.zeros(1, 8, 5).long(), torch.zeros(1, 8, 1), torch.zeros(1, 8, 1).bool()
        >>> events[:, ::2, 0], reward[:, ::2] = 116, 1.0
        >>> after = {"events": events, "extrinsic_reward": reward, "done": done}
        >>> selection.observe(TensorDict({"action": torch.zeros(1, 8).long(), "next": after}, [1, 8]))
        >>> selection.update()
        Chosen(slots={116: 1}, once=[])
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
        self._once: list[int] = []
        self._dropped: list[int] = []
        self._record = EventRecord(detector.num_tokens)

    def observe(self, batch: TensorDictBase) -> None:
        """Takes in collected steps ``[N, T]``, with the events of each."""
        self._record.add(batch, acted=~self.detector.moves[batch.get(keys.ACTION)])
        self.control.observe(batch)

    def update(self) -> Chosen:
        """Looks for subgoals in all that happened so far."""
        self._drop()
        history = self._record.history()
        events = events_of(history, self.detector.precedence(), least=self.least)
        found = Occurrences(history, events)
        for index, reason in self._wanted(found, history):
            if reason != DEED or events[index] not in self._dropped:
                self._keep(events[index], reason)
        own = Occurrences(history, list(self.slots))  # an event with a slot may since have become part of another one
        self._once = slots_attained_once(self.slots, own, before=self._once)
        return Chosen(slots=dict(self.slots), once=list(self._once))

    def take_over(self, chosen: Chosen) -> None:
        """Begins with subgoals that an agent has already; they keep their slots."""
        self.slots, self._once = dict(chosen.slots), list(chosen.once)
        self.reasons = dict.fromkeys(self.slots, LEADS)

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
        """Drops deeds that pursuing does not bring about."""
        for token, slot in list(self.slots.items()):
            if self.reasons[token] == DEED and self.control.fails(slot):
                self._dropped.append(token)
                self._free(token)

    def state_dict(self) -> dict[str, Any]:
        """All that a resumed training needs."""
        return {
            **self._record.state_dict(),
            "slots": dict(self.slots),
            "reasons": dict(self.reasons),
            "once": list(self._once),
            "dropped": list(self._dropped),
            "control": self.control.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._record.load_state_dict(state)
        self.slots, self.reasons = dict(state["slots"]), dict(state["reasons"])
        self._once = list(state.get("once", []))  # earlier versions had none
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
