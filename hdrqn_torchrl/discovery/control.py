"""Whether a subgoal comes about more often while it is pursued than otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys

_TRIALS = 6  # in a row; a head may still be learning, and most actions may be random
_EXPECTED = 20  # times in a trial; fewer tell nothing


class Control:
    """Counts how often subgoals are attained while they are pursued, and while others are.

    A trial has at least ``trial_steps`` steps in pursuit of a subgoal, and so many that it would be attained 20 times
    if its pursuit made no difference. A subgoal fails if in six trials in a row it was attained less than 1.2 times as
    often as in the pursuit of others, where it was available.

    Args:
        num_subgoals: G.
        trial_steps: least number of steps of a trial.
        gain: how much more often it has to be attained.
    """

    def __init__(self, num_subgoals: int, *, trial_steps: int = 5_000, gain: float = 1.2) -> None:
        self.trial_steps, self.gain = trial_steps, gain
        self.counts = torch.zeros((4, num_subgoals), dtype=torch.int64)
        """Steps in pursuit, attained in pursuit, other steps, attained in these, ``[4, G]``, of the last trial."""
        self.trials = torch.zeros(num_subgoals, dtype=torch.int64)
        """Trials in a row that showed no control."""
        self.failed = torch.zeros(num_subgoals, dtype=torch.bool)

    def observe(self, batch: TensorDictBase) -> None:
        """Takes in collected steps ``[N, T]``."""
        after = batch.get("next")
        active, attained = after.get(keys.ACTIVE_SUBGOAL, None), after.get(keys.ATTAINED, None)
        if active is None or attained is None:
            return
        pursued = torch.nn.functional.one_hot(active, len(self.trials)).bool()
        there = batch.get(keys.SUBGOAL_MASK)
        self.counts += torch.stack([_total(each & there) for each in (pursued, pursued & attained, ~pursued)] + [
            _total(~pursued & attained & there)
        ])  # fmt: skip
        expected = self.counts[3].double() / self.counts[2].clamp(min=1) * self.counts[0]
        over = (self.counts[0] >= self.trial_steps) & (expected >= _EXPECTED)
        weak = self.counts[1] < self.gain * expected
        self.trials = torch.where(over, torch.where(weak, self.trials + 1, 0), self.trials)
        self.failed |= self.trials >= _TRIALS
        self.counts.masked_fill_(over, 0)

    def fails(self, subgoal: int) -> bool:
        """Whether pursuing it does not bring it about."""
        return bool(self.failed[subgoal])

    def reset(self, subgoal: int) -> None:
        """Starts anew, as the subgoal means something else now."""
        self.counts[:, subgoal], self.trials[subgoal], self.failed[subgoal] = 0, 0, False

    def state_dict(self) -> dict[str, Tensor]:
        """All counts."""
        return {"counts": self.counts.clone(), "trials": self.trials.clone(), "failed": self.failed.clone()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        for name in ("counts", "trials", "failed"):
            getattr(self, name).copy_(state[name])


def _total(flags: Tensor) -> Tensor:
    """How many are set, by subgoal."""
    return flags.flatten(0, -2).sum(0).cpu()
