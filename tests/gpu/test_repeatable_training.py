"""Numbers that a GPU repeats: ``make test-gpu``. Skipped without one, and not yet run on one."""

import os
from functools import partial

import pytest
import torch
from captured_trainings import captured_training, stop_at
from helpers import check_same, seed_everything

from hdrqn_torchrl.devices import WORKSPACE, set_deterministic
from hdrqn_torchrl.runs.captured_collector import CudaRecording
from hdrqn_torchrl.runs.interruption import Interrupted

os.environ.setdefault(WORKSPACE, ":16:8")  # before any test uses the GPU
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.fixture
def deterministic():
    set_deterministic(True, "cuda")
    yield
    set_deterministic(False, "cuda")


@pytest.mark.parametrize("name", ["dqn", "drqn", "hdqn", "v1", "v2", "v3"])
def test_a_stopped_and_resumed_training_equals_an_uninterrupted_one(name, deterministic, tmp_path):
    make = partial(captured_training, name=name, recording=CudaRecording, device="cuda")
    seed_everything(0)
    make(tmp_path / "whole").train()
    seed_everything(0)
    trainer = make(tmp_path / "cut")
    for frames in (160, 224):  # recorded by then
        stop_at(trainer, frames, updates=2)
        with pytest.raises(Interrupted):
            trainer.train()
        seed_everything(99)
        trainer = make(tmp_path / "cut", seed=99)
        trainer.resume(trainer.checkpoints.newest())
    trainer.train()
    check_same(tmp_path / "cut", tmp_path / "whole")
