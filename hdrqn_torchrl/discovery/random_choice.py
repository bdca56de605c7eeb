"""Subgoals at random: controls, which show what it is worth that subgoals are good for something."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from hdrqn_torchrl.discovery.history import Occurrences, slots_attained_once
from hdrqn_torchrl.discovery.layout import Layout
from hdrqn_torchrl.discovery.record import EventRecord
from hdrqn_torchrl.discovery.selection import Chosen
from hdrqn_torchrl.modules.sizes import check_size


class RandomSelection:
    """Gives slots to events at random, and takes none away. (A :class:`~hdrqn_torchrl.discovery.Selection`.)

    All that were seen often enough are as likely, whatever they are good for. The draws are torch's, so that the seed
    of a training decides. Once all slots are taken nothing changes any more.

    Args:
        num_tokens: K, of a step.
        number: of slots.
        least: number of times that an event has to be seen.

    Raises:
        ValueError: if a number breaks its rule.

    Examples:
        >>> from tensordict import TensorDict
        >>> selection = RandomSelection(num_tokens=5, number=2)
        >>> events, no = torch.zeros(1, 8, 5).long(), torch.zeros(1, 8, 1)
        >>> events[:, ::2, 0] = 116
        >>> after = {"events": events, "extrinsic_reward": no, "done": no.bool()}
        >>> selection.observe(TensorDict({"action": torch.zeros(1, 8).long(), "next": after}, [1, 8]))
        >>> selection.update()
        Chosen(slots={116: 1}, once=[])
    """

    def __init__(self, num_tokens: int, *, number: int = 8, least: int = 3) -> None:
        check_size("number", number, 8)
        check_size("least", least, 3)
        self.number, self.least = number, least
        self.slots: dict[int, int] = {}
        """Slot by token."""
        self._once: list[int] = []
        self._record = EventRecord(num_tokens)

    def observe(self, batch: TensorDictBase) -> None:
        """Takes in collected steps ``[N, T]`` with their events."""
        if len(self.slots) < self.number:
            self._record.add(batch)

    def update(self) -> Chosen:
        """Draws for the slots that are free."""
        if len(self.slots) < self.number:
            self._draw()
        return Chosen(slots=dict(self.slots), once=list(self._once))

    def _draw(self) -> None:
        history = self._record.history()
        tokens, counts = history.tokens[history.tokens > 0].unique(return_counts=True)
        free = sorted(set(range(1, self.number + 1)) - set(self.slots.values()))
        others = [token for token in tokens[counts >= self.least].tolist() if token not in self.slots]
        for place, slot in zip(torch.randperm(len(others)).tolist(), free, strict=False):
            self.slots[others[place]] = slot
        own = Occurrences(history, list(self.slots))
        self._once = slots_attained_once(self.slots, own, before=self._once)

    def take_over(self, chosen: Chosen) -> None:
        """Begins with subgoals that an agent has already; they keep their slots."""
        self.slots, self._once = dict(chosen.slots), list(chosen.once)

    def state_dict(self) -> dict[str, Any]:
        """All that a resumed training needs."""
        return {**self._record.state_dict(), "slots": dict(self.slots), "once": list(self._once)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        self._record.load_state_dict(state)
        self.slots, self._once = dict(state["slots"]), list(state["once"])


class RandomChanges(nn.Module):
    """Tells a few changes of what is seen, drawn at random. (A detector.)

    It has no copy model: that a wall comes into view is a change as any other. In ``warmup_frames`` it counts how
    often each plane of each place goes from one code to another, then draws among the changes seen in at least one of
    1,000 steps, and tells no others.

    Args:
        num_codes: number of codes of each entry, in the order of the flattened entries.
        number: of changes that are drawn.
        num_dims: number of dimensions of an observation.
        warmup_frames: steps that it counts.

    Raises:
        ValueError: if a number breaks its rule, or there are no cells of codes.

    Examples:
        >>> detector = RandomChanges((5,) * 9, number=2, num_dims=2, warmup_frames=2)
        >>> before, after = torch.zeros(2, 3, 3), torch.zeros(2, 3, 3)
        >>> after[0, 1, 1] = 3
        >>> detector.observe(before, torch.tensor([0, 1]), after)
        >>> [detector.name(token) for token in detector(before, torch.tensor([0, 1]), after)[0].tolist() if token]
        ['(1, 1): 0 -> 3']
    """

    frames: Tensor
    """Number of steps seen so far."""
    counts: Tensor
    """How often each token was seen, by its number."""
    drawn: Tensor
    """``[number]``: the tokens that it tells; 0: none."""
    is_ready: Tensor
    _sizes: Tensor
    _first_tokens: Tensor

    def __init__(
        self, num_codes: Sequence[int], *, number: int = 8, num_dims: int = 1, warmup_frames: int = 10_000
    ) -> None:
        super().__init__()
        for name, value, usual in (("number", number, 8), ("warmup_frames", warmup_frames, 10_000)):
            check_size(name, value, usual)
        self.num_tokens, self.num_dims, self.warmup_frames = number, num_dims, warmup_frames
        self.layout = Layout.of(num_codes)
        if not self.layout.places:
            raise ValueError("num_codes must be those of cells of codes, got others; their changes can't be counted.")
        for name, size in {"frames": (), "counts": (self.layout.reward_token,), "drawn": (number,)}.items():
            self.register_buffer(name, torch.zeros(size, dtype=torch.int64))
        self.register_buffer("is_ready", torch.zeros((), dtype=torch.bool))
        self.register_buffer("_sizes", torch.tensor(self.layout.planes, dtype=torch.int64), persistent=False)
        self.register_buffer("_first_tokens", self.layout.first_tokens(), persistent=False)

    @property
    def ready(self) -> bool:
        """Whether it has drawn."""
        return bool(self.is_ready)

    def observe(self, before: Tensor, action: Tensor, after: Tensor) -> None:
        """Counts the changes of steps ``[*, ...]``, until it has drawn."""
        if self.ready:
            return
        self.frames += action.numel()
        self.counts += torch.bincount(self._changes(before, after).flatten(), minlength=len(self.counts))
        self.counts[0] = 0
        if self.frames >= self.warmup_frames:
            often = (self.counts * 1_000 >= self.frames).nonzero().flatten()
            drawn = often[torch.randperm(len(often)).to(often.device)][: self.num_tokens]
            self.drawn[: len(drawn)] = drawn
            self.is_ready.fill_(True)

    def forward(self, before: Tensor, action: Tensor, after: Tensor, reward: Tensor | None = None) -> Tensor:
        """Tokens of the drawn changes that a step has, ``[*, K]`` int64; 0: none. Rewards are not told."""
        changed = self._changes(before, after).unsqueeze(-1) == self.drawn  # [*, P * planes, K]
        return torch.where(changed.any(-2), self.drawn, 0)

    def name(self, token: int) -> str:
        """A change in words."""
        return self.layout.name(token)

    def _changes(self, before: Tensor, after: Tensor) -> Tensor:
        """The token of each place and plane that has changed, ``[*, P * planes]``; 0: it has not."""
        old, new = (self.layout.cells(each, self.num_dims) for each in (before, after))
        return torch.where(old == new, 0, self._first_tokens + old * self._sizes + new).flatten(-2)
