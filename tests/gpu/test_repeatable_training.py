"""Numbers that a GPU repeats: ``make test-gpu``. Skipped without one, and not yet run on one."""

import os

import pytest
import torch
from captured_trainings import train_whole_and_cut
from helpers import check_same

from hdrqn_torchrl.devices import WORKSPACE, set_deterministic
from hdrqn_torchrl.runs.collectors.captured import CudaRecording

os.environ.setdefault(WORKSPACE, ":16:8")  # before any test uses the GPU
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.fixture
def deterministic():
    set_deterministic(True, "cuda")
    yield
    set_deterministic(False, "cuda")


@pytest.mark.parametrize("name", ["dqn", "drqn", "hdqn", "v1", "v2", "v3"])
def test_a_stopped_and_resumed_training_equals_an_uninterrupted_one(name, deterministic, tmp_path):
    train_whole_and_cut(tmp_path, name, recording=CudaRecording, device="cuda")
    check_same(tmp_path / "cut", tmp_path / "whole")
