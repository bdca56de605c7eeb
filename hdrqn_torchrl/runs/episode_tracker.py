"""Sums per episode, in training and evaluation."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs import Task

_SUMMED = {
    "return": keys.REWARD,
    "extrinsic": keys.EXTRINSIC_REWARD,
    "intrinsic": keys.INTRINSIC_REWARD,
}


class EpisodeTracker:
    """Sums what happens in each of N environments and reports the episodes that end.

    Reported per episode: ``return``, ``steps`` and, as far as environment and agent have them, ``extrinsic``,
    ``intrinsic``, ``success`` (1 if any step completed the whole task) and ``in_order`` (share of subgoals reached in
    the proper order, where the task has one).

    Args:
        task: says whether subgoals have an order, and which entry marks success.
        per_subgoal: report ``attained``, ``chosen`` and ``reached`` ``[G]`` as well: how often each subgoal was
            attained, options for it that ended, and those of them that reached it. Nearer sets of subgoals have
            the same entries with their prefix (``rooms_attained``, ...).
    """

    def __init__(self, task: Task = Task(), *, per_subgoal: bool = False) -> None:  # noqa: B008 (frozen)
        self.task, self.per_subgoal = task, per_subgoal
        self.sums: TensorDictBase | None = None  # [N]
        self._in_order: Tensor | None = None  # [N] int64: subgoals attained so far, -1 once the order is broken

    def add(self, after: TensorDictBase) -> TensorDictBase:
        """Takes one step of all environments (what the environment wrote, ``[N]``).

        Returns:
            The sums ``[N]`` up to and including this step; those of ended episodes are cleared afterwards.
        """
        summed = {**_SUMMED, "success": self.task.success}
        step = {name: after.get(key).squeeze(-1).float() for name, key in summed.items() if key in after}
        if self.task.ordered and keys.ATTAINED in after:
            step["in_order"] = self._next_in_order(after)
        step["steps"] = torch.ones_like(step["return"])
        if self.per_subgoal:
            for names in (keys.OptionKeys(), *(each.keys for each in self.task.subgoals[:-1])):
                step |= _subgoal_events(after, names)
        sums = TensorDict(step, after.batch_size, device=after.device)
        if self.sums is not None:
            sums = sums + self.sums
            if "success" in step:
                sums["success"].clamp_(max=1.0)  # in several steps of an episode, it may be
        self.sums = sums.clone().masked_fill_(after.get(keys.DONE).squeeze(-1), 0.0)
        return sums

    def _next_in_order(self, after: TensorDictBase) -> Tensor:
        """The share of all subgoals that a step attained in its turn, 0 or 1/G ``[N]``."""
        attained, done = after.get(keys.ATTAINED), after.get(keys.DONE).squeeze(-1)
        number = attained.shape[-1]
        before = torch.zeros_like(done, dtype=torch.int64) if self._in_order is None else self._in_order
        wanted = before.unsqueeze(-1) == torch.arange(number, device=attained.device)
        is_next = (attained == wanted).all(-1) & wanted.any(-1)
        now = torch.where(is_next, before + 1, torch.where(attained.any(-1), -1, before))
        self._in_order = now.masked_fill(done, 0)
        return is_next.float() / number

    def finished(self, batch: TensorDictBase) -> TensorDictBase:
        """Takes a collected batch ``[N, T]``; returns the episodes ``[M]`` that ended in it."""
        sums, ended = self.follow(batch)
        return sums[ended]

    def follow(self, batch: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """Takes a collected batch ``[N, T]``; returns sums up to each step and whether it is the last, ``[T, N]``."""
        self._forget(batch.get(keys.IS_INIT, None))
        after = batch.get("next").transpose(0, 1)  # [T, N]
        sums: TensorDictBase = torch.stack([self.add(step) for step in after.unbind(0)], 0)  # type: ignore[assignment]
        return sums, after.get(keys.DONE).squeeze(-1)

    def _forget(self, init: Tensor | None) -> None:
        """Clears the sums of episodes that were lost between two batches: others begin in their rows ``[N, T, 1]``."""
        if init is None or self.sums is None:
            return
        begins = init[:, 0].squeeze(-1)
        self.sums = self.sums.masked_fill(begins, 0.0)
        if self._in_order is not None:
            self._in_order = self._in_order.masked_fill(begins, 0)

    def state_dict(self) -> dict[str, Any]:
        """Sums of the episodes in progress."""
        return {"sums": self.sums, "in_order": self._in_order}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned; older states hold no order, which then begins anew."""
        self.sums, self._in_order = state["sums"], state.get("in_order")


def _subgoal_events(after: TensorDictBase, names: keys.OptionKeys) -> dict[str, Tensor]:
    """What happened to each subgoal of a set in one step, ``[N, G]`` each."""
    if names.attained not in after:
        return {}
    attained = after.get(names.attained).float()
    events = {"attained": attained}
    if names.option_done in after:
        active = torch.nn.functional.one_hot(after.get(names.active_subgoal), attained.shape[-1]).float()
        events["chosen"] = active * after.get(names.option_done)
        events["reached"] = active * after.get(names.subgoal_reached)
    return {names.of(name): event for name, event in events.items()}
