"""Finds subgoals while an agent is trained."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase

from hdrqn_torchrl import keys
from hdrqn_torchrl.discovery.critic import EventCritic
from hdrqn_torchrl.discovery.relabelling import relabel
from hdrqn_torchrl.discovery.selection import Chosen, Selection
from hdrqn_torchrl.discovery.settings import DiscoverySettings
from hdrqn_torchrl.learning import Learner
from hdrqn_torchrl.modules import SubgoalSuccess


class Discovery:
    """Teaches the detector, asks for subgoals from time to time, and tells stored steps anew. (A monitor.)

    1. The detector learns from all steps until it is ready. Events of the steps up to then are unknown, so memories
       forget them, and warm up again.
    2. Every ``discovery_frames`` the selection is asked which events are subgoals; stored steps are relabelled
       (:func:`~hdrqn_torchrl.discovery.relabel`), so that new heads learn at once from all that was seen.

    A head whose slot gets another event is left as it is: it learns the new one from stored steps within a few hundred
    updates, and what all heads have in common serves it, too. Options can't be told anew: where an agent learns from
    them, their memory begins empty with every new subgoal, which they could not have chosen, and that of steps does so
    as well where a slot loses its event.

    Args:
        critic: of the agent.
        selection: chooses.
        steps: learns from steps, whose memory is relabelled.
        settings: when.
        options: learners whose memories hold options.
        successes: how often subgoals are reached, which begin again for slots that get another event.

    Examples:
        >>> from hdrqn_torchrl.algorithms import make_v3
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> settings = DiscoverySettings(max_subgoals=2)
        >>> env = MultiGoalGridEnv(num_envs=2)
        >>> agent = make_v3(env, compact_network(8, (8,)), subgoals="discovered", discovery=settings)
        >>> agent.monitors["discovery"].metrics()
        {'discovery/subgoals': 0, 'discovery/found_1': 0, 'discovery/found_2': 0}
    """

    def __init__(
        self,
        critic: EventCritic,
        selection: Selection,
        steps: Learner,
        settings: DiscoverySettings,
        *,
        options: Sequence[Learner] = (),
        successes: Sequence[SubgoalSuccess] = (),
    ) -> None:
        self.critic, self.selection, self.settings = critic, selection, settings
        self.steps, self.options, self.successes = steps, options, successes
        self.frames = 0

    def observe(self, batch: TensorDictBase) -> None:
        """Takes in a collected batch ``[N, T]``, after learners have stored it."""
        before, self.frames = self.frames, self.frames + batch.numel()
        if not self.critic.detector.ready:
            self._teach(batch)
            return
        self.selection.observe(batch)
        interval, until = self.settings.discovery_frames, self.settings.until_frames
        due = self.frames // interval * interval  # batches end somewhere behind it
        if due > before and (until is None or due <= until):
            self._discover()

    def _teach(self, batch: TensorDictBase) -> None:
        """Shows the detector a batch; once that is ready, memories forget what was stored."""
        after = batch.get("next").get(keys.OBSERVATION)
        self.critic.detector.observe(batch.get(keys.OBSERVATION), batch.get(keys.ACTION), after)
        if self.critic.detector.ready:
            _forget(self.steps, *self.options)

    def _discover(self) -> None:
        table, chosen = self.critic.table, self.selection.update()
        in_use = table.in_use
        before = table.tokens.clone(), table.slots.clone(), table.once.clone()
        kept = table.assign(chosen.slots, once=chosen.once, frames=self.frames)
        if all(torch.equal(old, new) for old, new in zip(before, (table.tokens, table.slots, table.once), strict=True)):
            return
        for success in self.successes:
            success.forget(~kept)
        if self.options and (in_use & ~kept).any():
            _forget(self.steps)
        else:
            self.steps.rewrite(partial(relabel, table=table, kept=kept))
        if ((in_use | table.in_use) & ~kept).any():
            _forget(*self.options)

    def take_over(self) -> None:
        """Goes on with the subgoals that the critic has, as when it came with weights of another training."""
        table = self.critic.table
        slots = {token: slot for slot in range(table.num_subgoals) for token in table.tokens_of(slot)}
        self.selection.take_over(Chosen(slots=slots, once=table.once.nonzero().flatten().tolist()))

    def metrics(self) -> dict[str, float]:
        """Number of subgoals, and when each was found (0: the slot is free)."""
        table = self.critic.table
        found = {f"discovery/found_{slot}": frames for slot, frames in enumerate(table.found.tolist()) if slot}
        return {"discovery/subgoals": int(table.in_use.sum()), **found}

    def clear(self) -> None:
        """Nothing starts again with a row."""

    def state_dict(self) -> dict[str, Any]:
        """What it has counted; the critic is a part of the policy."""
        return {"frames": self.frames, "selection": self.selection.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self.frames = state["frames"]
        self.selection.load_state_dict(state["selection"])


def _forget(*learners: Learner) -> None:
    for learner in learners:
        learner.begin_empty()
        learner.extract.reset()  # options wait there for the end of their episode
