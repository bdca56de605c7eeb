"""How often options reach their subgoal lately, and exploration that depends on it."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import one_hot

from hdrqn_torchrl.keys import DONE, OptionKeys
from hdrqn_torchrl.modules.repeating import RepeatingEpsilonGreedy
from hdrqn_torchrl.modules.sizes import check_size


class SubgoalSuccess(nn.Module):
    """Share of the options for each subgoal that reached it: a moving average over the last ones.

    Options for a subgoal that could not be chosen to begin with do not count, nor those that ended before they reached
    it because the option of the level above did, while the episode goes on.

    Args:
        num_subgoals: G.
        window: number of options that the average goes over, or all of them while there are fewer.
        names: entries of the set of subgoals, which :class:`~hdrqn_torchrl.transforms.SubgoalTransform` writes.
        upper_names: those of the set that the level above pursues; ``None``: there is none.

    Raises:
        ValueError: if a number is not positive.

    Examples:
        >>> from tensordict import TensorDict
        >>> success = SubgoalSuccess(num_subgoals=2)
        >>> done, reached = torch.tensor([[[True], [True]]]), torch.tensor([[[True], [False]]])
        >>> step = {"active_subgoal": torch.tensor([[1, 1]]), "option_done": done, "subgoal_reached": reached}
        >>> success.observe(TensorDict({"subgoal_mask": torch.ones(1, 2, 2).bool(), "next": step}, [1, 2]))
        >>> success.rates.tolist()
        [0.0, 0.5]
    """

    rates: Tensor
    """``[G]``; 0 as long as there was no option."""
    options: Tensor
    """``[G]``: how many options have ended."""

    def __init__(
        self,
        num_subgoals: int,
        *,
        window: int = 100,
        names: OptionKeys = OptionKeys(),  # noqa: B008 (frozen)
        upper_names: OptionKeys | None = None,
    ) -> None:
        super().__init__()
        for name, value, usual in (("num_subgoals", num_subgoals, 6), ("window", window, 100)):
            check_size(name, value, usual)
        self.window = window
        after = (names.active_subgoal, names.option_done, names.subgoal_reached)
        self._keys = [names.subgoal_mask, *(("next", key) for key in after)]
        self._upper_done_key = None if upper_names is None else ("next", upper_names.option_done)
        self.register_buffer("rates", torch.zeros(num_subgoals))
        self.register_buffer("options", torch.zeros(num_subgoals, dtype=torch.int64))

    def observe(self, batch: TensorDictBase) -> None:
        """Counts the options that ended in a collected batch ``[N, T]``; they are all equally recent."""
        could, subgoal, done, reached = (batch.get(key) for key in self._keys)
        if self._upper_done_key is not None:
            done = done & (reached | batch.get(("next", DONE)) | ~batch.get(self._upper_done_key))
        pursued = one_hot(subgoal, len(self.rates)) * (done & could).long()  # [N, T, G]
        ended, won = pursued.flatten(0, -2).sum(0), (pursued * reached.long()).flatten(0, -2).sum(0)
        self.options += ended
        remembered = self.options.clamp(max=self.window).float()
        share = (ended / remembered.clamp(min=1)).clamp(max=1.0)
        self.rates.lerp_(won / ended.clamp(min=1), share)

    def forget(self, subgoals: Tensor) -> None:
        """Begins again for subgoals ``[G]`` bool that mean something else now."""
        self.rates.masked_fill_(subgoals, 0.0)
        self.options.masked_fill_(subgoals, 0)


class SuccessEpsilonGreedy(RepeatingEpsilonGreedy):
    r"""Explores the less the more often a subgoal is reached: for subgoal g,
    :math:`\epsilon_g = \max(\epsilon_{end}, \epsilon (1 - \text{success}_g))` (Kulkarni et al., 2016), where
    :math:`\epsilon` follows its schedule.

    While epsilon is 1, success is that of random actions and can't rise: a ladder (or the schedule) has to make some
    environments act on what they learned.

    Args:
        start, end, anneal_frames, ladder, exponent, max_repeats: as in :class:`RepeatingEpsilonGreedy`; with
            ``max_repeats=1`` random actions are not repeated. By default the schedule stays at ``start``: only success
            counts.
        window: of :class:`SubgoalSuccess`.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> exploration = SuccessEpsilonGreedy(1.0, 0.1)
        >>> exploration.set_num_subgoals(2, names=OptionKeys())
        >>> _ = exploration.success.rates.copy_(torch.tensor([0.25, 0.95]))
        >>> exploration.epsilons(torch.zeros(2), torch.tensor([0, 1])).tolist()
        [0.75, 0.10000000149011612]
    """

    success: SubgoalSuccess
    needs_subgoals = True

    def __init__(
        self,
        start: float = 1.0,
        end: float = 0.1,
        *,
        anneal_frames: int = 10**9,
        ladder: float = 0.0,
        exponent: float = 2.0,
        max_repeats: int = 1,
        window: int = 100,
    ) -> None:
        super().__init__(
            start, end, anneal_frames=anneal_frames, ladder=ladder, exponent=exponent, max_repeats=max_repeats
        )
        check_size("window", window, 100)
        self.window = window

    def set_num_subgoals(self, num_subgoals: int, *, names: OptionKeys, upper_names: OptionKeys | None = None) -> None:
        """Must be called before it chooses; the policies that explore with it do."""
        self.success = SubgoalSuccess(num_subgoals, window=self.window, names=names, upper_names=upper_names)

    def observe(self, batch: TensorDictBase) -> None:
        """Learns from a collected batch how often subgoals were reached."""
        self.success.observe(batch)

    def scheduled(self, like: Tensor, condition: Tensor | None) -> Tensor:
        epsilon = super().scheduled(like, condition)
        if condition is None:
            return epsilon
        return (epsilon * (1.0 - self.success.rates[condition])).clamp(min=self.end)
