r"""Events: changes of what an agent sees that its movements do not explain.

Observations mostly change because the agent moves. A copy model, learned from the first frames, explains that: after
action :math:`a`, place :math:`j` shows what place :math:`i = s_a(j)` showed before; or nothing moved, :math:`s(j) = j`.
A step is explained by whichever of the two costs less (a blocked move is "nothing moved"),

.. math:: \sum_j w_a(j) \, [o'_j \ne o_{s_a(j)}] \quad\text{or}\quad w \sum_j [o'_j \ne o_j],

and a place that is usually copied well, but not in this step, is an event: "at the centre, goal 2 -> floor".
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.data import TensorSpec

from hdrqn_torchrl.discovery.copying import CopyCounts, fit_copies
from hdrqn_torchrl.discovery.layout import Layout
from hdrqn_torchrl.envs.observations import code_sizes, observation_kind
from hdrqn_torchrl.modules.sizes import check_size

_RELIABLE = 0.8  # share of steps in which a place has to be copied well


class ChangeDetector(nn.Module):
    """Tells the events of steps: tokens for what the copy model does not explain.

    In the first half of ``warmup_frames`` it counts where the content of each place comes from, in the second half how
    often that is right. Then it is ready and stays as it is: a token means the same for ever.

    A token is one plane of one place, its code as copied, and its code as seen. Places near the agent's own come first,
    as what an agent does begins there; of those as near the most reliable.
    The last of the tokens says that the step was rewarded, if rewards are given.

    A place that hardly ever changes (the centre, where goals vanish as the agent steps on them) can't show where it is
    copied from; if the others are all shifted alike, it is taken to be shifted like them. There, codes that are usual
    are no event, whatever replaces them.

    Args:
        num_codes: number of codes of each entry, in the order of the flattened entries; the cells and their planes are
            found in it (:class:`Layout`). None: there are no events but rewards.
        num_actions: A.
        num_dims: number of dimensions of an observation.
        num_tokens: K, the reward's included.
        warmup_frames: steps from which it learns.

    Raises:
        ValueError: if a number breaks its rule.

    Examples:
        >>> detector = ChangeDetector((5,) * 9, num_actions=4, num_dims=2)
        >>> before = after = torch.zeros(2, 3, 3, dtype=torch.uint8)
        >>> detector(before, torch.tensor([0, 1]), after).tolist()
        [[0, 0, 0, 0, 0], [0, 0, 0, 0, 0]]
    """

    frames: Tensor
    """Number of steps seen so far."""
    steps: Tensor
    """``[A + 1]``: steps that each hypothesis explains; the last one: nothing moved."""
    failed: Tensor
    """``[A + 1, P]``: in how many of them a place was not copied well."""
    weight: Tensor
    source: Tensor
    seen: Tensor
    """``[A + 1, P, codes of all planes]``: codes that were copied."""
    usual: Tensor
    """``[A + 1, P, planes]``: the most frequent of these."""
    order: Tensor
    """``[P]``: places, those near the agent's own first, of these the most reliable."""
    moves: Tensor
    """``[A]`` bool: actions that move what is seen."""
    trusted: Tensor
    filled: Tensor
    reliable: Tensor
    is_ready: Tensor
    _sizes: Tensor
    _first_codes: Tensor
    _first_tokens: Tensor

    def __init__(
        self,
        num_codes: Sequence[int],
        num_actions: int,
        *,
        num_dims: int = 1,
        num_tokens: int = 5,
        warmup_frames: int = 10_000,
    ) -> None:
        super().__init__()
        for name, value, usual in (
            ("num_actions", num_actions, 4),
            ("num_tokens", num_tokens, 5),
            ("warmup_frames", warmup_frames, 10_000),
        ):
            check_size(name, value, usual)
        self.num_actions, self.num_dims, self.num_tokens = num_actions, num_dims, num_tokens
        self.warmup_frames, self.layout = warmup_frames, Layout.of(num_codes)
        places, planes, hypotheses = self.layout.places, len(self.layout.planes), num_actions + 1
        self.counts = CopyCounts(num_actions, places)
        whole = {"frames": (), "steps": (hypotheses,), "failed": (hypotheses, places), "weight": (num_actions, places)}
        whole |= {"source": (num_actions, places), "seen": (hypotheses, places, sum(self.layout.planes))}
        whole |= {"usual": (hypotheses, places, planes), "order": (places,)}
        for name, shape in whole.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.int64))
        flags = {"moves": (num_actions,), "trusted": (hypotheses, places), "filled": (hypotheses, places)}
        for name, shape in {**flags, "reliable": (hypotheses, places), "is_ready": ()}.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.bool))
        sizes = torch.tensor(self.layout.planes, dtype=torch.int64)
        self.register_buffer("_sizes", sizes, persistent=False)
        self.register_buffer("_first_codes", sizes.cumsum(0) - sizes, persistent=False)
        self.register_buffer("_first_tokens", self.layout.first_tokens(), persistent=False)

    @property
    def ready(self) -> bool:
        """Whether it has learned enough."""
        return bool(self.is_ready)

    def observe(self, before: Tensor, action: Tensor, after: Tensor) -> None:
        """Learns from steps, until it is ready.

        Args:
            before, after: observations ``[*, ...]``.
            action: ``[*]`` int64.
        """
        if self.ready:
            return
        half = self.warmup_frames // 2
        counting = bool(self.frames < half)
        self.frames += action.numel()
        if self.layout.places:
            old, new = (self._cells(each).flatten(0, -3) for each in (before, after))
            if counting:
                self.counts.add(self._contents(old), action.flatten(), self._contents(new))
            else:
                self._count_failures(old, action.flatten(), new)
        if counting and self.frames >= half:
            self._fit_sources()
        if not counting and self.frames >= self.warmup_frames:
            self._fit_reliability()

    def forward(self, before: Tensor, action: Tensor, after: Tensor, reward: Tensor | None = None) -> Tensor:
        """Tokens of the events of steps, 0 for none.

        Args:
            before, after: observations ``[*, ...]``.
            action: ``[*]`` int64.
            reward: ``[*, 1]``; ``None``: that steps are rewarded is no event.

        Returns:
            ``[*, K]`` int64.
        """
        tokens = torch.zeros((*action.shape, self.num_tokens), dtype=torch.int64, device=action.device)
        if self.layout.places:
            self._put_changes(tokens, self._cells(before), action, self._cells(after))
        if reward is not None:
            tokens[..., -1] = torch.where(reward.squeeze(-1) > 0, self.layout.reward_token, 0)
        return tokens

    def precedence(self) -> Tensor:
        """Rank of each token, by number, in the order of its place and plane, rewards last; ``[tokens + 1]``."""
        plane = torch.arange(len(self.layout.planes)).repeat_interleave(self._sizes.cpu().square())
        rank = self.order.cpu().argsort().unsqueeze(-1) * len(self.layout.planes) + plane  # [P, tokens of a place]
        last = self.layout.places * max(1, self.layout.tokens_of_place)
        return torch.cat([torch.tensor([last]), rank.flatten(), torch.tensor([last])])

    def at_agent(self, token: int) -> bool:
        """Whether a token's place is the agent's own: the one that movements leave as it is while all others shift."""
        return token != self.layout.reward_token and bool(self.filled[:, self.layout.place_of(token)].any())

    def name(self, token: int) -> str:
        """An event in words."""
        return self.layout.name(token)

    def _cells(self, observation: Tensor) -> Tensor:
        """``[*, P, planes]`` int64."""
        return self.layout.cells(observation, self.num_dims)

    def _contents(self, cells: Tensor) -> Tensor:
        """One number for all planes of a cell, ``[*, P]``."""
        contents = cells[..., 0]
        for plane, size in enumerate(self.layout.planes[1:], 1):
            contents = contents * size + cells[..., plane]
        return contents

    def _explain(self, old: Tensor, action: Tensor, new: Tensor) -> tuple[Tensor, Tensor]:
        """The hypothesis that explains each step ``[*]``, and what it says of the cells, ``[*, P, planes]``."""
        moved = old.gather(-2, self.source[action].unsqueeze(-1).expand_as(old))
        costs = ((moved != new).any(-1) * self.weight[action]).sum(-1)
        still = ((old != new).any(-1) * CopyCounts.LARGEST_WEIGHT).sum(-1) < costs
        still = still | ~self.moves[action]
        return torch.where(still, self.num_actions, action), torch.where(still[..., None, None], old, moved)

    def _put_changes(self, tokens: Tensor, old: Tensor, action: Tensor, new: Tensor) -> None:
        """Writes tokens ``[*, K]`` of the places nearest to the agent, of as near ones the most reliable."""
        which, copied = self._explain(old, action, new)
        usual = self.usual[which]
        filled = self.filled[which].unsqueeze(-1)
        odd = (copied != new).any(-1, keepdim=True) & torch.where(filled, copied != usual, copied != new)
        odd = odd & (self.reliable[which] & self.is_ready).unsqueeze(-1)  # [*, P, planes]
        token = self._first_tokens + copied * self._sizes + torch.where(filled, usual, new)
        odd, token = odd[..., self.order, :].flatten(-2), token[..., self.order, :].flatten(-2)
        rank = torch.arange(odd.shape[-1], 0, -1, device=odd.device)
        found = (odd * rank).topk(min(self.num_tokens - 1, odd.shape[-1]), -1)
        tokens[..., : found.indices.shape[-1]] = torch.where(found.values > 0, token.gather(-1, found.indices), 0)

    def _fit_sources(self) -> None:
        fitted = fit_copies(self.counts, width=self.layout.width)
        for name, value in fitted._asdict().items():
            getattr(self, name).copy_(value)

    def _distances(self) -> Tensor:
        """How far each place is from the agent's own, ``[P]``."""
        place = torch.arange(self.layout.places, device=self.filled.device)
        row, column = place // self.layout.width, place % self.layout.width
        own = self.filled.any(0)
        if not own.any():
            return torch.zeros_like(place)
        return ((row[:, None] - row[own]).abs() + (column[:, None] - column[own]).abs()).amin(-1)

    def _count_failures(self, old: Tensor, action: Tensor, new: Tensor) -> None:
        which, copied = self._explain(old, action, new)
        self.steps.index_add_(0, which, torch.ones_like(which))
        self.failed.index_add_(0, which, ((copied != new).any(-1) & ~self.filled[which]).long())
        codes = torch.zeros((len(which), *self.seen.shape[1:]), dtype=torch.int64, device=which.device)
        codes.scatter_(-1, copied + self._first_codes, 1)
        self.seen.index_add_(0, which, codes)

    def _fit_reliability(self) -> None:
        """Which places are copied well under each hypothesis, and in which order they come."""
        share = 1.0 - (self.failed + 1).double() / (self.steps + 2).double().unsqueeze(-1)
        share = torch.where(self.trusted, share, 0.0)
        mean = share[self.steps > 0].mean(0)
        self.reliable.copy_((share >= _RELIABLE) & (mean >= _RELIABLE))
        self.order.copy_((self._distances() - mean).argsort(stable=True))
        for plane, codes in enumerate(self.seen.split(list(self.layout.planes), -1)):
            self.usual[..., plane] = codes.argmax(-1)
        self.is_ready.fill_(True)


