"""What trainings of all peers have in common: their clock, their evaluations, and when they end."""

from __future__ import annotations

import sys
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
        self._intervals, self._is_over = 0, False  # intervals that have passed
        self._start_clock(None)

    def make(self, num_envs: int, seed: int | None = None) -> EnvBase:
        """Worlds of the task."""
        return make_task(self.arguments.id, num_envs, max_steps=self.arguments.max_steps, seed=seed)

    @property
    @abstractmethod
    def frames(self) -> int:
        """Environment steps so far."""

    @abstractmethod
    def advance(self) -> None:
        """Trains a little, a small part of ``interval_frames``; or longer, and calls :meth:`look` itself."""

    @abstractmethod
    def player(self, *, greedy: bool) -> TensorDictModuleBase | None:
        """The agent as it plays in our environments; ``None``: it has no such way to play."""

    @abstractmethod
    def save(self) -> None:
        """Called after each evaluation, with its line on disk."""

    def resume(self) -> None:
        """Leaves out lines after the frames that a checkpoint has; time goes on from the last one.

        Ends the program if that would leave out all of them.
        """
        lines = read(self.results)
        self._is_over = bool(lines) and lines[-1].final and self.used_up(lines[-1].frames, lines[-1].cpu_seconds)
        if self._is_over:
            self._start_clock(lines[-1])
            return
        known = [each for each in lines if each.frames <= self.frames] if self.frames else []
        if len(lines) > 1 and not known:
            sys.exit(
                f"error: {self.results} must be moved away to begin anew, got {len(lines)} evaluations of a training "
                "that can't go on, as there is no checkpoint of it; results=FOLDER writes to another place."
            )
        write(self.results, known)
        self._start_clock(known[-1] if known else None)
        self._intervals = self.frames // self.arguments.interval_frames

    def _start_clock(self, before: Evaluation | None) -> None:
        """Time goes on from that of the last evaluation."""
        began, cpu_began = (before.seconds, before.cpu_seconds) if before else (0.0, 0.0)
        self._began, self._cpu_began = time.monotonic() - began, time.process_time() - cpu_began

    @property
    def seconds(self) -> float:
        """Wall time of the training so far."""
        return time.monotonic() - self._began

    @property
    def cpu_seconds(self) -> float:
        """Processor time of the training so far."""
        return time.process_time() - self._cpu_began

    def used_up(self, frames: int, cpu_seconds: float) -> bool:
        """Whether there are neither frames nor time left."""
        return frames >= self.arguments.frames or cpu_seconds >= self.arguments.seconds

    def train(self) -> None:
        """Goes on until frames or time are used up, with evaluations in between."""
        if self._is_over:
            return
        if not self.frames:
            self.record()
        while not self._is_over:
            self.advance()
            self.look()

    def look(self) -> bool:
        """Evaluates where it is time to; returns whether the training is over."""
        intervals = self.frames // self.arguments.interval_frames
        if not self._is_over and self.used_up(self.frames, self.cpu_seconds):
            self._is_over = True
            self.record(final=True)
        elif intervals > self._intervals:
            self.record()
        self._intervals = intervals
        return self._is_over

    def record(self, *, final: bool = False) -> None:
        """Plays, writes a line, then saves: a checkpoint's line is always there.

        As of ours, a line has the time before its evaluation. Ours has no other way to play than the greedy one, so the
        time of the second evaluation does not count.
        """
        arguments, seconds, cpu_seconds = self.arguments, self.seconds, self.cpu_seconds
        found = self.evaluate(final=final, greedy=True)
        assert found is not None, "every agent plays greedily"
        began, cpu_began = time.monotonic(), time.process_time()
        sampled = self.evaluate(final=final, greedy=False)
        self._began += time.monotonic() - began
        self._cpu_began += time.process_time() - cpu_began
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
            final=final,
        )
        append(self.results, told)
        print(told, flush=True)
        self.save()

    def evaluate(self, *, final: bool, greedy: bool) -> dict[str, float] | None:
        """The averages of episodes; ``None``: the agent does not play like that."""
        player = self.player(greedy=greedy)
        if player is None:
            return None
        episodes = self.arguments.final_episodes if final else self.arguments.episodes
        return evaluate(self.evaluation_env, player, episodes=episodes, seed=EVALUATION_SEED + final)
