"""Our environments for Stable-Baselines3: the same observations, actions, rewards, time limits and seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.vec_env import VecEnv
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import EnvBase

from hdrqn_torchrl import keys


class OneHot:
    """Codes ``[*, D]`` as floats ``[*, S]``: for each code as many as there are values of it, one of them 1.

    Args:
        spec: of a batch of code vectors ``[N, D]``, as an environment states it.

    Raises:
        ValueError: if it is no code vector.
    """

    def __init__(self, spec: Bounded) -> None:
        if not isinstance(spec, Bounded) or spec.ndim != 2 or spec.dtype.is_floating_point:
            raise ValueError(f"env must show a vector of codes, got {spec}; MiniGrid's and BabyAI's tasks do.")
        numbers = spec.high[0].long() + 1  # [D]
        self._firsts = numbers.cumsum(0) - numbers
        self.size = int(numbers.sum())

    def __call__(self, codes: Tensor) -> NDArray[np.float32]:
        """Takes ``[*, D]``."""
        vector = torch.zeros(*codes.shape[:-1], self.size)
        return vector.scatter_(-1, codes.long() + self._firsts, 1.0).numpy()


class PeerVecEnv(VecEnv):
    """N worlds of ours as Stable-Baselines3 wants them.

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
        self.encode = OneHot(env.observation_spec[keys.OBSERVATION])
        super().__init__(
            env.batch_size[0],
            spaces.Box(0.0, 1.0, (self.encode.size,), np.float32),
            spaces.Discrete(int(env.action_spec.space.n)),
        )
        self._now: TensorDictBase | None = None
        self._actions: Tensor | None = None

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seeds all episodes from the next reset on."""
        self.env.set_seed(seed)
        return [seed] * self.num_envs

    def reset(self) -> NDArray[np.float32]:
        """New episodes in all worlds."""
        self._now = self.env.reset()
        return self.encode(self._now[keys.OBSERVATION])

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Takes the actions ``[N]``."""
        self._actions = torch.as_tensor(actions)

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """One step; a new episode begins where one ended."""
        assert self._now is not None and self._actions is not None, "reset, then step_async, come first"
        step, self._now = self.env.step_and_maybe_reset(self._now.set(keys.ACTION, self._actions))
        after = step.get("next")
        reward = after[keys.REWARD].squeeze(-1)
        if self.bonus:
            reward = reward + self.bonus * after[keys.ATTAINED].sum(-1)
        done = after[keys.DONE].squeeze(-1).numpy()
        infos: list[dict[str, Any]] = [{} for _ in done]
        for index in done.nonzero()[0]:
            infos[index] = {
                "terminal_observation": self.encode(after[keys.OBSERVATION][index]),
                "TimeLimit.truncated": bool(after[keys.TRUNCATED][index]),
            }
        return self.encode(self._now[keys.OBSERVATION]), reward.numpy(), done, infos

    def close(self) -> None:
        """Closes all worlds."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same for all worlds; there are no pictures."""
        return [None if attr_name == "render_mode" else getattr(self.env, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not possible."""
        raise NotImplementedError("worlds of a batch have no attributes of their own.")

    def env_method(self, method_name: str, *method_args, indices: Any = None, **method_kwargs) -> list[Any]:
        """Not possible."""
        raise NotImplementedError("worlds of a batch have no methods of their own.")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """None is."""
        return [False] * self.num_envs


class Player(TensorDictModuleBase):
    """A recurrent agent of sb3-contrib that plays in an environment of ours.

    Args:
        model: the agent.
        encode: as in its training.
        greedy: whether it plays its likeliest actions or draws them.
    """

    def __init__(self, model: RecurrentPPO, encode: OneHot, *, greedy: bool = True) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [keys.OBSERVATION, keys.IS_INIT], [keys.ACTION]
        self.policy, self.encode, self.greedy = model.policy, encode, greedy
        self._state: tuple[NDArray, ...] | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action``; the memory starts anew where ``is_init`` is set."""
        action, self._state = self.policy.predict(
            self.encode(tensordict[keys.OBSERVATION]),
            state=self._state,
            episode_start=tensordict[keys.IS_INIT].squeeze(-1).numpy(),
            deterministic=self.greedy,
        )
        return tensordict.set(keys.ACTION, torch.as_tensor(action))
