"""Exploration: one interface, and epsilon-greedy choice with a schedule of its own (Algorithm 2)."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import expand_as_right, unravel_key
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType, exploration_type

from hdrqn_torchrl.keys import OptionKeys
from hdrqn_torchrl.modules.sizes import check_number, check_size


class EpsilonGreedy(nn.Module):
    """Chooses the best action, or with probability epsilon a uniformly random one.

    Epsilon falls linearly with the frames seen. It is a buffer, so it travels with the policy's weights to
    worker processes and into checkpoints. Under ``ExplorationType.RANDOM`` (the collectors' default) it
    explores, under any other type it is greedy. TorchRL's ``EGreedyModule`` counts its schedule in a Python
    loop over frames and knows no gated choice, hence this module.

    It is also the interface of every exploration: a subclass may change how random choices are drawn
    (:meth:`random_choice`), how often (:meth:`scheduled`) or everything (:meth:`forward`), and may carry something
    from step to step (:attr:`carried_spec`). Policies, builders and the trainer treat all alike.

    Args:
        start: epsilon at frame 0.
        end: epsilon from ``anneal_frames`` on.
        anneal_frames: length of the schedule in environment frames.
        ladder: spread of epsilon over the environments, epsilon to the power of 1 to 1 + ladder; 0: all have the same.
            A single environment has the first rung.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> exploration = EpsilonGreedy(1.0, 0.1, anneal_frames=100)
        >>> exploration.step(50)
        >>> round(exploration.epsilon.item(), 3)
        0.55
        >>> exploration(torch.tensor([[0.0, 2.0, 1.0]]))
        (tensor([1]), None)

        A custom exploration: random choices prefer higher values.

        >>> class SoftmaxEpsilonGreedy(EpsilonGreedy):
        ...     def random_choice(self, values, mask):
        ...         return torch.distributions.Categorical(logits=values).sample()
        >>> from torchrl.envs import set_exploration_type
        >>> with set_exploration_type(ExplorationType.RANDOM):
        ...     choice, _ = SoftmaxEpsilonGreedy()(torch.tensor([[0.0, 100.0, 0.0]]))
        >>> choice
        tensor([1])
    """

    carried_spec: TensorSpec | None = None
    """What is carried from step to step in each environment, from zeros at a reset; ``None``: nothing."""
    for_actions_only: bool = False
    """Whether it makes no sense where subgoals are chosen."""
    needs_subgoals: bool = False
    """Whether it depends on the subgoal that is pursued."""

    frames: Tensor
    epsilon: Tensor

    def __init__(
        self, start: float = 1.0, end: float = 0.1, *, anneal_frames: int = 100_000, ladder: float = 0.0
    ) -> None:
        super().__init__()
        for name, value, usual in (("start", start, 1.0), ("end", end, 0.1), ("ladder", ladder, 0.0)):
            check_number(name, value, usual)
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
        self.rungs: tuple[int, int] | None = None
        """The ladder's rung of the first environment, and their number, where these are only some of all; ``None``:
        they are all."""

    def step(self, frames: int) -> None:
        """Advances the schedule by ``frames`` environment frames, unless it is held."""
        if self.held:
            return
        self.frames += frames
        progress = (self.frames / self.anneal_frames).clamp(max=1.0)
        self.epsilon.copy_(self.start + (self.end - self.start) * progress)

    def set_num_subgoals(self, num_subgoals: int, *, names: OptionKeys, upper_names: OptionKeys | None = None) -> None:
        """Tells among how many subgoals the pursued one is; here they make no difference.

        Args:
            num_subgoals: G.
            names: of the entries that hold their outcome.
            upper_names: of those of the level above, whose options end these; ``None``: there is none.
        """

    def observe(self, batch: TensorDictBase) -> None:
        """Takes note of a collected batch ``[N, T]``; here there is nothing to note."""

    def forward(
        self,
        values: Tensor,
        *,
        mask: Tensor | None = None,
        condition: Tensor | None = None,
        starts: Tensor | None = None,
        carried: Tensor | None = None,
    ) -> tuple[Tensor, Tensor | None]:
        """Chooses among ``values`` where ``mask`` allows (anywhere if it allows nothing).

        Args:
            values: Q-values ``[*, A]``.
            mask: what may be chosen, ``[*, A]`` bool; ``None``: everything.
            condition: the subgoal ``[*]`` that is pursued; ``None``: there is none.
            starts: where that has just been chosen, ``[*]`` bool.
            carried: what the last call returned, of :attr:`carried_spec`.

        Returns:
            The choice ``[*]`` int64, and what to carry to the next step.
        """
        if mask is not None:
            values = mask_values(values, mask)
        greedy = values.argmax(-1)
        if exploration_type() != ExplorationType.RANDOM:
            return greedy, None
        random = self.random_choice(values, mask)
        explores = torch.rand(greedy.shape, device=greedy.device) < self.epsilons(greedy, condition)
        return torch.where(explores, random, greedy), None

    def random_choice(self, values: Tensor, mask: Tensor | None) -> Tensor:
        """A uniformly random one of the choices that ``mask`` ``[*, A]`` allows, ``[*]``.

        Args:
            values: Q-values ``[*, A]``, minus infinity where ``mask`` forbids.
            mask: as in :meth:`forward`.
        """
        lottery = torch.rand_like(values)
        return (lottery if mask is None else mask_values(lottery, mask)).argmax(-1)

    def epsilons(self, like: Tensor, condition: Tensor | None = None) -> Tensor:
        """Epsilon of each environment, to be broadcast against choices ``[N, *]``.

        Args:
            like: choices.
            condition: the subgoal ``[N]`` that each environment pursues.
        """
        return self.scheduled(like, condition) if self.fixed is None else torch.full_like(self.epsilon, self.fixed)

    def scheduled(self, like: Tensor, condition: Tensor | None) -> Tensor:
        """Epsilon of each environment as the schedule has it; here the same for all subgoals.

        With a ladder, environment i has :math:`\\epsilon^{1 + \\alpha i / (N - 1)}` (Ape-X, Horgan et al., 2018).
        """
        if not self.ladder or not like.ndim:
            return self.epsilon
        first, number = self.rungs or (0, len(like))
        rung = torch.linspace(0.0, 1.0, number, device=like.device)[first : first + len(like)]
        return self.epsilon ** (1.0 + self.ladder * rung.view(-1, *[1] * (like.ndim - 1)))


def choose(
    exploration: EpsilonGreedy,
    values: Tensor,
    tensordict: TensorDictBase,
    carried_key: NestedKey,
    *,
    mask: Tensor | None = None,
    condition: Tensor | None = None,
    starts: Tensor | None = None,
    due: Tensor | None = None,
) -> Tensor:
    """One level's choice in a policy, whatever its exploration carries.

    Args:
        exploration: how to choose.
        values: Q-values ``[*, A]``.
        tensordict: what the exploration carries is read from it, and written below ``"next"``.
        carried_key: under this name; neither read nor written if the exploration carries nothing.
        mask, condition, starts: as in :class:`EpsilonGreedy`.
        due: where a choice is due, ``[*]`` bool; elsewhere what is carried stays. ``None``: everywhere.

    Returns:
        ``[*]`` int64.
    """
    carried = None if exploration.carried_spec is None else tensordict.get(carried_key)
    returned = exploration(values, mask=mask, condition=condition, starts=starts, carried=carried)
    choice, following = _checked(exploration, returned, values.shape[:-1], carried)
    if carried is not None:
        if due is not None:
            following = torch.where(expand_as_right(due, carried), following, carried)
        tensordict.set(unravel_key(("next", carried_key)), following)
    return choice


def _checked(
    exploration: EpsilonGreedy, returned: object, shape: torch.Size, carried: Tensor | None
) -> tuple[Tensor, Tensor]:
    """What a call returned, after a look at shapes and dtypes: the exploration may be someone's own."""
    whose = f"{type(exploration).__name__}.forward must return"
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise ValueError(f"{whose} a choice and what to carry, got {type(returned).__name__}; return (choice, None).")
    _check_tensor(f"{whose} a choice", returned[0], shape, torch.int64, "an index below the number of values")
    if carried is not None:
        _check_tensor(f"{whose} what to carry", returned[1], carried.shape, carried.dtype, "as carried_spec has it")
    return returned


def _check_tensor(what: str, value: object, shape: torch.Size, dtype: torch.dtype, remedy: str) -> None:
    if isinstance(value, Tensor) and value.shape == shape and value.dtype == dtype:
        return
    got = f"{list(value.shape)} {value.dtype}" if isinstance(value, Tensor) else repr(value)
    raise ValueError(f"{what}, {list(shape)} {dtype}, got {got}; {remedy}.")


def carried_by(exploration: EpsilonGreedy, key: NestedKey) -> dict[NestedKey, TensorSpec]:
    """The entry that ``exploration`` carries under ``key``, for a primer; empty if it carries nothing.

    Examples:
        >>> carried_by(EpsilonGreedy(), "carried")
        {}
    """
    return {} if exploration.carried_spec is None else {key: exploration.carried_spec.clone()}


def mask_values(values: Tensor, mask: Tensor) -> Tensor:
    """Sets the values ``[*, A]`` that ``mask`` forbids to minus infinity; a row that allows nothing stays as it is."""
    return values.masked_fill(~mask & mask.any(-1, keepdim=True), -torch.inf)