def make_change_detector(
    observation: TensorSpec, num_actions: int, *, num_tokens: int = 5, warmup_frames: int = 10_000
) -> ChangeDetector:
    """A detector for observations of a spec.

    Images and vectors of floats have no codes to compare: then the only event is a reward, and a warning says so.

    Args:
        observation: spec of the observation ``[N, ...]``.
        num_actions: A.
        num_tokens, warmup_frames: see :class:`ChangeDetector`.

    Examples:
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> detector = make_change_detector(MultiGoalGridEnv(num_envs=2).observation_spec["observation"], num_actions=4)
        >>> detector.layout, detector.ready
        (Layout(places=25, planes=(5,)), False)
    """
    shape, sizes = observation.shape[1:], sizes_of(observation)
    if not Layout.of(sizes).places:
        warnings.warn(
            f"observations of shape {list(shape)} are no cells of codes, so that changes can't be told from movements; "
            "the only event is a reward.",
            stacklevel=2,
        )
    return ChangeDetector(sizes, num_actions, num_dims=len(shape), num_tokens=num_tokens, warmup_frames=warmup_frames)


def sizes_of(observation: TensorSpec) -> tuple[int, ...]:
    """Number of codes of each entry of an observation ``[N, ...]``; empty if it has none."""
    shape = observation.shape[1:]
    return code_sizes(observation, shape) if observation_kind(observation, shape) in ("cells", "codes") else ()
