"""The training loop. It owns time; learning is the learners' business, and it knows no algorithm.

TorchRL's ``Trainer`` is not used: it keeps its counters on the class, so that two trainings in one process
share them (a sweep does just that), and hands every optimiser step one batch from one buffer, where each of our
learners draws from its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector

from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.checkpoint import save_weights
from hdrqn_torchrl.evaluation import EpisodeTracker
from hdrqn_torchrl.logging import Row, RunLogger


class Trainer:
    """Collects, stores, updates, logs and evaluates until ``total_frames`` are done.

    Args:
        algorithm: policy and learners.
        collector: yields batches ``[N, T]`` from the transformed environment.
        logger: where log points go.
        evaluate: plays greedy episodes and returns their averages (:func:`~hdrqn_torchrl.evaluation.evaluate`).
        total_frames: environment frames to collect.
        log_frames: frames between log points.
        evaluation_frames: frames between greedy evaluations; the first comes before training.
        checkpoints: folder for weights; ``last.safetensors`` and ``best.safetensors`` (by greedy return) are written
            at evaluations and at the end. ``None``: nothing is written.
        ceiling: return of a scripted player, logged beside the greedy one.
    """

    def __init__(
        self,
        algorithm: Algorithm,
        collector: BaseCollector,
        *,
        logger: RunLogger,
        evaluate: Callable[[], dict[str, float]],
        total_frames: int,
        log_frames: int = 10_000,
        evaluation_frames: int = 50_000,
        checkpoints: Path | None = None,
        ceiling: float | None = None,
    ) -> None:
        self.algorithm, self.collector, self.logger, self.evaluate = algorithm, collector, logger, evaluate
        self.total_frames, self.log_frames, self.evaluation_frames = total_frames, log_frames, evaluation_frames
        self.checkpoints, self.ceiling = checkpoints, ceiling
        self.frames, self.episodes, self.best_return = 0, 0, -float("inf")
        self._tracker = EpisodeTracker()
        self._window = _Window()
        self._started = time.monotonic()

    @property
    def wall_seconds(self) -> float:
        """Seconds since the trainer was built."""
        return time.monotonic() - self._started

    @property
    def updates(self) -> int:
        """Gradient steps of all learners together."""
        return sum(learner.updates for learner in self.algorithm.learners.values())

    def train(self) -> None:
        """Runs to ``total_frames``. Weights are kept when it is interrupted, too."""
        try:
            self.log(evaluation=True)
            for batch in self.collector:
                self.step(batch)
                if self.frames >= self.total_frames:
                    break
        finally:
            self.save("last")
            self.logger.close()

    def step(self, batch: TensorDictBase) -> None:
        """One iteration on a collected batch ``[N, T]``."""
        before, self.frames = self.frames, self.frames + batch.numel()
        finished = self._tracker.finished(batch)
        self.episodes += len(finished)
        self._window.add_episodes(finished)
        for name, learner in self.algorithm.learners.items():
            learner.store(batch)
            for _ in range(learner.updates_due()):
                self._window.add_update(name, learner.update(learner.sample()))
        for exploration in self.algorithm.explorations.values():
            exploration.step(batch.numel())
        self.collector.update_policy_weights_()
        done = self.frames >= self.total_frames
        evaluation = done or crossed(before, self.frames, self.evaluation_frames)
        if evaluation or crossed(before, self.frames, self.log_frames):
            self.log(evaluation=evaluation)

    def log(self, *, evaluation: bool) -> None:
        """Writes one log point, after a greedy evaluation if asked for."""
        row: Row = {
            "frames": self.frames,
            "episodes": self.episodes,
            "updates": self.updates,
            "wall_seconds": round(self.wall_seconds, 2),
            **self._window.summary(self.frames),
            **{f"{name}/updates": learner.updates for name, learner in self.algorithm.learners.items()},
            **{f"{name}/learning_rate": learner.learning_rate for name, learner in self.algorithm.learners.items()},
            **{f"{name}/epsilon": level.epsilon.item() for name, level in self.algorithm.explorations.items()},
        }
        if evaluation:
            result = self.evaluate()
            row |= {
                f"greedy/{name.removesuffix('_mean').removesuffix('_rate')}": value for name, value in result.items()
            }
            if self.ceiling is not None:
                row["greedy/ceiling"] = self.ceiling
            self.save("last")
            if result["return_mean"] > self.best_return:
                self.best_return = result["return_mean"]
                self.save("best")
        self.logger.log(row)
        self._window = _Window(self.frames)

    def save(self, name: str) -> None:
        """Writes the policy's weights to ``checkpoints/<name>.safetensors``."""
        if self.checkpoints is not None:
            save_weights(self.algorithm.policy, self.checkpoints / f"{name}.safetensors")


def crossed(before: int, after: int, interval: int) -> bool:
    """Whether a multiple of ``interval`` lies in (before, after]."""
    return before // interval < after // interval


class _Window:
    """What happened since the last log point; tensors stay on their device until it is summed up."""

    def __init__(self, frames: int = 0) -> None:
        self._frames, self._since = frames, time.monotonic()
        self._episodes: list[TensorDictBase] = []
        self._sums: dict[str, dict[str, Tensor]] = {}
        self._counts: dict[str, int] = {}

    def add_episodes(self, episodes: TensorDictBase) -> None:
        if len(episodes):
            self._episodes.append(episodes)

    def add_update(self, learner: str, metrics: dict[str, Tensor]) -> None:
        sums = self._sums.get(learner)
        self._sums[learner] = metrics if sums is None else {name: sums[name] + value for name, value in metrics.items()}
        self._counts[learner] = self._counts.get(learner, 0) + 1

    def summary(self, frames: int) -> Row:
        seconds = max(time.monotonic() - self._since, 1e-9)
        row: Row = {"frames_per_second": round((frames - self._frames) / seconds, 1)}
        if self._episodes:
            episodes: TensorDictBase = torch.cat(self._episodes, 0)  # type: ignore[assignment]
            row |= {f"behaviour/{name}": value.mean().item() for name, value in episodes.items()}
        for learner, sums in self._sums.items():
            count = self._counts[learner]
            row |= {f"{learner}/{name}": (total / count).item() for name, total in sums.items()}
            row[f"{learner}/updates_per_second"] = round(count / seconds, 1)
        return row
