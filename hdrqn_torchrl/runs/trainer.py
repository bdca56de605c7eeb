"""The training loop. It owns time; learning is the learners' business, and it knows no algorithm.

TorchRL's ``Trainer`` is not used: it keeps its counters on the class, so that two trainings in one process
share them (a sweep does just that), and hands every optimiser step one batch from one buffer, where each of our
learners draws from its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from torchrl.checkpoint import CheckpointError
from torchrl.collectors import BaseCollector

from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.learning import Monitor
from hdrqn_torchrl.learning.finite import NonFiniteError, naming
from hdrqn_torchrl.runs.clock import Clock
from hdrqn_torchrl.runs.collectors.captured import CapturedCollector
from hdrqn_torchrl.runs.collectors.workers import WorkersCollector
from hdrqn_torchrl.runs.episode_tracker import EpisodeTracker
from hdrqn_torchrl.runs.incoming import Incoming
from hdrqn_torchrl.runs.interruption import Interrupted, StopRequest
from hdrqn_torchrl.runs.log_interval import LogInterval, check_counters, crossed, warn_of_clipping
from hdrqn_torchrl.runs.logging import Row, RunLogger
from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints, RandomState
from hdrqn_torchrl.runs.persistence.components import components_of
from hdrqn_torchrl.runs.persistence.saving import Saving
from hdrqn_torchrl.runs.persistence.state_checks import rules_of
from hdrqn_torchrl.runs.unattained import UnattainedSubgoals


class Trainer:
    """Collects, stores, updates, logs, evaluates and saves until ``total_frames`` are done.

    An iteration can be cut between any two updates: what is left of it is owed, and done first when the training
    goes on. A training that was stopped and resumed is bit for bit the one that was not.

    Args:
        algorithm: policy and learners.
        collector: yields batches ``[N, T]`` from the transformed environment. If ``checkpoints`` are given it must
            keep its state (:class:`~hdrqn_torchrl.runs.collectors.resumable.ResumableCollector`,
            :class:`~hdrqn_torchrl.runs.collectors.workers.WorkersCollector`).
        logger: where log points go.
        evaluate: plays greedy episodes and returns their averages (:func:`~hdrqn_torchrl.runs.evaluation.evaluate`;
            give it ``check=stop.check``, or Ctrl-C waits for its end).
        total_frames: environment frames to collect.
        log_frames: frames between log points.
        evaluation_frames: frames between greedy evaluations; the first comes before training.
        checkpoints: where the whole training is saved; ``None``: nowhere.
        checkpoint_frames: frames between checkpoints.
        checkpoint_seconds: seconds after which one is written in any case.
        ceiling: asked at every greedy evaluation for the return of a scripted player, which is logged next to the
            agent's; ``None`` if there is none.
        stop: asked for at safe points; several trainings of a process share one.

    Raises:
        ValueError: if there are checkpoints and the collector does not keep its state.

    Examples:
        >>> import tempfile
        >>> from torchrl.collectors import Collector
        >>> from hdrqn_torchrl.algorithms import make_drqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> from hdrqn_torchrl.runs import evaluate
        >>> env, judge = MultiGoalGridEnv(num_envs=2), MultiGoalGridEnv(num_envs=4, max_steps=10)
        >>> agent = make_drqn(env, compact_network(8, (8,)))
        >>> env, judge = agent.transform(env), agent.transform(judge)
        >>> sizes = {"frames_per_batch": 32, "total_frames": -1}
        >>> trainer = Trainer(
        ...     agent,
        ...     Collector(env, agent.policy, **sizes, auto_register_policy_transforms=False),
        ...     logger=RunLogger(Path(tempfile.mkdtemp()), total_frames=64),
        ...     evaluate=lambda: evaluate(judge, agent.policy, episodes=4),
        ...     total_frames=64,
        ... )
        >>> trainer.train()
        >>> trainer.frames, trainer.updates  # no update before LearnerSettings.warmup_frames
        (64, 0)
    """

    def __init__(
        self,
        algorithm: Algorithm,
        collector: BaseCollector | CapturedCollector | WorkersCollector,
        *,
        logger: RunLogger,
        evaluate: Callable[[], dict[str, float]],
        total_frames: int,
        log_frames: int = 10_000,
        evaluation_frames: int = 50_000,
        checkpoints: Checkpoints | None = None,
        checkpoint_frames: int = 50_000,
        checkpoint_seconds: float = 600.0,
        ceiling: Callable[[], float | None] = lambda: None,
        stop: StopRequest | None = None,
    ) -> None:
        if checkpoints is not None and not hasattr(collector, "give_up"):
            raise ValueError(
                f"collector must keep its state where checkpoints are given, got a {type(collector).__name__}, whose "
                "episodes in progress would be lost; use ResumableCollector, or no checkpoints."
            )
        self.algorithm, self.collector, self.logger, self.evaluate = algorithm, collector, logger, evaluate
        self.total_frames, self.log_frames, self.evaluation_frames = total_frames, log_frames, evaluation_frames
        self.checkpoints, self.checkpoint_frames, self.ceiling = checkpoints, checkpoint_frames, ceiling
        self.frames, self.episodes, self.best_return = 0, 0, -float("inf")
        self._completed: int | None = None  # frames at the end of the last complete iteration; None: not begun
        self._tracker = EpisodeTracker(algorithm.task)
        self._incoming = Incoming(self._tracker)
        self._interval = LogInterval()
        self._unattained = UnattainedSubgoals(algorithm.pursued)
        self._stop = stop or StopRequest()
        self.clock = Clock()
        self._saving = Saving(checkpoints, self._parts, place=lambda: self._place, seconds=checkpoint_seconds)

    @property
    def _reporting(self) -> list[Monitor | WorkersCollector]:
        workers = [self.collector] if isinstance(self.collector, WorkersCollector) else []
        return [*self.algorithm.monitors.values(), *workers]

    @property
    def updates(self) -> int:
        """Gradient steps of all learners together."""
        return self.algorithm.updates

    def train(self) -> None:
        """Runs to ``total_frames``.

        Raises:
            Interrupted: on SIGINT or SIGTERM, after saving. A second signal does not wait for that.
            NonFiniteError: before a NaN or an infinity reaches the weights.
            CheckpointError: if the training can't be saved.
            Exception: whatever environment, policy or learner raise, after saving. What was collected since the last
                whole batch is left out, and new episodes begin where the training goes on. An error in the middle of
                storing a batch or of changing weights leaves nothing that could be saved.
        """
        for _ in self.pieces():
            pass

    def pieces(self) -> Iterator[None]:
        """:meth:`train` in pieces, between which another training may have its turn.

        A piece ends where the host would wait for the device. It raises what :meth:`train` does.
        """
        try:
            with self._stop:
                yield from self._run()
        finally:
            self.logger.close()

    def _run(self) -> Iterator[None]:
        try:
            yield from self._complete_iteration()
            if self.frames < self.total_frames:
                for index, batch in enumerate(self._collected()):
                    yield
                    if index == 0:
                        self._saving.check_storable("collector")  # it has states of a user's environment
                    self._receive(batch)
                    yield from self._complete_iteration()
                    if self.frames >= self.total_frames:
                        break
            self.save()
        except Interrupted:
            self.save()
            raise
        except NonFiniteError as error:
            left = "nothing was saved" if self.checkpoints is None else self.checkpoints.last_good()
            raise NonFiniteError(f"{error}; training stopped before it could reach the weights; {left}.") from error
        except CheckpointError:
            raise
        except Exception as error:
            if all(learner.is_whole for learner in self.algorithm.learners.values()):
                self._saving.save_after(error, self.frames)
            raise

    def _collected(self) -> Iterator[TensorDictBase]:
        """Batches ``[N, T]``; an error on the way to one costs the episodes in progress and nothing else."""
        batches = iter(self.collector)
        while True:
            try:
                if (batch := next(batches, None)) is None:
                    return
                self._incoming.check(batch, self.frames)
            except Exception as error:
                if hasattr(self.collector, "give_up"):  # others are not saved
                    self.collector.give_up(self.frames)
                self._saving.save_after(error, self.frames, given_up=True)
                raise
            yield batch

    def step(self, batch: TensorDictBase) -> None:
        """One iteration on a collected batch ``[N, T]``."""
        self._incoming.check(batch, self.frames)
        self._receive(batch)
        for _ in self._complete_iteration():
            pass

    def _receive(self, batch: TensorDictBase) -> None:
        """Counts and stores a collected batch ``[N, T]``."""
        self._incoming.check_late(batch, self.frames)
        with self._saving.in_parts():
            self.frames += batch.numel()
            self.algorithm.observe(batch)
            self._unattained.observe(batch)
            self.episodes += self._interval.add_episodes(self._incoming.take(batch))
        self.logger.advance(self.frames)

    def _complete_iteration(self) -> Iterator[None]:
        """All updates that are owed, then what is due at these frames; picks up where a stopped one ended."""
        for name, learner in self.algorithm.learners.items():
            with naming(name):
                for _ in range(learner.updates_due()):
                    self._stop.check()
                    self._interval.add_update(name, learner.learn())
            yield
            with naming(name):
                learner.check_finite(late=self.frames < self.total_frames)
        self.collector.update_policy_weights_()
        before, best = self._completed, False
        if before != self.frames:
            evaluation = self._due(self.evaluation_frames) or self.frames >= self.total_frames
            if evaluation or self._due(self.log_frames):
                best = self.log(evaluation=evaluation)
            self._completed = self.frames
        if before is not None and (
            best or self._saving.is_late() or crossed(before, self.frames, self.checkpoint_frames)
        ):
            self.save(score=self.best_return if best else None)
        self._stop.check()

    def _due(self, interval: int) -> bool:
        """Whether a multiple of ``interval`` was passed in this iteration; at the very beginning, too."""
        return self._completed is None or crossed(self._completed, self.frames, interval)

    def log(self, *, evaluation: bool) -> bool:
        """Writes one log point, after a greedy evaluation if asked for. Returns whether that was the best so far."""
        self.episodes += self._interval.add_episodes(self._incoming.settle())
        row: Row = {
            "frames": self.frames,
            "episodes": self.episodes,
            "updates": self.updates,
            **{name: round(seconds, 2) for name, seconds in self.clock.state_dict().items()},
            **self._interval.summary(self.frames),
            **self.algorithm.figures(),
        }
        warn_of_clipping(row, self.algorithm.learners)
        self._unattained.warn(self.frames / self.total_frames)
        for monitor in self._reporting:
            row |= monitor.metrics()
        best = False
        if evaluation:
            self._stop.check()
            result = self.evaluate()
            row |= {
                f"greedy/{name.removesuffix('_mean').removesuffix('_rate')}": value for name, value in result.items()
            }
            if (ceiling := self.ceiling()) is not None:
                row["greedy/ceiling"] = ceiling
            best = self.frames > 0 and result["return_mean"] > self.best_return  # before training nothing is saved
        with self._saving.in_parts():
            if best:
                self.best_return = result["return_mean"]
            self.logger.log(row)
            self._interval = LogInterval(self.frames)  # only now: what it counted is on the disk
            for monitor in self._reporting:
                monitor.clear()
        return best

    def save(self, *, score: float | None = None) -> None:
        """Writes a checkpoint, unless nothing happened since the last one (:meth:`Saving.save`)."""
        self.episodes += self._interval.add_episodes(self._incoming.settle())
        self._saving.save(self.frames, score=score)

    def resume(self, path: Path) -> None:
        """Restores everything from a checkpoint; :meth:`train` then goes on from there, and later ones are removed.

        Raises:
            CheckpointError: as :meth:`Saving.load`.
        """
        assert self.checkpoints is not None
        device = next(self.algorithm.policy.parameters()).device
        rules = rules_of(self.collector.env) if hasattr(self.collector, "env") else {}  # others are made elsewhere
        missing = self._saving.load(path, device=device, rules=rules)
        self.checkpoints.go_back_to(self.frames)
        self.collector.update_policy_weights_()
        if missing and not any(len(learner.buffer) for learner in self.algorithm.learners.values()):
            self.logger.say(
                f"{path.name} holds no replay memory: it begins empty and is warmed up again, so that the training "
                "goes on, but not bit for bit as it would have"
            )

    @property
    def _place(self) -> tuple[int, int, int | None]:
        return self.frames, self.updates, self._completed

    def _parts(self) -> dict[str, Any]:
        return {
            "collector": self.collector,
            **components_of(self.algorithm),
            "logger": self.logger,
            "random": RandomState(),
            "trainer": self,
        }

    def state_dict(self) -> dict[str, Any]:
        """Its own counters; the parts have theirs."""
        self.episodes += self._interval.add_episodes(self._incoming.settle())
        return {
            "frames": self.frames,
            "episodes": self.episodes,
            "best_return": self.best_return,
            "completed": self._completed,
            **self.clock.state_dict(),
            "tracker": self._tracker.state_dict(),
            "window": self._interval.state_dict(),
            "unattained": self._unattained.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned.

        Raises:
            ValueError: if it is not the state of a trainer.
        """
        check_counters(state)
        self.frames, self.episodes, self.best_return = state["frames"], state["episodes"], state["best_return"]
        self._completed = state["completed"]
        self.clock.load_state_dict(state)
        self._tracker.load_state_dict(state["tracker"])
        self._interval.load_state_dict(state["window"])
        if "unattained" in state:  # earlier checkpoints have none
            self._unattained.load_state_dict(state["unattained"])
