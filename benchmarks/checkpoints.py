"""The cost of a checkpoint with full replay memories: seconds, megabytes and extra memory, next to training itself.

python benchmarks/checkpoints.py [--algo v2] [--saves 5]
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from pathlib import Path

import torch

from hdrqn_torchrl.algorithms import make_drqn, make_hdrqn, make_v3
from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.runs.collectors.resumable import ResumableCollector
from hdrqn_torchrl.runs.logging import RunLogger
from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints
from hdrqn_torchrl.runs.trainer import Trainer

INTERVAL_FRAMES = 50_000  # of conf/config.yaml
BUILDERS = {
    "drqn": lambda env: make_drqn(env, compact_network()),
    "v2": lambda env: make_hdrqn(env, compact_network()),
    "v3": lambda env: make_v3(env, compact_network()),
}


class MemoryWatch:
    """Largest increase of this process's resident memory inside the block, in bytes."""

    def __enter__(self) -> MemoryWatch:
        self._before, self.extra, self._on = resident(), 0, True
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def _watch(self) -> None:
        while self._on:
            self.extra = max(self.extra, resident() - self._before)
            time.sleep(0.001)

    def __exit__(self, *_: object) -> None:
        self._on = False
        self._thread.join()


def resident() -> int:
    """Resident memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def main() -> None:
    """Fills the memories, trains for a while and saves several times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--algo", choices=BUILDERS, default="v2")
    parser.add_argument("--saves", type=int, default=5)
    options = parser.parse_args()
    torch.set_num_threads(1)
    env = MultiGoalGridEnv(64, seed=0)
    algorithm = BUILDERS[options.algo](env)
    collector = ResumableCollector(
        algorithm.transform(env), algorithm.policy, frames_per_batch=512, auto_register_policy_transforms=False
    )
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(
            algorithm,
            collector,
            logger=RunLogger(Path(folder), total_frames=1),
            evaluate=lambda: {"return_mean": 0.0, "success_rate": 0.0},
            total_frames=10**9,
            log_frames=10**9,
            evaluation_frames=10**9,
            checkpoints=Checkpoints(Path(folder) / "checkpoints"),
            checkpoint_frames=10**9,
        )
        batches = iter(collector)
        fill(trainer, batches)
        started, first = time.perf_counter(), trainer.frames
        for _ in range(40):
            trainer.step(next(batches))
        speed = (trainer.frames - first) / (time.perf_counter() - started)
        for _ in range(options.saves):
            trainer.step(next(batches))
            report(trainer, Path(folder), speed)


def fill(trainer: Trainer, batches) -> None:  # noqa: ANN001
    """Collects until every replay memory is full; updates come later."""
    learners = trainer.algorithm.learners.values()
    while any(len(learner.buffer) < learner.settings.capacity // 64 * 64 for learner in learners):
        batch = next(batches)
        for learner in learners:
            learner.store(batch)
    for learner in learners:
        learner.schedule.updates = learner.updates_due()


def report(trainer: Trainer, folder: Path, speed: float) -> None:
    """Saves once and prints the cost."""
    started = time.perf_counter()
    with MemoryWatch() as memory:
        trainer.save()
    seconds = time.perf_counter() - started
    newest = max((folder / "checkpoints").glob("checkpoint-*"))
    size = sum(path.stat().st_size for path in newest.rglob("*") if path.is_file())
    print(
        f"saved in {seconds:.3f} s, {size / 1e6:.1f} MB, {memory.extra / 1e6:.1f} MB of extra memory; "
        f"at {speed:,.0f} frames/s one every {INTERVAL_FRAMES:,} frames is {seconds * speed / INTERVAL_FRAMES:.2%}"
    )


if __name__ == "__main__":
    main()
