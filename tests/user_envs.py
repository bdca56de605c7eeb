"""Environments such as users bring: small, and each one different from this project's own in some way."""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict
from torchrl.data import Binary, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from hdrqn_torchrl.envs import SubgoalSet, Task

CELLS = 5


class Corridor(EnvBase):
    """Five cells in a row, of which the agent sees its own; the two ends are the subgoals, and it starts in the middle.

    Args:
        num_envs: number of corridors; ``None``: one, without a batch dimension.
        num_goals: 2: how many ends there are; it bounds nothing.
        pays: extrinsic reward for coming to an end.
        length: steps of an episode; ``None``: it never ends.
        without: entries that the environment does not write.
        odd: specs that differ, by entry; what is written is drawn from them.
        task: what it says about itself.
        masked: says that steps into the ends' walls can't be chosen, and fails if one is.
        seed: of nothing: train.py gives it to every environment, as it does device.
        device: of all tensors.
    """

    def __init__(
        self,
        num_envs: int | None = 4,
        *,
        num_goals: int = 2,
        pays: float = 1.0,
        length: int | None = 6,
        without: Sequence[str] = ("hazard", "success"),
        odd: dict[str, TensorSpec] | None = None,
        task: Task | None = None,
        masked: bool = False,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        batch = () if num_envs is None else (num_envs,)
        super().__init__(device=device, batch_size=batch)
        self.pays, self.length, self.num_goals = pays, length, num_goals
        self.odd, self.masked = odd or {}, masked
        if task is not None:
            self.task = task
        one = (*batch, 1)
        observations = {
            "observation": Categorical(CELLS, shape=(*batch, 1, 1), dtype=torch.uint8),
            "attained": Binary(shape=(*batch, 2), dtype=torch.bool),
            "hazard": Binary(shape=one, dtype=torch.bool),
            "success": Binary(shape=one, dtype=torch.bool),
        }
        if masked:
            observations["action_mask"] = Binary(shape=(*batch, 2), dtype=torch.bool)
        rewards = {key: Unbounded(shape=one) for key in ("reward", "extrinsic_reward")}
        ends = {key: Binary(shape=one, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.observation_spec = self._composite(observations, without)
        self.full_reward_spec = self._composite(rewards, without)
        self.full_done_spec = self._composite(ends, without)
        self.action_spec = self.odd.get("action", Categorical(2, shape=batch, dtype=torch.int64))
        self._place = torch.full(batch, CELLS // 2)
        self._steps = torch.zeros(batch, dtype=torch.int64)

    def _composite(self, entries: dict[str, TensorSpec], without: Sequence[str]) -> Composite:
        kept = {key: self.odd.get(key, spec) for key, spec in entries.items() if key not in without}
        return Composite(kept, shape=self.batch_size)

    def state_dict(self, *args, **kwargs):
        return {"place": self._place, "steps": self._steps}

    def load_state_dict(self, state_dict, strict=True):
        self._place, self._steps = state_dict["place"], state_dict["steps"]

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""

    def _reset(self, tensordict, **kwargs):
        everyone = torch.ones(self.batch_size, dtype=torch.bool)
        reset = everyone if tensordict is None else tensordict.get("_reset", everyone).view(self.batch_size)
        self._place = torch.where(reset, CELLS // 2, self._place)
        self._steps = torch.where(reset, 0, self._steps)
        return self._written(torch.zeros_like(everyone), self.observation_spec, self.full_done_spec)

    def _step(self, tensordict):
        action = tensordict.get("action")
        move = 2 * action - 1 if action.shape == self.batch_size else torch.ones_like(self._place)
        if self.masked:
            doors = self._doors() | ~self._doors().any(-1, keepdim=True)
            assert doors.gather(-1, action.unsqueeze(-1)).all(), "an action that can't be chosen was chosen"
        before, self._place = self._place, (self._place + move).clamp(0, CELLS - 1)
        self._steps = self._steps + 1
        return self._written(self._place != before, self.observation_spec, self.full_reward_spec, self.full_done_spec)

    def _doors(self):
        """Which ways are open, ``[N, 2]``."""
        return torch.stack([self._place > 0, self._place < CELLS - 1], -1)

    def _written(self, moved, *specs):
        ends = torch.stack([self._place == 0, self._place == CELLS - 1], -1) & moved.unsqueeze(-1)
        over = torch.zeros_like(moved) if self.length is None else self._steps >= self.length
        pay = self.pays * ends.any(-1).float()
        values = {
            "observation": self._place[..., None, None].to(torch.uint8),
            "attained": ends,
            "action_mask": self._doors(),
            "hazard": torch.zeros_like(moved)[..., None],
            "success": ends[..., -1:],
            "reward": pay[..., None],
            "extrinsic_reward": pay[..., None],
            "done": over[..., None],
            "terminated": torch.zeros_like(over)[..., None],
            "truncated": over[..., None],
        }
        wanted = {key: spec for each in specs for key, spec in each.items()}
        outcome = {key: spec.rand() if key in self.odd else values[key] for key, spec in wanted.items()}
        return TensorDict(outcome, self.batch_size)


class Pictured(Corridor):
    """The corridor with a picture of its own, and ends that are known to be attained again and again."""

    def __init__(self, num_envs: int | None = 4, **settings) -> None:
        ends = SubgoalSet(names=("west", "east"), repeatable=True)
        super().__init__(num_envs, task=Task(subgoals=(ends,), actions=("go west", "go east")), **settings)

    def render(self):
        """One red column where the first agent is, ``[4, 10, 3]``."""
        picture = np.full((4, 2 * CELLS, 3), 255, np.uint8)
        place = int(self._place.view(-1)[0])
        picture[:, 2 * place : 2 * place + 2] = (255, 0, 0)
        return picture


class Walk(gymnasium.Env):
    """The corridor for Gymnasium, seen as a vector; what else there is stands in the observation or in ``info``."""

    def __init__(self, *, in_info: bool) -> None:
        self.in_info = in_info
        view, flags = spaces.Box(0, 1, (4,), np.float32), spaces.Box(0, 1, (2,), np.bool_)
        entries = {"observation": view, "attained": flags, "extrinsic_reward": spaces.Box(0, 1, (1,), np.float32)}
        self.observation_space = view if in_info else spaces.Dict(entries)
        self.action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = CELLS // 2, 0
        return self._told([False, False])

    def step(self, action):
        before, self.steps = self.place, self.steps + 1
        self.place = int(np.clip(self.place + 2 * action - 1, 0, CELLS - 1))
        ends = [self.place == 0 != before, self.place == CELLS - 1 != before]
        observation, info = self._told(ends)
        return observation, float(any(ends)), False, self.steps >= 6, info

    def _told(self, ends):
        view = np.array([self.place / CELLS, self.steps / 6, 0, 1], np.float32)
        others = {"attained": np.array(ends), "extrinsic_reward": np.array([any(ends)], np.float32)}
        return (view, others) if self.in_info else ({"observation": view, **others}, {})
