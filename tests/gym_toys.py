"""Small Gymnasium environments whose every step is known beforehand."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from hdrqn_torchrl.envs.gym import Subgoals


class Counter(gymnasium.Env):
    """Counts up by 1 or 2 from a random start; it terminates at 10 or more."""

    observation_space = spaces.Box(0.0, 20.0, (2,), np.float32)
    action_space = spaces.Discrete(2)
    shows_resets = False

    def __init__(self, ends: bool = True, masked: bool = False) -> None:
        self.ends, self.masked, self.resets = ends, masked, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.resets += 1
        self.count = int(self.np_random.integers(0, 5))
        return self._shown(), self._info()

    def step(self, action):
        assert not self.masked or self._info()["action_mask"][action], "an action that was not available was chosen"
        self.count += 1 + int(action)
        over = self.ends and self.count >= 10
        return self._shown(), float(over), over, False, self._info()

    def _shown(self):
        return np.array([self.count, self.resets * self.shows_resets], np.float32)

    def _info(self):
        mask = {"action_mask": np.array([True, self.count % 2 == 0])} if self.masked else {}
        return {"count": self.count, "even": self.count % 2 == 0, **mask}


class CountingResets(Counter):
    """It shows how often it was reset, too."""

    shows_resets = True


class Milestones(Subgoals):
    """To have counted to 5 and to 8."""

    names = ("five", "eight")

    def conditions(self, env, before, after, info):
        return after[0] >= 5, after[0] >= 8


class Remembering(Counter):
    """A counter that offers its own state and does not start anew from a seed alone."""

    noise = np.random.default_rng(0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.count = int(self.noise.integers(0, 5))
        return self._shown(), self._info()

    def state_dict(self):
        return {"count": self.count, "resets": self.resets}

    def load_state_dict(self, state):
        self.count, self.resets = state["count"], state["resets"]


class Forgetful(Remembering):
    """The same without a state: nothing brings its episodes back."""

    state_dict = load_state_dict = None


gymnasium.register(id="Counter-v0", entry_point=Counter)
