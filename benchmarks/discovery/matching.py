"""How well subgoals that an agent found match those of the environment, which only an evaluation reads.

Where a deed can be done again, the environment's ``attained`` has the first time in an episode alone, and so do many
subgoals of an agent. Hence

    recall     share of the steps that attain a true subgoal in which the found one is attained, too;
    precision  share of the steps that attain a found subgoal for the first time in an episode in which the true one is.

Each true subgoal is compared with the found one that has the best F1.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Match:
    """A true subgoal and the found one that matches it best."""

    subgoal: str
    times: int
    """Steps that attained it."""
    slot: int
    event: str
    precision: float
    recall: float


@dataclass(frozen=True, kw_only=True)
class Found:
    """A found subgoal."""

    slot: int
    event: str
    times: int
    """Steps that attained it."""
    first: int
    """Those that did so for the first time in their episode, ..."""
    true: float
    """... and the share of these that attained any true subgoal."""


def first_times(attained: Tensor, done: Tensor) -> Tensor:
    """Where something is attained for the first time in its episode, ``[N, T, G]`` bool.

    Args:
        attained: ``[N, T, G]`` bool.
        done: whether a step ended its episode, ``[N, T]`` bool.
    """
    passed = attained.int().cumsum(1) - attained.int()
    time = torch.arange(done.shape[1]).expand(done.shape)
    begins = torch.where(done.roll(1, 1), time, 0)
    begins[:, 0] = 0
    begin = begins.cummax(1).values.unsqueeze(-1).expand_as(passed)
    return attained & (passed == passed.gather(1, begin))


def matches(
    true: Tensor, found: Tensor, done: Tensor, *, names: Sequence[str], events: Sequence[str]
) -> tuple[list[Match], list[Found]]:
    """Compares all true subgoals with all found ones.

    Args:
        true: what the environment says was attained, ``[N, T, G]`` bool.
        found: what the agent says, ``[N, T, S]`` bool.
        done: ends of episodes, ``[N, T]`` bool.
        names: of the true subgoals.
        events: of the found ones.
    """
    first = first_times(found, done)
    truth, said, fresh = (each.flatten(0, 1).double() for each in (true, found, first))
    recall = truth.T @ said / truth.sum(0).clamp(min=1).unsqueeze(-1)  # [G, S]
    precision = truth.T @ fresh / fresh.sum(0).clamp(min=1)
    f1 = 2 * precision * recall / (precision + recall).clamp(min=1e-9)
    share = (truth.amax(-1) @ fresh / fresh.sum(0).clamp(min=1)).tolist()
    results = []
    for subgoal, (name, slot) in enumerate(zip(names, f1.argmax(-1).tolist(), strict=True)):
        exact, complete = (round(each[subgoal, slot].item(), 3) for each in (precision, recall))
        slot, event = (slot, events[slot]) if exact else (-1, "none")
        times = int(truth[:, subgoal].sum())
        results.append(Match(subgoal=name, times=times, slot=slot, event=event, precision=exact, recall=complete))
    counts = zip(said.sum(0).tolist(), fresh.sum(0).tolist(), share, strict=True)
    return results, [
        Found(slot=slot, event=event, times=int(times), first=int(once), true=round(part, 3))
        for slot, (event, (times, once, part)) in enumerate(zip(events, counts, strict=True))
        if times
    ]


def show(matched: Sequence[Match], found: Sequence[Found], **about: object) -> None:
    """Prints two tables, and all of it as one JSON object in the last line."""
    print(f"{'true subgoal':28}{'times':>7}  {'precision':>9}{'recall':>8}  event")
    for each in matched:
        print(f"{each.subgoal:28}{each.times:>7}  {each.precision:>9.2f}{each.recall:>8.2f}  {each.event}")
    print(f"\n{'slot':>4}{'times':>7}{'first':>7}{'true':>6}  event")
    for each in found:
        print(f"{each.slot:>4}{each.times:>7}{each.first:>7}{each.true:>6.2f}  {each.event}")
    print(
        json.dumps({**about, "matches": [asdict(each) for each in matched], "found": [asdict(each) for each in found]})
    )
