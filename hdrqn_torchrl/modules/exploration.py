"""Epsilon-greedy choice with a schedule of its own (Algorithm 2)."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from hdrqn_torchrl.modules.sizes import check_size


class EpsilonGreedy(nn.Module):
    """Chooses the best action, or with probability epsilon a uniformly random one.

    Epsilon falls linearly with the frames seen. It is a buffer, so it travels with the policy's weights to
    worker processes and into checkpoints. Under ``ExplorationType.RANDOM`` (the collectors' default) it
    explores, under any other type it is greedy. TorchRL's ``EGreedyModule`` counts its schedule in a Python
    loop over frames and knows no gated choice, hence this module.

    Args:
        start: epsilon at frame 0.
        end: epsilon from ``anneal_frames`` on.
        anneal_frames: length of the schedule in environment frames.
        ladder: spread of epsilon over the environments, epsilon to the power of 1 to 1 + ladder; 0: all have the same.
            A single environment has the first rung; of several worker processes each has all of them.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> exploration = EpsilonGreedy(1.0, 0.1, anneal_frames=100)
        >>> exploration.step(50)
        >>> round(exploration.epsilon.item(), 3)
        0.55
        >>> exploration(torch.tensor([[0.0, 2.0, 1.0]]))
        tensor([1])
    """

    frames: Tensor
    epsilon: Tensor

    def __init__(
        self, start: float = 1.0, end: float = 0.1, *, anneal_frames: int = 100_000, ladder: float = 0.0
    ) -> None:
        super().__init__()
        for name, value in (("start", start), ("end", end)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must be an epsilon in [0, 1], got {value}; the paper goes from 1.0 to 0.1.")
        check_size("anneal_frames", anneal_frames, "start == end for a constant")
        if not 0.0 <= ladder < float("inf"):
            raise ValueError(
                f"ladder must be >= 0 and finite, got {ladder}; 0 gives all environments the same epsilon."
            )
        self.start, self.end, self.anneal_frames, self.ladder = start, end, anneal_frames, ladder
        self.register_buffer("frames", torch.zeros((), dtype=torch.int64))
        self.register_buffer("epsilon", torch.tensor(float(start)))
        self.held = False
        """Whether the schedule stands still."""
        self.fixed: float | None = None
        """One epsilon for all environments and subgoals in place of all others; for evaluations."""

    def step(self, frames: int) -> None:
        """Advances the schedule by ``frames`` environment frames, unless it is held."""
        if self.held:
            return
        self.frames += frames
        progress = (self.frames / self.anneal_frames).clamp(max=1.0)
        self.epsilon.copy_(self.start + (self.end - self.start) * progress)

    def set_num_subgoals(self, num_subgoals: int) -> None:
        """Tells how many subgoals the task has; here they make no difference."""

    def observe(self, batch: TensorDictBase) -> None:
        """Takes note of a collected batch ``[N, T]``; here there is nothing to note."""

    def forward(self, action_value: Tensor, mask: Tensor | None = None, subgoal: Tensor | None = None) -> Tensor:
        """Chooses among ``action_value`` ``[*, A]`` where ``mask`` ``[*, A]`` allows (anywhere if it allows nothing).

        Args:
            action_value: Q-values.
            mask: what may be chosen.
            subgoal: the subgoal ``[*]`` that an action is chosen for.

        Returns:
            The choice ``[*]`` int64.
        """
        if mask is not None:
            action_value = mask_values(action_value, mask)
        greedy = action_value.argmax(-1)
        if exploration_type() != ExplorationType.RANDOM:
            return greedy
        random = _random_choice(action_value, mask)
        explores = torch.rand(greedy.shape, device=greedy.device) < self.epsilons(greedy, subgoal)
        return torch.where(explores, random, greedy)

    def epsilons(self, like: Tensor, subgoal: Tensor | None = None) -> Tensor:
        """Epsilon of each environment, to be broadcast against choices ``[N, *]``.

        Args:
            like: choices.
            subgoal: the subgoal ``[N]`` that each environment pursues.
        """
        return self._varied(like, subgoal) if self.fixed is None else torch.full_like(self.epsilon, self.fixed)

    def _varied(self, like: Tensor, subgoal: Tensor | None) -> Tensor:
        """As the schedule says; here the same for all subgoals.

        With a ladder, environment i has :math:`\\epsilon^{1 + \\alpha i / (N - 1)}` (Ape-X, Horgan et al., 2018).
        """
        if not self.ladder or not like.ndim:
            return self.epsilon
        rung = torch.linspace(0.0, 1.0, len(like), device=like.device).view(-1, *[1] * (like.ndim - 1))
        return self.epsilon ** (1.0 + self.ladder * rung)


class RepeatingEpsilonGreedy(EpsilonGreedy):
    r"""Temporally extended epsilon-greedy (Dabney et al., 2021): a random action is kept for some steps.

    Their number n has the probability :math:`P(n) \propto n^{-\mu}`, up to ``max_repeats`` (a zeta distribution, cut).
    A walk of single random steps rarely leaves its corner; this one does. The policy carries what is in progress. A
    stretch ends with its option: the next one may be for a subgoal that needs no exploring any more.

    Args:
        start, end, anneal_frames, ladder: as in :class:`EpsilonGreedy`; epsilon is the share of random steps, not of
            steps at which a random stretch starts (a little more than that, where options cut stretches short).
        exponent: :math:`\mu`.
        max_repeats: longest stretch.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> exploration = RepeatingEpsilonGreedy(1.0, 1.0, max_repeats=1)
        >>> choice, carried = exploration.extend(torch.zeros(3, 4), torch.zeros(3, 2, dtype=torch.int64))
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
        check_size("max_repeats", max_repeats, 15)
        durations = torch.arange(1, max_repeats + 1, dtype=torch.float32) ** -exponent
        self.register_buffer("_durations", durations / durations.sum(), persistent=False)
        self._mean_duration = (torch.arange(1, max_repeats + 1) * self._durations).sum().item()

    def extend(
        self, action_value: Tensor, carried: Tensor, subgoal: Tensor | None = None, starts: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Chooses, given the stretch in progress.

        Args:
            action_value: Q-values ``[*, A]``.
            carried: random action in progress and the steps that it still lasts, ``[*, 2]`` int64.
            subgoal: the subgoal ``[*]`` that an action is chosen for.
            starts: where an option starts, ``[*]`` bool: a stretch in progress is over.

        Returns:
            The choice ``[*]`` int64, and what to carry to the next step.
        """
        greedy = action_value.argmax(-1)
        if exploration_type() != ExplorationType.RANDOM:
            return greedy, torch.zeros_like(carried)
        if starts is not None:
            carried = carried.masked_fill(starts.unsqueeze(-1), 0)
        action, left = carried.unbind(-1)
        share = self.epsilons(greedy, subgoal)
        begins = share / (share + (1.0 - share) * self._mean_duration)  # so that `share` of all steps are random
        begins = (left == 0) & (torch.rand(greedy.shape, device=greedy.device) < begins)
        durations = torch.multinomial(self._durations, greedy.numel(), replacement=True).view_as(greedy) + 1
        action = torch.where(begins, _random_choice(action_value, None), action)
        left = torch.where(begins, durations, left)
        choice = torch.where(left > 0, action, greedy)
        return choice, torch.stack([action, (left - 1).clamp(min=0)], -1)


def choose_action(
    exploration: EpsilonGreedy,
    action_value: Tensor,
    tensordict: TensorDictBase,
    repeated_action_key: NestedKey,
    subgoal: Tensor | None = None,
    starts: Tensor | None = None,
) -> Tensor:
    """The choice of a policy in ``tensordict``, which carries the random stretch in progress, if there can be one.

    Args:
        exploration: how to choose.
        action_value: Q-values ``[*, A]``.
        tensordict: a :class:`RepeatingEpsilonGreedy` reads ``repeated_action_key`` and writes it under ``"next"``.
        repeated_action_key: ``[*, 2]`` int64.
        subgoal: the subgoal ``[*]`` that the action is chosen for.
        starts: where an option starts, ``[*]`` bool.

    Returns:
        ``[*]`` int64.
    """
    if not isinstance(exploration, RepeatingEpsilonGreedy):
        return exploration(action_value, subgoal=subgoal)
    action, carried = exploration.extend(action_value, tensordict.get(repeated_action_key), subgoal, starts)
    tensordict.set(unravel_key(("next", repeated_action_key)), carried)
    return action


def exploration_or_greedy(exploration: EpsilonGreedy | None, name: str) -> EpsilonGreedy:
    """What an argument called ``name`` means: ``None`` is always greedy.

    Raises:
        ValueError: if it is something else.
    """
    if exploration is None:
        return EpsilonGreedy(0.0, 0.0)
    if not isinstance(exploration, EpsilonGreedy):
        raise ValueError(f"{name} must be an EpsilonGreedy or None, got {exploration!r}; None is always greedy.")
    return exploration


def check_two_schedules(sub: EpsilonGreedy, meta: EpsilonGreedy) -> None:
    """Refuses one exploration for two levels.

    Raises:
        ValueError: if they are the same.
    """
    if sub is meta:
        raise ValueError(
            f"meta_exploration must not be the sub level's, got one {type(meta).__name__} for both: its schedule would "
            "run twice as fast; give each level its own."
        )


def check_chooses_subgoals(exploration: EpsilonGreedy, name: str) -> None:
    """Refuses what is made for actions where subgoals are chosen.

    Raises:
        ValueError: if ``exploration``, the argument ``name``, repeats its choices.
    """
    if isinstance(exploration, RepeatingEpsilonGreedy):
        raise ValueError(
            f"{name} must be an EpsilonGreedy where subgoals are chosen, got {type(exploration).__name__}: a choice "
            "lasts for an option there, and is not made on the way to another subgoal; use EpsilonGreedy."
        )


def _random_choice(action_value: Tensor, mask: Tensor | None) -> Tensor:
    """A uniformly random one of the allowed actions, ``[*]``."""
    lottery = torch.rand_like(action_value)
    return (lottery if mask is None else mask_values(lottery, mask)).argmax(-1)


def mask_values(values: Tensor, mask: Tensor) -> Tensor:
    """Sets the values ``[*, A]`` that ``mask`` forbids to minus infinity; a row that allows nothing stays as it is."""
    return values.masked_fill(~mask & mask.any(-1, keepdim=True), -torch.inf)
