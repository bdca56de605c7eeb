"""Legs: options by where they began and the subgoal they pursued."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hdrqn_torchrl import keys
from hdrqn_torchrl.keys import OptionKeys


class LegCounter:
    """A monitor: counts options by the subgoal that was attained last when they began, and by the one they pursued.

    Row G stands for the start of an episode. Where an episode begins at a subgoal (practice), ``attained`` of its
    reset says so.

    It counts on the host, wherever the steps lie.

    Args:
        num_subgoals: G.
        names: entries of the set of subgoals; its prefix is that of the columns, too.

    Examples:
        >>> from tensordict import TensorDict
        >>> yes, no = torch.tensor([[[True]]]), torch.tensor([[[False]]])
        >>> after = {"attained": torch.tensor([[[False, True]]]), "active_subgoal": torch.tensor([[1]]),
        ...          "option_done": yes, "subgoal_reached": yes}
        >>> root = {"is_init": yes, "option_init": yes, "attained": torch.tensor([[[False, False]]]), "next": after}
        >>> legs = LegCounter(2)
        >>> legs.observe(TensorDict(root, [1, 1]))
        >>> legs.options.tolist(), legs.reached.tolist()
        ([[0, 0], [0, 0], [0, 1]], [[0, 0], [0, 0], [0, 1]])
    """

    def __init__(self, num_subgoals: int, *, names: OptionKeys = OptionKeys()) -> None:  # noqa: B008 (frozen)
        self.num_subgoals, self.names = num_subgoals, names
        after = (names.attained, names.active_subgoal, names.option_done, names.subgoal_reached)
        self._read = keys.IS_INIT, names.option_init, names.attained, *(("next", key) for key in after)
        self.options = torch.zeros(num_subgoals + 1, num_subgoals, dtype=torch.int64)
        """``[G + 1, G]``: options that have ended."""
        self.reached = torch.zeros_like(self.options)
        """``[G + 1, G]``: those of them that reached their subgoal."""
        self._place: Tensor | None = None  # [N]: attained last
        self._origin: Tensor | None = None  # [N]: attained last when the option began

    def observe(self, batch: TensorDictBase) -> None:
        """Takes a collected batch ``[N, T]``."""
        for step in batch.select(*self._read).cpu().unbind(1):
            self.add_step(step)

    def add_step(self, step: TensorDictBase, counted: Tensor | None = None) -> None:
        """Takes one step of all environments ``[N]``, its outcome below ``"next"``.

        Args:
            step: of all environments.
            counted: in which of them options that end count, ``[N]`` bool; ``None``: in all.
        """
        step = step.select(*self._read).cpu()
        start, after, names = torch.tensor(self.num_subgoals), step.get("next"), self.names
        if self._place is None or self._origin is None:
            self._place = self._origin = start.expand(step.batch_size)
        fresh = torch.where(step[names.attained].any(-1), step[names.attained].int().argmax(-1), start)
        place = torch.where(step[keys.IS_INIT].squeeze(-1), fresh, self._place)
        self._origin = torch.where(step[names.option_init].squeeze(-1), place, self._origin)
        leg = self._origin * self.num_subgoals + after[names.active_subgoal]
        for counts, happened in ((self.options, names.option_done), (self.reached, names.subgoal_reached)):
            now = after[happened].squeeze(-1)
            counts.view(-1).index_add_(0, leg, (now if counted is None else now & counted).long())
        attained = after[names.attained]
        self._place = torch.where(attained.any(-1), attained.int().argmax(-1), place)

    @property
    def rates(self) -> Tensor:
        """``[G + 1, G]``: share of the options that reached their subgoal; NaN where there was none."""
        return self.reached / self.options

    def metrics(self) -> dict[str, float]:
        """:attr:`rates` by name, such as ``legs/start_to_0``."""
        names = [*range(self.num_subgoals), "start"]
        return {
            f"{self.names.of('legs')}/{origin}_to_{target}": rate
            for origin, row in zip(names, self.rates.tolist(), strict=True)
            for target, rate in enumerate(row)
        }

    def clear(self) -> None:
        """Counts from zero again; episodes and options in progress go on."""
        self.options.zero_()
        self.reached.zero_()

    def state_dict(self) -> dict[str, Any]:
        """Counts, and where the options in progress began."""
        return {"options": self.options, "reached": self.reached, "place": self._place, "origin": self._origin}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        options, reached, place, origin = (state[name] for name in ("options", "reached", "place", "origin"))
        self.options, self.reached = options.cpu().clone(), reached.cpu().clone()
        self._place, self._origin = (None if each is None else each.cpu() for each in (place, origin))
