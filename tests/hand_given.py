"""A detector and a selection that are told what counts, for tests of all that is built on them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hdrqn_torchrl.discovery import Chosen, DiscoverySettings, EventCritic, SubgoalTable

FIRST_GOAL = 3  # cell code of the grid
MOVES = torch.tensor([(-1, 0), (1, 0), (0, -1), (0, 1)])


class GoalsUnderTheAgent(nn.Module):
    """Token 1 + k: the agent stepped on goal k, as two views around it show."""

    num_tokens = 2
    frames: Tensor

    def __init__(self, warmup_frames: int = 0) -> None:
        super().__init__()
        self.warmup_frames = warmup_frames
        self.register_buffer("frames", torch.zeros((), dtype=torch.int64))

    @property
    def ready(self) -> bool:
        return int(self.frames) >= self.warmup_frames

    def observe(self, before: Tensor, action: Tensor, after: Tensor) -> None:
        self.frames += action.numel()

    def forward(self, before: Tensor, action: Tensor, after: Tensor, reward: Tensor) -> Tensor:
        tokens = torch.zeros((*action.shape, self.num_tokens), dtype=torch.int64)
        if self.ready:
            row, column = (MOVES[action] + before.shape[-1] // 2).unbind(-1)
            entered = before.flatten(-2).gather(-1, (row * before.shape[-1] + column).unsqueeze(-1)).squeeze(-1)
            tokens[..., 0] = torch.where(entered >= FIRST_GOAL, entered.long() - FIRST_GOAL + 1, 0)
        return tokens

    def name(self, token: int) -> str:
        return f"goal {token} is gone"


class ByHand:
    """Chooses at each discovery point what it is told; after the last one, the same again."""

    def __init__(self, *chosen: Chosen) -> None:
        self.chosen, self.asked, self.steps = chosen, 0, 0
        self.taken_over: Chosen | None = None

    def observe(self, batch) -> None:
        self.steps += batch.numel()

    def update(self) -> Chosen:
        self.asked += 1
        return self.chosen[min(self.asked, len(self.chosen)) - 1]

    def take_over(self, chosen: Chosen) -> None:
        self.taken_over = chosen

    def state_dict(self):
        return {"asked": self.asked, "steps": self.steps}

    def load_state_dict(self, state):
        self.asked, self.steps = state["asked"], state["steps"]


BOTH_GOALS = Chosen({1: 1, 2: 2}, once=(1, 2))


@dataclass(frozen=True, kw_only=True)
class HandGiven(DiscoverySettings):
    """Settings with a critic by hand."""

    chosen: tuple[Chosen, ...] = (BOTH_GOALS,)

    def make(self, observation, num_actions):
        table = SubgoalTable(self.max_subgoals)
        return EventCritic(GoalsUnderTheAgent(self.warmup_frames), table), ByHand(*self.chosen)
