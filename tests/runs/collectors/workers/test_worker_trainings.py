"""Whole trainings with workers in environments that are stepped outside torch: MiniGrid and Montezuma's Revenge."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from importlib.util import find_spec

import pytest
from programs import ROOT

SHORT = [
    "device=cpu", "env.num_envs=8", "total_frames=3000", "log_frames=1000", "evaluation.num_envs=4",
    "evaluation.episodes=4", "evaluation.final_episodes=4", "evaluation.interval_frames=100_000", "logger=csv",
    "evaluation.ceilings=false", "collector.workers=2", "collector.sync=false", "hydra.run.dir=run",
]  # fmt: skip
LEARNER = ("warmup_frames=500", "frames_per_update=64", "batch_size=4")
STEPS = ["env.max_steps=100", "evaluation.max_steps=100"]
MINIGRID = ["env=minigrid", "algo=v3", *STEPS, *(f"algo.learner.{each}" for each in LEARNER)]
MONTEZUMA = ["env=montezuma", "algo=v2", *STEPS, *(f"algo.sub.{each}" for each in LEARNER)]


def needs(*modules):
    return pytest.mark.skipif(any(find_spec(name) is None for name in modules), reason=f"needs {modules}")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["processes", pytest.param("ray", marks=needs("ray"))])
@pytest.mark.parametrize(
    "settings",
    [pytest.param(MINIGRID, marks=needs("minigrid")), pytest.param(MONTEZUMA, marks=needs("ale_py"))],
    ids=["minigrid", "montezuma"],
)
def test_it_trains_to_its_end_and_goes_on_where_it_was(tmp_path, settings, kind):
    def train(*more):
        command = [sys.executable, str(ROOT / "train.py"), *settings, f"collector={kind}", *SHORT, *more]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900)
        assert done.returncode == 0, done.stderr
        assert "Traceback" not in done.stderr, done.stderr
        return list(csv.DictReader((tmp_path / "run/metrics.csv").read_text().splitlines()))

    rows = train()
    assert int(rows[-1]["frames"]) == 3008 and int(rows[-1]["updates"]) > 20
    assert {float(row["collector/lost_workers"]) for row in rows} == {0.0}
    assert max(float(row["collector/weights_age_max"]) for row in rows) > 0
    rows = train("resume=auto", "total_frames=4000")
    assert [int(row["frames"]) for row in rows] == sorted({int(row["frames"]) for row in rows})
    assert json.loads((tmp_path / "run/summary.json").read_text())["frames"] >= 4000
