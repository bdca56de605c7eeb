"""Subgoals that no episode attains: their condition may be wrong, and nobody else would say so."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.envs import SubgoalSet

EPISODES = 200
"""After so many at least, and a tenth of the training."""
_SHARE = 0.1


class UnattainedSubgoals:
    """Watches a training for subgoals that are never attained, and warns of them once.

    What was seen stays on its device until it is asked for.

    Args:
        sets: of the subgoals that the agent pursues.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> watch = UnattainedSubgoals([SubgoalSet(names=("key", "door"))])
        >>> step = {"attained": torch.tensor([[[True, False]]]), "done": torch.ones(1, 1, 1, dtype=torch.bool)}
        >>> watch.observe(TensorDict({"next": step}, [1, 1]))
        >>> watch.names()
        ['door']
    """

    def __init__(self, sets: Sequence[SubgoalSet]) -> None:
        self._sets = tuple(sets)
        self._seen: list[Tensor] = []  # [G] bool of each set
        self._episodes: Tensor | int = 0

    def observe(self, batch: TensorDictBase) -> None:
        """Takes in a collected batch ``[N, T]``."""
        if not self._sets:
            return
        after = batch.get("next")
        now = [after.get(each.keys.attained).flatten(0, 1).any(0) for each in self._sets]
        self._seen = [old | new for old, new in zip(self._seen, now, strict=True)] if self._seen else now
        self._episodes = self._episodes + after.get(keys.DONE).sum()

    def names(self) -> list[str]:
        """Of those that were not attained so far."""
        pairs = zip(self._sets, self._seen, strict=False)
        return [name for each, seen in pairs for name, was in zip(each.names, seen.tolist(), strict=True) if not was]

    def warn(self, share: float) -> None:
        """Warns, if there has been time enough.

        Args:
            share: of the training that is over.
        """
        if not self._sets or share < _SHARE or (episodes := int(self._episodes)) < EPISODES:
            return
        if names := self.names():
            warnings.warn(
                f"subgoals should be attained now and then while an agent explores, got none of {names} in {episodes} "
                "episodes. They may be hard to reach; if not, look at their conditions: a subgoal is attained in the "
                "step in which its condition becomes true, so one that holds from the start is never attained.",
                stacklevel=2,
            )
        self._sets = ()

    def state_dict(self) -> dict[str, Any]:
        """What was seen, unless it has been told."""
        return {"seen": list(self._seen), "episodes": int(self._episodes), "told": not self._sets}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._seen, self._episodes = list(state["seen"]), state["episodes"]
        if state["told"]:
            self._sets = ()
