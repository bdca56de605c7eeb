"""What happened when: the events of all steps so far, and what they have to do with each other."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

_NEVER = torch.iinfo(torch.int64).max // 2


class History(NamedTuple):
    """Steps with an event or a reward, ``[L]``, and the episodes that they belong to, ``[E]``.

    Attributes:
        tokens: ``[L, K]`` int64; 0: none.
        episode: number of the episode, below E.
        step: number of the step in its episode.
        acted: whether the action was one that moves nothing, bool.
        reward: in millionths, so that sums don't depend on their order, int64.
        lengths: steps of each episode so far ``[E]``.
    """

    tokens: Tensor
    episode: Tensor
    step: Tensor
    acted: Tensor
    reward: Tensor
    lengths: Tensor


def events_of(history: History, precedence: Tensor, *, least: int, absorbed: float = 0.9) -> list[int]:
    """Tokens that are events of their own, in the order of precedence: those nearest to the agent first.

    A token that comes with events of places that precede its own is theirs: the colour of a key that is picked up, or
    what is seen once a door is open.

    Args:
        history: of all steps.
        precedence: by token; lower ones are nearer to the agent or, of as near ones, more reliable.
        least: number of times that an event has to be seen.
        absorbed: share of a token's steps that have such an event.
    """
    tokens, counts = history.tokens[history.tokens > 0].unique(return_counts=True)
    tokens = tokens[counts >= least]
    explained = torch.zeros(len(history.tokens), dtype=torch.bool)
    events = []
    for token in tokens[precedence[tokens].argsort(stable=True)].tolist():
        rows = (history.tokens == token).any(-1)
        if (rows & explained).sum() < absorbed * rows.sum():
            events.append(token)
            explained |= rows
    return events


class Occurrences:
    """When each of some events happened first in each episode, and what else is to be known of it.

    Args:
        history: of all steps.
        events: tokens, M.
    """

    def __init__(self, history: History, events: list[int]) -> None:
        self.history, self.events = history, events
        episodes = len(history.lengths)
        self.first = torch.full((episodes, len(events)), _NEVER)
        self.counts, self.rewarded, self.acted, self.repeated = (torch.zeros(len(events)).long() for _ in range(4))
        self.reward = torch.zeros(len(events), dtype=torch.int64)
        for index, token in enumerate(events):
            rows = (history.tokens == token).any(-1)
            episode = history.episode[rows]
            self.first[:, index].scatter_reduce_(0, episode, history.step[rows], "amin")
            self.counts[index], self.reward[index] = rows.sum(), history.reward[rows].sum()
            self.rewarded[index] = (history.reward[rows] > 0).sum()
            self.acted[index] = history.acted[rows].sum()
            self.repeated[index] = (torch.bincount(episode, minlength=episodes) > 1).sum()

    @property
    def happened(self) -> Tensor:
        """Number of episodes in which each event happened, ``[M]``."""
        return (self.first < _NEVER).sum(0)

    def evidence(self, event: int, known: list[int]) -> tuple[Tensor, Tensor]:
        r"""Whether other events come before an event more often than chance has it.

        In n episodes the event happened, in m of them another one before. At a random step, the other one has happened
        with probability q. The evidence is the logarithm of the likelihood ratio, :math:`n \, KL(m / n \| q)`, if
        m / n > q, else 0. Only steps after all of the ``known`` ones count.

        Args:
            event: index of the event.
            known: indices of events of which it is known that they come before.

        Returns:
            The evidence of each event ``[M]``, and m / n.
        """
        after = self.first[:, known].amax(-1) if known else torch.full((len(self.first),), -1)
        begins = after.unsqueeze(-1)
        then = self.first[:, event]
        counted = (then < _NEVER) & (after < then)
        total = (self.history.lengths - 1 - after).clamp(min=0).sum()
        past = (self.history.lengths.unsqueeze(-1) - 1 - torch.maximum(begins, self.first)).clamp(min=0).sum(0)
        chance = (past + 1).double() / (total + 1)
        times = counted.sum()
        share = (self.first[counted] < then[counted].unsqueeze(-1)).sum(0).double() / times.clamp(min=1)
        return times * _divergence(share, chance) * (share > chance), share


def slots_attained_once(slots: Mapping[int, int], found: Occurrences, *, before: Collection[int] = ()) -> list[int]:
    """Slots of events that come a second time in fewer than 1 in 20 of their episodes, in ascending order.

    Args:
        slots: by token.
        found: events, those with a slot among them.
        before: slots that were such before; they still are if nothing is known of their events (any more).
    """
    seldom, happened = (found.repeated * 20 < found.happened).tolist(), (found.happened > 0).tolist()
    once = {token for token, is_once in zip(found.events, seldom, strict=True) if is_once}
    seen = {token for token, has in zip(found.events, happened, strict=True) if has}
    return sorted(slot for token, slot in slots.items() if token in once or (slot in before and token not in seen))


def _divergence(share: Tensor, chance: Tensor) -> Tensor:
    """Kullback-Leibler divergence of two coins."""
    return torch.special.xlogy(share, share / chance) + torch.special.xlogy(
        1 - share, (1 - share) / (1 - chance).clamp(min=1e-9)
    )
