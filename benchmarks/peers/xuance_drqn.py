"""DRQN of XuanCe: ``python benchmarks/peers/xuance_drqn.py id=gridworld seconds=1200``.

It keeps no checkpoint: a run that was stopped can't go on. ``arguments.py`` has all arguments. XuanCe asks for older
versions of NumPy and Gymnasium than this project, with which it works nevertheless: ``pip install --no-deps xuance``,
and what it then misses (pyglet 1.5.15, moviepy 1.0.3, wandb, pettingzoo, opencv-python-headless, pygame).
"""

from __future__ import annotations

import sys
import tempfile
from argparse import Namespace
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from arguments import Arguments
from gymnasium import spaces
from numpy.typing import NDArray
from tasks import exploration_of
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl import torchrl_logger
from training import Training
from worlds import OneHot, Worlds
from xuance.common import BaseCallback, EpisodeBuffer, RecurrentOffPolicyBuffer
from xuance.torch.agents import DRQN_Agent
from xuance.torch.agents.qlearning_family import drqn_agent

from hdrqn_torchrl import keys

NUM_ENVS, CAPACITY = 10, 200_000
SETTINGS: dict[str, Any] = {
    "policy": "DRQN_Policy",
    "representation": "Basic_MLP",
    "learner": "DRQN_Learner",
    "rnn": "LSTM",
    "representation_hidden_size": [128],
    "recurrent_hidden_size": 128,
    "recurrent_layer_N": 1,
    "dropout": 0,
    "activation": "relu",
    "parallels": NUM_ENVS,
    "batch_size": 8,
    "learning_rate": 0.001,
    "gamma": 0.99,
    "start_greedy": 1.0,
    "sync_frequency": 50,
    "training_frequency": 1,
    "start_training": 10_000,
    "lookup_length": 50,
    "use_grad_clip": False,
    "grad_clip_norm": 0.5,
    "use_obsnorm": False,
    "use_rewnorm": False,
    "obsnorm_range": 5,
    "rewnorm_range": 5,
}
"""Those of XuanCe's own file for CartPole, but it begins to learn when ours does. Its memory and its replay memory are
as large as ours, epsilon is that of our sub level; an update of 8 sequences follows each step of all worlds."""
_PLACE: dict[str, Any] = {
    "agent": "DRQN",
    "env_name": "hdrqn_torchrl",
    "dl_toolbox": "torch",
    "device": "cpu",
    "distributed_training": False,
    "render": False,
    "render_mode": "rgb_array",
    "fps": 1,
    "logger": "tensorboard",
}


class XuanceWorlds:
    """Worlds as XuanCe wants them.

    Args:
        worlds: N of them.
        longest: steps of an episode.
    """

    def __init__(self, worlds: Worlds, longest: int) -> None:
        self.worlds, self.num_envs, self.max_episode_steps = worlds, worlds.number, longest
        self.observation_space = spaces.Box(0.0, 1.0, (worlds.encode.size,), np.float32)
        self.action_space = spaces.Discrete(worlds.num_actions)
        self.reset()

    def reset(self) -> tuple[NDArray[np.float32], list[dict[str, Any]]]:
        """New episodes in all worlds."""
        self.buf_obs = self.worlds.reset()
        self._steps, self._scores = np.zeros(self.num_envs, int), np.zeros(self.num_envs)
        return self.buf_obs, [{} for _ in range(self.num_envs)]

    def step(self, actions: NDArray[np.int64]) -> tuple[Any, ...]:
        """One step; XuanCe is shown what it led to, and beside that the new episode where one begins."""
        found = self.worlds.step(actions)
        self._steps, self._scores = self._steps + 1, self._scores + found.reward
        infos = [
            {"episode_step": int(steps), "episode_score": float(score), "reset_obs": shown}
            for steps, score, shown in zip(self._steps, self._scores, found.shown, strict=True)
        ]
        ended = found.terminated | found.truncated
        self._steps[ended], self._scores[ended] = 0, 0.0
        return found.last.copy(), found.reward, found.terminated, found.truncated, infos


class Episodes(RecurrentOffPolicyBuffer):
    """As many steps as ours has, and not as many episodes."""

    steps = 0

    def store(self, episode: EpisodeBuffer) -> None:
        """Forgets the oldest episodes instead of steps beyond the capacity."""
        self.memory.append(episode)
        self.steps += len(episode)
        while self.steps > CAPACITY:
            self.steps -= len(self.memory.popleft())
        self.size = len(self.memory)


