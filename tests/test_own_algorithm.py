"""A user's algorithm takes a builder and a file of settings, and trains like those of the package."""

from __future__ import annotations

import json

import pytest
import torch
from helpers import small_env
from processes import ROOT, run_script
from programs import TINY, TINY_HDRQN

from examples.own_algorithm.soft_v2 import SoftEpsilonGreedy, make_soft_v2
from hdrqn_torchrl.modules import compact_network

TARGET = "examples.own_algorithm.soft_v2.make_soft_v2"


def test_a_users_algorithm_trains_from_the_command_line(tmp_path):
    command = ["--config-dir", str(ROOT / "examples/own_algorithm"), "algo=soft_v2", "logger=csv", *TINY, *TINY_HDRQN]
    command += [f"allowed_targets=[{TARGET}]", "algo.temperature=0.25", "hydra.run.dir=run"]
    code, _, told = run_script(tmp_path, *command)
    assert code == 0, told
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert summary["frames"] >= 2_000 and summary["updates"] > 0
    assert "temperature: 0.25" in (tmp_path / "run/config.yaml").read_text()


def test_random_choices_prefer_higher_values():
    torch.manual_seed(0)
    values = torch.tensor([0.0, 1.0, -torch.inf]).expand(4_000, 3)
    chosen = SoftEpsilonGreedy(0.5, anneal_frames=1).random_choice(values, values.isfinite())
    counts = chosen.bincount(minlength=3)
    assert counts[2] == 0
    assert (counts[1] / counts[0]).item() == pytest.approx(torch.tensor(1.0 / 0.5).exp().item(), rel=0.15)


def test_both_levels_of_the_users_algorithm_explore_softly():
    agent = make_soft_v2(small_env(2), compact_network(8, (8,)), temperature=0.25)
    assert [(each.temperature, each.anneal_frames) for each in agent.explorations.values()] == [
        (0.25, 100_000),
        (0.25, 200_000),
    ]
    with pytest.raises(ValueError, match="temperature must be > 0, got 0"):
        make_soft_v2(small_env(2), compact_network(8, (8,)), temperature=0)
