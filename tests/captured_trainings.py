"""Trainings whose updates and acting are captured: on a GPU, or by the stand-in for its graphs on a CPU."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from helpers import make_training, seed_everything, small_env

from hdrqn_torchrl.runs.collectors.captured import CapturedCollector
from hdrqn_torchrl.runs.interruption import Interrupted
from hdrqn_torchrl.runs.trainer import Trainer


def captured_training(
    folder: Path, name: str, *, recording: Callable[..., Any], device: str = "cpu", seed: int = 0
) -> Trainer:
    """A training as :func:`helpers.make_training` makes it, with a collector that captures.

    Args:
        folder: run folder.
        name: the algorithm.
        recording: makes recordings of acting; those of updates are the learners' business.
        device: of worlds and networks.
        seed: of networks and worlds.
    """
    worlds = partial(small_env, max_steps=5, obstacle="teleport", device=device)
    trainer = make_training(folder, name, seed=seed, worlds=worlds)
    collector = trainer.collector
    trainer.collector = CapturedCollector(
        collector.env, trainer.algorithm.policy, frames_per_batch=32, total_frames=256, recording=recording
    )
    for learner in trainer.algorithm.learners.values():
        learner.guard.at_once = False
    return trainer


def stop_at(trainer: Trainer, frames: int, updates: int) -> None:
    """Asks a training to stop at the ``updates``-th update of the iteration that ends at ``frames``."""
    left, update = updates, next(iter(trainer.algorithm.learners.values())).update

    def stopping(sample):
        nonlocal left
        left -= trainer.frames == frames
        if left == 0 and trainer.frames == frames:
            trainer._stop._requested = 15
        return update(sample)

    next(iter(trainer.algorithm.learners.values())).update = stopping


def train_whole_and_cut(folder: Path, name: str, *, recording: Callable[..., Any], device: str = "cpu") -> None:
    """Trains in ``folder/whole``, and in ``folder/cut`` with two stops in mid-iteration once all is recorded."""
    make = partial(captured_training, name=name, recording=recording, device=device)
    seed_everything(0)
    make(folder / "whole").train()
    seed_everything(0)
    trainer = make(folder / "cut")
    for frames in (160, 224):  # recorded by then
        stop_at(trainer, frames, updates=2)
        with pytest.raises(Interrupted):
            trainer.train()
        seed_everything(99)
        trainer = make(folder / "cut", seed=99)
        trainer.resume(trainer.checkpoints.newest())
        assert trainer.frames == frames and next(iter(trainer.algorithm.learners.values())).updates_due()
    trainer.train()