class Watch(BaseCallback):
    """Looks at a training after each step: XuanCe throws episodes in progress away where one ends and goes on."""

    def __init__(self, look: Callable[[], bool]) -> None:
        super().__init__()
        self.look = look

    def on_train_step_end(self, *args, **kwargs) -> None:
        """Ends it when it is over."""
        if self.look():
            raise Over


class Over(Exception):
    """Frames or time are used up."""


class QuietAgent(DRQN_Agent):
    """Without figures of its own, and with what episodes ended in."""

    def _build_memory(self, auxiliary_info_shape: Any = None) -> Episodes:
        shown, acted = self.observation_space, self.action_space
        sizes = {"buffer_size": CAPACITY * self.n_envs, "batch_size": self.config.batch_size}
        lengths = {"episode_length": self.episode_length, "lookup_length": self.config.lookup_length}
        self.atari = False
        return Episodes(shown, acted, auxiliary_info_shape, self.n_envs, **sizes, **lengths)

    def _process_observation(self, observations: Any) -> Any:
        """A copy: XuanCe writes the first observation of the next episode over the last one of a stored one."""
        return np.array(super()._process_observation(observations))

    @torch.no_grad()
    def get_actions(self, *args: Any, **kwargs: Any) -> Any:
        """Without a graph: XuanCe's would grow from the first step to the last, by 22 kB each."""
        return super().get_actions(*args, **kwargs)

    def log_infos(self, info: dict[str, Any], x_index: int) -> None:
        """Writes nothing."""


class Player(TensorDictModuleBase):
    """XuanCe's agent, which plays greedily in an environment of ours.

    Args:
        policy: of the agent.
        encode: as in its training.
    """

    def __init__(self, policy: torch.nn.Module, encode: OneHot) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [keys.OBSERVATION, keys.IS_INIT], [keys.ACTION]
        self._policy, self.encode = [policy], encode  # not a part: evaluations keep their modules' modes
        self._state: tuple[torch.Tensor, ...] | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action``; the memory starts anew where ``is_init`` is set."""
        (policy,) = self._policy
        begins = tensordict[keys.IS_INIT].squeeze(-1)
        state = self._state or policy.init_hidden(len(begins))
        state = tuple(each.masked_fill(begins.unsqueeze(-1), 0.0) for each in state)
        _, action, _, self._state = policy(self.encode(tensordict[keys.OBSERVATION])[:, None], *state)
        return tensordict.set(keys.ACTION, action)


class XuanceTraining(Training):
    """A training from its beginning.

    Args:
        arguments: what was asked for.
        folder: for files of XuanCe.
    """

    def __init__(self, arguments: Arguments, folder: str) -> None:
        super().__init__(arguments, "xuance_drqn")
        env = self.make(NUM_ENVS, seed=arguments.seed)
        self.worlds = XuanceWorlds(Worlds(env, bonus=arguments.bonus), env.task.max_steps)
        place = {"env_id": arguments.id, "log_dir": folder, "model_dir": folder}
        asked: dict[str, Any] = {"seed": arguments.seed, "running_steps": arguments.frames, "buffer_size": 0}
        epsilon = exploration_of(arguments.id)
        asked |= {"decay_step_greedy": epsilon.frames, "end_greedy": epsilon.end}
        config = Namespace(**SETTINGS, **_PLACE, **place, **asked)
        self.learner = QuietAgent(config, self.worlds, callback=Watch(self.look))
        self.resume()

    @property
    def frames(self) -> int:
        """As its own counter has it."""
        return self.learner.current_step

    def advance(self) -> None:
        """To the end."""
        with suppress(Over):
            self.learner.train(-(-self.arguments.frames // NUM_ENVS))

    def player(self, *, greedy: bool) -> Player | None:
        """It has no probabilities."""
        return Player(self.learner.policy, self.worlds.worlds.encode) if greedy else None

    def save(self) -> None:
        """XuanCe cannot store what it remembers of episodes."""


def main() -> None:
    """One run."""
    drqn_agent.tqdm = iter  # without a bar for each chunk
    torch.set_num_threads(1)
    torchrl_logger.setLevel("WARNING")  # it writes to standard output
    with tempfile.TemporaryDirectory() as folder:
        XuanceTraining(Arguments.read(sys.argv[1:]), folder).train()


if __name__ == "__main__":
    main()
