"""What trainings of all peers have in common: their clock, their evaluations, and when they end."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod

from arguments import Arguments
from evaluations import Evaluation, append, read, write
from tasks import make_task
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, InitTracker, TransformedEnv

from hdrqn_torchrl.runs.evaluation import evaluate

EVALUATION_ENVS, EVALUATION_SEED = 100, 1_000_000
"""As in ``conf/config.yaml``; like there, the last evaluation has the next seed."""


class Training(ABC):
    """A training and what it has shown so far.

    Args:
        arguments: what was asked for.
        agent: which one.
    """

    def __init__(self, arguments: Arguments, agent: str) -> None:
        self.arguments, self.agent = arguments, agent
        self.name = arguments.name_of(agent)
        self.results = arguments.results / f"{self.name}.jsonl"
        env = self.make(min(EVALUATION_ENVS, arguments.episodes), seed=EVALUATION_SEED)
        self.evaluation_env = TransformedEnv(env, InitTracker())
        self.start_clock(None)

    def make(self, num_envs: int, seed: int | None = None) -> EnvBase:
        """Worlds of the task."""
        return make_task(self.arguments.id, num_envs, max_steps=self.arguments.max_steps, seed=seed)

    @property
    @abstractmethod
    def frames(self) -> int:
        """Environment steps so far."""

    @abstractmethod
    def advance(self) -> None:
        """Trains a little, a small part of ``interval_frames``."""

    @abstractmethod
    def player(self, *, greedy: bool) -> TensorDictModuleBase | None:
        """The agent as it plays in our environments; ``None``: it has no such way to play."""

    @abstractmethod
    def save(self) -> None:
        """Called after each evaluation, with its line on disk."""

    def resume(self) -> None:
        """Leaves out lines after the frames that a checkpoint has; time goes on from the last one."""
        known = [each for each in read(self.results) if each.frames <= self.frames] if self.frames else []
        write(self.results, known)
        self.start_clock(known[-1] if known else None)

    def start_clock(self, before: Evaluation | None) -> None:
        """Time goes on from that of the last evaluation."""
        self._before, self._started, self._cpu_started = before, time.monotonic(), time.process_time()

    @property
    def seconds(self) -> float:
        """Wall time of the training so far."""
        return (self._before.seconds if self._before else 0.0) + time.monotonic() - self._started

    @property
    def cpu_seconds(self) -> float:
        """Processor time of the training so far."""
        return (self._before.cpu_seconds if self._before else 0.0) + time.process_time() - self._cpu_started

    @property
    def is_over(self) -> bool:
        """Whether frames or time are used up."""
        return self.frames >= self.arguments.frames or self.cpu_seconds >= self.arguments.seconds

    def train(self) -> None:
        """Goes on until frames or time are used up, with evaluations in between."""
        arguments = self.arguments
        if not self.frames:
            self.record()
        over = self.is_over
        while not over:
            before = self.frames // arguments.interval_frames
            self.advance()
            over = self.is_over
            if over:
                self.record(final=True)
            elif self.frames // arguments.interval_frames > before:
                self.record()

    def record(self, *, final: bool = False) -> None:
        """Plays, writes a line, then saves: a checkpoint's line is always there.

        Ours has no other way to play than the greedy one, so the time of the second evaluation does not count.
        """
        arguments = self.arguments
        found = self.evaluate(final=final, greedy=True)
        assert found is not None, "every agent plays greedily"
        seconds, cpu_seconds = self.seconds, self.cpu_seconds  # until here
        sampled = self.evaluate(final=final, greedy=False)
        told = Evaluation(
            agent=self.agent,
            id=arguments.task,
            bonus=arguments.bonus,
            seed=arguments.seed,
            frames=self.frames,
            seconds=seconds,
            cpu_seconds=cpu_seconds,
            episodes=int(found["episodes"]),
            return_mean=found["return_mean"],
            success_rate=found["success_rate"],
            steps_mean=found["steps_mean"],
            sampled_success_rate=None if sampled is None else sampled["success_rate"],
        )
        append(self.results, told)
        print(told, flush=True)
        self.save()
        self.start_clock(told)

    def evaluate(self, *, final: bool, greedy: bool) -> dict[str, float] | None:
        """The averages of episodes; ``None``: the agent does not play like that."""
        player = self.player(greedy=greedy)
        if player is None:
            return None
        episodes = self.arguments.final_episodes if final else self.arguments.episodes
        return evaluate(self.evaluation_env, player, episodes=episodes, seed=EVALUATION_SEED + final)
