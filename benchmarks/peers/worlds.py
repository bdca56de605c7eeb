"""Our environments as other libraries want them: floats in, whole numbers out, no TensorDict."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, TensorSpec
from torchrl.envs import EnvBase

from hdrqn_torchrl import keys


class OneHot:
    """Codes ``[*, ...]`` as floats ``[*, S]``: for each code as many as there are values of it, one of them 1.

    Args:
        spec: of a batch of codes ``[N, ...]``, as an environment states it: a vector, or cells of one plane.

    Raises:
        ValueError: if these are no codes.
    """

    def __init__(self, spec: TensorSpec) -> None:
        if isinstance(spec, Categorical):
            numbers = torch.full((spec.shape[1:].numel(),), spec.n)
        elif isinstance(spec, Bounded) and spec.ndim == 2 and not spec.dtype.is_floating_point:
            numbers = spec.high[0].long() + 1
        else:
            raise ValueError(f"env must show codes, got {spec}; the grid worlds, MiniGrid's and BabyAI's tasks do.")
        self._firsts = numbers.cumsum(0) - numbers  # [D]
        self._dims = len(spec.shape) - 1
        self.size = int(numbers.sum())

    def __call__(self, codes: Tensor) -> NDArray[np.float32]:
        """Takes ``[*, ...]``."""
        vector = codes.long().flatten(codes.ndim - self._dims) + self._firsts
        return torch.zeros(*vector.shape[:-1], self.size).scatter_(-1, vector, 1.0).numpy()


class Outcome(NamedTuple):
    """What a step of all worlds showed."""

    shown: NDArray[np.float32]
    """``[N, S]``, what comes next: of a new episode where one has ended."""
    last: NDArray[np.float32]
    """``[N, S]``, what the step itself led to."""
    reward: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class Worlds:
    """N worlds: the same observations, actions, rewards, time limits and seeds as for our agents.

    Args:
        env: batch ``[N]``, with codes as observations.
        bonus: added to the reward for each subgoal attained, as ``bonus_reward`` of our flat agent.

    Raises:
        ValueError: if there is a bonus and no subgoals.
    """

    def __init__(self, env: EnvBase, *, bonus: float = 0.0) -> None:
        if bonus and keys.ATTAINED not in env.observation_spec:
            raise ValueError(f"bonus must be 0 for a task without subgoals, got {bonus}.")
        self.env, self.bonus = env, bonus
        self.number, self.num_actions = env.batch_size[0], int(env.action_spec.space.n)
        self.encode = OneHot(env.observation_spec[keys.OBSERVATION])
        self._now: TensorDictBase | None = None

    def reset(self) -> NDArray[np.float32]:
        """New episodes in all worlds, ``[N, S]``."""
        self._now = self.env.reset()
        return self.encode(self._now[keys.OBSERVATION])

    def step(self, actions: NDArray[np.int64]) -> Outcome:
        """One step with actions ``[N]``; a new episode begins where one ended."""
        assert self._now is not None, "reset comes first"
        step, self._now = self.env.step_and_maybe_reset(self._now.set(keys.ACTION, torch.as_tensor(actions)))
        after = step.get("next")
        reward = after[keys.REWARD].squeeze(-1)
        if self.bonus:
            reward = reward + self.bonus * after[keys.ATTAINED].sum(-1)
        terminated, done = (after[key].squeeze(-1).numpy() for key in (keys.TERMINATED, keys.DONE))
        last = self.encode(after[keys.OBSERVATION])
        shown = self.encode(self._now[keys.OBSERVATION]) if done.any() else last
        return Outcome(shown, last, reward.numpy(), terminated, done & ~terminated)
