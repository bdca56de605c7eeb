"""RecurrentPPO of sb3-contrib: ``python benchmarks/peers/recurrent_ppo.py id=MiniGrid-DoorKey-8x8-v0 bonus=1``.

The same command goes on where it was stopped, from the last evaluation; episodes then in progress begin anew.
``arguments.py`` has all arguments; needs the extra: ``pip install 'hdrqn_torchrl[peers]'``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from arguments import Arguments
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.vec_env import VecEnv
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl import torchrl_logger
from training import Training
from worlds import OneHot, Worlds

from hdrqn_torchrl import keys

NUM_ENVS = 16
SETTINGS: dict[str, Any] = {
    "n_steps": 128,
    "batch_size": 256,
    "n_epochs": 4,
    "learning_rate": 5e-4,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "ent_coef": 0.01,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
    "policy_kwargs": {"lstm_hidden_size": 128, "optimizer_kwargs": {"eps": 1e-5}},
}
"""Those that MiniGrid's own starter files use for PPO, but half their learning rate and sequences of a whole rollout.
The memory is as large as ours; actor and critic each have one, as sb3-contrib has it."""


class PeerVecEnv(VecEnv):
    """Worlds as Stable-Baselines3 wants them.

    Args:
        worlds: N of them.
    """

    def __init__(self, worlds: Worlds) -> None:
        self.worlds = worlds
        shown = spaces.Box(0.0, 1.0, (worlds.encode.size,), np.float32)
        super().__init__(worlds.number, shown, spaces.Discrete(worlds.num_actions))
        self._actions: NDArray[np.int64] | None = None

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seeds all episodes from the next reset on."""
        self.worlds.env.set_seed(seed)
        return [seed] * self.num_envs

    def reset(self) -> NDArray[np.float32]:
        """New episodes in all worlds."""
        return self.worlds.reset()

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Takes the actions ``[N]``."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """One step; a new episode begins where one ended."""
        assert self._actions is not None, "step_async comes first"
        found = self.worlds.step(self._actions)
        done = found.terminated | found.truncated
        infos: list[dict[str, Any]] = [{} for _ in done]
        for index in done.nonzero()[0]:
            truncated = bool(found.truncated[index])
            infos[index] = {"terminal_observation": found.last[index], "TimeLimit.truncated": truncated}
        return found.shown, found.reward, done, infos

    def close(self) -> None:
        """Closes all worlds."""
        self.worlds.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same for all worlds; there are no pictures."""
        return [None if attr_name == "render_mode" else getattr(self.worlds.env, attr_name)] * self.num_envs

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


class RecurrentPPOTraining(Training):
    """A training, or what was left of it.

    Args:
        arguments: what was asked for.
    """

    def __init__(self, arguments: Arguments) -> None:
        super().__init__(arguments, "recurrent_ppo")
        self.checkpoint = arguments.runs / f"{self.name}.zip"
        self.worlds = Worlds(self.make(NUM_ENVS), bonus=arguments.bonus)
        self.model = self._begin(PeerVecEnv(self.worlds))
        self.resume()

    def _begin(self, env: PeerVecEnv) -> RecurrentPPO:
        """The agent as it was saved last, or a new one."""
        seed = self.arguments.seed
        if not self.checkpoint.exists():
            return RecurrentPPO("MlpLstmPolicy", env, seed=seed, device="cpu", **SETTINGS)
        model = RecurrentPPO.load(self.checkpoint, env, device="cpu")
        later = np.random.SeedSequence([seed, model.num_timesteps]).generate_state(1)[0]
        model.set_random_seed(int(later) >> 1)  # not the first episodes again
        return model

    @property
    def frames(self) -> int:
        """As its own counter has it."""
        return self.model.num_timesteps

    def advance(self) -> None:
        """One rollout."""
        self.model.learn(NUM_ENVS * self.model.n_steps, reset_num_timesteps=False)

    def player(self, *, greedy: bool) -> Player:
        """It plays its likeliest actions or draws them."""
        return Player(self.model, self.worlds.encode, greedy=greedy)

    def save(self) -> None:
        """Replaces the last checkpoint, which stays whole until then."""
        self.checkpoint.parent.mkdir(parents=True, exist_ok=True)
        new: Path = self.checkpoint.with_suffix(".new.zip")
        self.model.save(new)
        new.replace(self.checkpoint)


def main() -> None:
    """One run."""
    torch.set_num_threads(1)
    torchrl_logger.setLevel("WARNING")  # it writes to standard output
    RecurrentPPOTraining(Arguments.read(sys.argv[1:])).train()


if __name__ == "__main__":
    main()
