"""What makes a training on a GPU repeat its numbers, as far as a CPU can tell."""

import os
import re
from functools import partial

import pytest
import torch
from captured_trainings import captured_training, train_whole_and_cut
from helpers import check_same
from tape import Tape
from torch.utils._python_dispatch import TorchDispatchMode

from hdrqn_torchrl.devices import WORKSPACE, set_deterministic
from hdrqn_torchrl.learning import learner as learner_module
from hdrqn_torchrl.learning.captured import Captured
from hdrqn_torchrl.runs.persistence.checkpoint import RandomState

NAMES = ("drqn", "v2", "v3")


@pytest.fixture
def capturing(monkeypatch, as_on_gpu):
    """Learners capture their updates, on a CPU."""
    monkeypatch.setattr(learner_module, "wants_capture", lambda *_: True)
    monkeypatch.setattr(learner_module, "Captured", partial(Captured, recording=Tape, warm_ups=2))


@pytest.fixture
def reset(monkeypatch):
    """What is set for the process is taken back."""
    monkeypatch.delenv(WORKSPACE, raising=False)
    yield
    torch.use_deterministic_algorithms(False)
    torch.backends.cudnn.deterministic = False


class TestSetting:
    def test_a_gpu_is_told_and_untold(self, reset):
        set_deterministic(True, "cuda")
        assert torch.are_deterministic_algorithms_enabled() and torch.backends.cudnn.deterministic
        assert os.environ[WORKSPACE] == ":16:8"
        set_deterministic(False, "cuda")
        assert not torch.are_deterministic_algorithms_enabled() and not torch.backends.cudnn.deterministic

    def test_a_workspace_that_repeats_sums_is_kept(self, reset, monkeypatch):
        monkeypatch.setenv(WORKSPACE, ":4096:8")
        set_deterministic(True, "cuda")
        assert os.environ[WORKSPACE] == ":4096:8"

    def test_another_workspace_is_refused(self, reset, monkeypatch):
        monkeypatch.setenv(WORKSPACE, ":0:0")
        with pytest.raises(ValueError, match=f"{WORKSPACE} must be :16:8 or :4096:8 .*, got ':0:0'; set it before"):
            set_deterministic(True, "cuda")

    def test_it_is_too_late_once_the_gpu_is_in_use(self, reset, monkeypatch):
        monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
        with pytest.raises(ValueError, match="got nothing, and the GPU is in use, so that it is too late"):
            set_deterministic(True, "cuda")
        set_deterministic(False, "cuda")

    def test_nothing_is_changed_on_a_cpu(self, reset):
        set_deterministic(True, "cpu")
        assert not torch.are_deterministic_algorithms_enabled() and WORKSPACE not in os.environ


@pytest.mark.parametrize("name", NAMES)
def test_a_captured_training_that_is_stopped_and_resumed_equals_an_uninterrupted_one(name, capturing, tmp_path):
    train_whole_and_cut(tmp_path, name, recording=Tape)
    check_same(tmp_path / "cut", tmp_path / "whole")


class TestRandomState:
    """The numbers of GPUs, seen from a CPU."""

    def test_states_of_more_gpus_than_there_are_are_left_out(self, monkeypatch):
        restored = []
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
        monkeypatch.setattr(torch.cuda, "set_rng_state_all", restored.extend)
        states = [torch.arange(16, dtype=torch.uint8), torch.zeros(16, dtype=torch.uint8)]
        RandomState().load_state_dict(RandomState().state_dict() | {"torch_cuda": states})
        assert len(restored) == 1 and torch.equal(restored[0], states[0])

    def test_a_training_of_a_gpu_can_go_on_without_one(self, monkeypatch):
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
        expected = RandomState().state_dict()
        torch.rand(3)
        RandomState().load_state_dict(expected | {"torch_cuda": [torch.zeros(16, dtype=torch.uint8)]})
        assert torch.equal(torch.get_rng_state(), expected["torch_cpu"])


class Operations(TorchDispatchMode):
    """Collects the names of all operations."""

    def __init__(self):
        super().__init__()
        self.found = set()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.overloadpacket.__name__
        self.found.add(f"{name}_of_floats" if name == "cumsum" and args[0].is_floating_point() else name)
        return function(*args, **(kwargs or {}))


REFUSED = re.compile(
    r"(adaptive_|fractional_max|max_unpool|nll_loss|_?ctc_loss|_?embedding_bag|grid_sampler).*"
    r"|(avg_pool3d|.*(linear|cubic)[12]?d?|reflection_pad\dd)_backward|put_?|histc|median|cumsum_of_floats"
)
"""Operations that torch refuses on a GPU if they shall repeat their numbers."""


@pytest.mark.parametrize("name", ["v2", "v3"])
def test_no_operation_of_a_training_is_refused_where_numbers_must_repeat(name, as_on_gpu, monkeypatch, tmp_path):
    monkeypatch.setattr(learner_module, "wants_capture", lambda *_: True)  # so that draws are those of a GPU
    monkeypatch.setattr(learner_module, "Captured", partial(Captured, recording=Tape, warm_ups=10**9))
    trainer = captured_training(tmp_path, name, recording=Tape)
    with Operations() as operations:
        trainer.train()
    refused = {each for each in operations.found if REFUSED.fullmatch(each)}
    assert refused == set() and {"addmm", "_fused_adam_", "searchsorted"} <= operations.found
