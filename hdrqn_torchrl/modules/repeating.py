"""Exploration that keeps going: a random action is repeated for some steps."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs.utils import ExplorationType, exploration_type

from hdrqn_torchrl.modules.exploration import EpsilonGreedy, mask_values
from hdrqn_torchrl.modules.sizes import check_size


class RepeatingEpsilonGreedy(EpsilonGreedy):
    r"""Temporally extended epsilon-greedy (Dabney et al., 2021): a random action is kept for some steps.

    Their number n has the probability :math:`P(n) \propto n^{-\mu}`, up to ``max_repeats`` (a zeta distribution, cut).
    A walk of single random steps rarely leaves its corner; this one does. A stretch in progress is carried as its
    action and the number of steps left, ``[2]`` int64. It ends with its option: the next one may be for a subgoal that
    needs no exploring any more.

    Args:
        start, end, anneal_frames, ladder: as in :class:`EpsilonGreedy`; epsilon is the share of random steps, not of
            steps at which a random stretch starts (a little more than that, where options cut stretches short).
        exponent: :math:`\mu`.
        max_repeats: longest stretch, 100,000 at most.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> exploration = RepeatingEpsilonGreedy(1.0, 1.0, max_repeats=1)
        >>> choice, carried = exploration(torch.zeros(3, 4), carried=torch.zeros(3, 2, dtype=torch.int64))
        >>> carried[:, 1].tolist()
        [0, 0, 0]
    """

    _durations: Tensor

    def __init__(
        self,
        start: float = 1.0,
        end: float = 0.1,
        *,
        anneal_frames: int = 100_000,
        ladder: float = 0.0,
        exponent: float = 2.0,
        max_repeats: int = 15,
    ) -> None:
        super().__init__(start, end, anneal_frames=anneal_frames, ladder=ladder)
        if not 0.0 < exponent < float("inf"):
            raise ValueError(f"exponent must be > 0 and finite, got {exponent}; Dabney et al. use 2.")
        check_size("max_repeats", max_repeats, 15, most=100_000)
        durations = torch.arange(1, max_repeats + 1, dtype=torch.float32) ** -exponent
        self.register_buffer("_durations", durations / durations.sum(), persistent=False)
        self.carried_spec = Unbounded(shape=(2,), dtype=torch.int64)
        self.for_actions_only = max_repeats > 1
        self._mean_duration = (torch.arange(1, max_repeats + 1) * self._durations).sum().item()

    def forward(
        self,
        values: Tensor,
        *,
        mask: Tensor | None = None,
        condition: Tensor | None = None,
        starts: Tensor | None = None,
        carried: Tensor | None = None,
    ) -> tuple[Tensor, Tensor | None]:
        """Chooses, given the stretch in progress; arguments as in :meth:`EpsilonGreedy.forward`."""
        if carried is None:
            carried = torch.zeros((*values.shape[:-1], 2), dtype=torch.int64, device=values.device)
        if mask is not None:
            values = mask_values(values, mask)
        greedy = values.argmax(-1)
        if exploration_type() != ExplorationType.RANDOM:
            return greedy, torch.zeros_like(carried)
        if starts is not None:
            carried = carried.masked_fill(starts.unsqueeze(-1), 0)
        action, left = carried.unbind(-1)
        if mask is not None:
            left = left * values.gather(-1, action.unsqueeze(-1)).squeeze(-1).isfinite()
        share = self.epsilons(greedy, condition)
        begins = share / (share + (1.0 - share) * self._mean_duration)  # so that `share` of all steps are random
        begins = (left == 0) & (torch.rand(greedy.shape, device=greedy.device) < begins)
        durations = torch.multinomial(self._durations, greedy.numel(), replacement=True).view_as(greedy) + 1
        action = torch.where(begins, self.random_choice(values, mask), action)
        left = torch.where(begins, durations, left)
        choice = torch.where(left > 0, action, greedy)
        return choice, torch.stack([action, (left - 1).clamp(min=0)], -1)
