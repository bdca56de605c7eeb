"""How many jobs of a sweep share a GPU, seen from a CPU."""

import os

import pytest
import torch
from omegaconf import OmegaConf

from hdrqn_torchrl.cli.sweeps import share_gpu


def jobs(monkeypatch, *, device="auto", launcher=None, gpu=True):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    monkeypatch.setattr(os, "cpu_count", lambda: 16)
    config = OmegaConf.create({"device": device, "hydra": {"launcher": launcher or {"n_jobs": -1}}})
    OmegaConf.set_readonly(config, True)
    share_gpu(config)
    return config.hydra.launcher.get("n_jobs")


def test_four_jobs_share_a_gpu_unless_told_otherwise(monkeypatch):
    assert jobs(monkeypatch) == jobs(monkeypatch, device="cuda") == 4
    assert jobs(monkeypatch, launcher={"n_jobs": 9}) == 9


@pytest.mark.parametrize("changes", [{"device": "cpu"}, {"gpu": False}])
def test_jobs_on_a_cpu_are_as_many_as_there_are_cores(changes, monkeypatch):
    assert jobs(monkeypatch, **changes) == -1


def test_other_launchers_are_left_alone(monkeypatch):
    assert jobs(monkeypatch, launcher={"_target_": "BasicLauncher"}) is None
