"""Which subgoal each event is, in tensors of fixed size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from hdrqn_torchrl.modules.sizes import check_size

EXPLORE = 0
"""The subgoal that no step attains: it is pursued where no other is left."""
_NONE = torch.iinfo(torch.int64).max  # no token


class SubgoalTable(nn.Module):
    """Tokens of events and the subgoals that they attain.

    Subgoal 0 is "explore", which nothing attains; the others are slots, which keep their number as long as they mean
    the same event. All of it are buffers, which travel with the weights of the policy.

    Args:
        max_subgoals: number of slots; there are as many subgoals and one.
        max_tokens: number of tokens that can have a slot.

    Examples:
        >>> table = SubgoalTable(2)
        >>> kept = table.assign({7: 1, 9: 1}, once=[1])
        >>> table.attained(torch.tensor([[0, 9], [3, 0]])).tolist()
        [[False, True, False], [False, False, False]]
    """

    tokens: Tensor
    """``[M]`` int64, ascending; the largest number there is where there is none."""
    slots: Tensor
    """``[M]`` int64: the subgoal that each attains; 0: none."""
    once: Tensor
    """``[G]`` bool: subgoals that an episode attains only once."""
    found: Tensor
    """``[G]`` int64: frames after which each got its event."""

    def __init__(self, max_subgoals: int, *, max_tokens: int = 256) -> None:
        super().__init__()
        check_size("max_subgoals", max_subgoals, 8)
        self.register_buffer("tokens", torch.full((max_tokens,), _NONE))
        self.register_buffer("slots", torch.zeros(max_tokens, dtype=torch.int64))
        self.register_buffer("once", torch.zeros(max_subgoals + 1, dtype=torch.bool))
        self.register_buffer("found", torch.zeros(max_subgoals + 1, dtype=torch.int64))

    @property
    def num_subgoals(self) -> int:
        """G, "explore" included."""
        return len(self.once)

    @property
    def in_use(self) -> Tensor:
        """Slots with an event, ``[G]`` bool."""
        in_use = torch.zeros_like(self.once).index_fill(0, self.slots, True)
        return in_use & (torch.arange(self.num_subgoals, device=in_use.device) != EXPLORE)

    def tokens_of(self, subgoal: int) -> list[int]:
        """Tokens of the events that attain a subgoal, in ascending order."""
        return [] if subgoal == EXPLORE else self.tokens[self.slots == subgoal].tolist()

    def assign(self, slots: Mapping[int, int], *, once: Sequence[int] = (), frames: int = 0) -> Tensor:
        """Gives all events their slots.

        Args:
            slots: subgoal by token; tokens without one attain nothing.
            once: subgoals that an episode attains only once.
            frames: of the training so far.

        Returns:
            Which subgoals still mean an event that they meant before, ``[G]`` bool.

        Raises:
            ValueError: if there are too many tokens, or no such subgoals.
        """
        if len(slots) > len(self.tokens):
            raise ValueError(f"slots must be of at most {len(self.tokens)} tokens, got {len(slots)}; leave some out.")
        if wrong := [slot for slot in (*slots.values(), *once) if not EXPLORE < slot < self.num_subgoals]:
            raise ValueError(f"slots must lie in [1, {self.num_subgoals}), got {wrong[0]}; raise max_subgoals.")
        before = [set(self.tokens_of(subgoal)) for subgoal in range(self.num_subgoals)]
        tokens = sorted(slots)
        self.tokens.fill_(_NONE)
        self.slots.fill_(EXPLORE)
        self.once.fill_(False)
        self.tokens[: len(tokens)] = torch.tensor(tokens, dtype=torch.int64)
        self.slots[: len(tokens)] = torch.tensor([slots[token] for token in tokens], dtype=torch.int64)
        self.once[list(once)] = True
        same = [not old.isdisjoint(self.tokens_of(subgoal)) for subgoal, old in enumerate(before)]
        kept = torch.tensor(same, device=self.once.device)
        self.found.copy_(torch.where(kept, self.found, frames).masked_fill(~self.in_use, 0))
        return kept

    def attained(self, tokens: Tensor) -> Tensor:
        """Which subgoal a step attained, ``[*, G]`` bool: that of the first of its tokens that has one, or none.

        Tokens come in the order of how well they can be told, rewards last. So a reward that another subgoal explains
        is not attained besides.

        Args:
            tokens: ``[*, K]``.
        """
        place = torch.searchsorted(self.tokens, tokens).clamp(max=len(self.tokens) - 1)
        slot = torch.where(self.tokens[place] == tokens, self.slots[place], EXPLORE)  # [*, K]
        first = (slot != EXPLORE).long().argmax(-1, keepdim=True)
        subgoals = torch.arange(self.num_subgoals, device=tokens.device)
        return (slot.gather(-1, first) == subgoals) & (subgoals != EXPLORE)

    def available(self, spent: Tensor) -> Tensor:
        """Which subgoals can be chosen, ``[*, G]`` bool; "explore" where there is no other.

        Args:
            spent: subgoals that the episode has attained, ``[*, G]`` bool.
        """
        left = self.in_use & ~(spent & self.once)
        left[..., EXPLORE] = ~left.any(-1)
        return left
