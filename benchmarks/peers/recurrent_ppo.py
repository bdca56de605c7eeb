"""RecurrentPPO of sb3-contrib: ``python benchmarks/peers/recurrent_ppo.py id=MiniGrid-DoorKey-8x8-v0 bonus=1``.

The same command goes on where it was stopped, from the last evaluation; episodes then in progress begin anew.
``arguments.py`` has all arguments; needs the extra: ``pip install 'hdrqn_torchrl[peers]'``.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from arguments import Arguments
from evaluations import Evaluation, append, read, write
from sb3_contrib import RecurrentPPO
from torchrl import torchrl_logger
from torchrl.envs import EnvBase, InitTracker, TransformedEnv
from worlds import PeerVecEnv, Player

from hdrqn_torchrl.envs import make_minigrid
from hdrqn_torchrl.runs.evaluation import evaluate

AGENT = "recurrent_ppo"
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
EVALUATION_ENVS, EVALUATION_SEED = 100, 1_000_000
"""As in ``conf/config.yaml``; like there, the last evaluation has the next seed."""


class Run:
    """A training and what it has shown so far.

    Args:
        arguments: what was asked for.
    """

    def __init__(self, arguments: Arguments) -> None:
        self.arguments = arguments
        name = arguments.name_of(AGENT)
        self.results, self.checkpoint = arguments.results / f"{name}.jsonl", arguments.runs / f"{name}.zip"
        self.worlds = PeerVecEnv(self._make(NUM_ENVS), bonus=arguments.bonus)
        self.model = self._begin()
        known = [each for each in read(self.results) if each.frames <= self.model.num_timesteps]
        write(self.results, known if self.model.num_timesteps else [])
        env = self._make(min(EVALUATION_ENVS, arguments.episodes), seed=EVALUATION_SEED)
        self.evaluation_env = TransformedEnv(env, InitTracker())
        self._start_clock(known[-1] if self.model.num_timesteps else None)

    def _start_clock(self, before: Evaluation | None) -> None:
        """Time goes on from that of the last evaluation."""
        self._before, self._started, self._cpu_started = before, time.monotonic(), time.process_time()

    def _begin(self) -> RecurrentPPO:
        """The agent as it was saved last, or a new one."""
        if not self.checkpoint.exists():
            return RecurrentPPO("MlpLstmPolicy", self.worlds, seed=self.arguments.seed, device="cpu", **SETTINGS)
        model = RecurrentPPO.load(self.checkpoint, self.worlds, device="cpu")
        later = np.random.SeedSequence([self.arguments.seed, model.num_timesteps]).generate_state(1)[0]
        model.set_random_seed(int(later) >> 1)  # not the first episodes again
        return model

    def _make(self, num_envs: int, seed: int | None = None) -> EnvBase:
        return make_minigrid(self.arguments.id, num_envs, max_steps=self.arguments.max_steps or None, seed=seed)

    @property
    def seconds(self) -> float:
        """Wall time of the training so far."""
        return (self._before.seconds if self._before else 0.0) + time.monotonic() - self._started

    @property
    def cpu_seconds(self) -> float:
        """Time of a processor."""
        before = self._before.cpu_seconds if self._before else None
        return (before or 0.0) + time.process_time() - self._cpu_started

    @property
    def is_over(self) -> bool:
        """Whether frames or time are used up."""
        return self.model.num_timesteps >= self.arguments.frames or self.seconds >= self.arguments.seconds

    def train(self) -> None:
        """Rollout after rollout, with evaluations between them."""
        arguments, rollout = self.arguments, NUM_ENVS * self.model.n_steps
        if not self.model.num_timesteps:
            self.record()
        over = self.is_over
        while not over:
            before = self.model.num_timesteps // arguments.interval_frames
            self.model.learn(rollout, reset_num_timesteps=False)
            over = self.is_over
            if over:
                self.record(final=True)
            elif self.model.num_timesteps // arguments.interval_frames > before:
                self.record()

    def record(self, *, final: bool = False) -> None:
        """Plays, writes a line, then saves: a checkpoint's line is always there.

        Ours has no other way to play than the greedy one, so the time of the second evaluation does not count.
        """
        arguments = self.arguments
        found = self.evaluate(final=final, greedy=True)
        seconds, cpu_seconds = self.seconds, self.cpu_seconds  # until here
        told = Evaluation(
            agent=AGENT,
            id=arguments.task,
            bonus=arguments.bonus,
            seed=arguments.seed,
            frames=self.model.num_timesteps,
            seconds=seconds,
            cpu_seconds=cpu_seconds,
            episodes=int(found["episodes"]),
            return_mean=found["return_mean"],
            success_rate=found["success_rate"],
            steps_mean=found["steps_mean"],
            sampled_success_rate=self.evaluate(final=final, greedy=False)["success_rate"],
        )
        append(self.results, told)
        print(told, flush=True)
        save(self.model, self.checkpoint)
        self._start_clock(told)

    def evaluate(self, *, final: bool, greedy: bool) -> dict[str, float]:
        """The averages of episodes."""
        episodes = self.arguments.final_episodes if final else self.arguments.episodes
        player = Player(self.model, self.worlds.encode, greedy=greedy)
        return evaluate(self.evaluation_env, player, episodes=episodes, seed=EVALUATION_SEED + final)


def save(model: RecurrentPPO, path: Path) -> None:
    """Replaces the last checkpoint, which stays whole until then."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_suffix(".new.zip")
    model.save(new)
    new.replace(path)


def main() -> None:
    """One run."""
    torch.set_num_threads(1)
    torchrl_logger.setLevel("WARNING")  # it writes to standard output
    Run(Arguments.read(sys.argv[1:])).train()


if __name__ == "__main__":
    main()
