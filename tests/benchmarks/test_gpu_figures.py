"""The figures of benchmarks/gpu.py, dry: on a CPU, with few calls and small learners."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import gpu


@pytest.fixture
def dry(monkeypatch):
    """Neither learns nor trains."""
    monkeypatch.setattr(gpu, "seconds_per_call", lambda work, calls, before=20: 0.5 / calls)
    monkeypatch.setattr(gpu, "v3_learner", lambda *_: type("Learner", (), {"learn": None}))
    monkeypatch.setattr(gpu, "paper_learner", gpu.v3_learner)
    monkeypatch.setattr(gpu, "acting_speed", lambda *_: 5e6)
    monkeypatch.setattr(gpu, "iteration_speed", lambda *_: 7e5)
    monkeypatch.setattr(gpu, "deterministic_update", lambda *_, quick: 2.5)
    seen = []

    def train(frames, device, settings=()):
        seen.append((frames, settings))
        return {"return_mean": 1.96, "wall_seconds": 90.0, "updates": 1, "frames": frames}

    monkeypatch.setattr(gpu, "train", train)
    return seen


def test_the_table_has_all_goals_and_what_was_measured_for_each(dry):
    found = json.loads(json.dumps(gpu.measure("cpu", quick=False, training=True, paper=True, worlds=True)))
    rows = found["table"]
    assert {name: row["goal"] for name, row in rows.items()} == {
        "v3 update, ms": 2.0,
        "sub-level update, paper's network, ms": 2.0,
        "policy and environment, 4,096 worlds, steps/s": 4e6,
        "v3, 600,000 frames, seconds": 120.0,
        "v3, 600,000 frames, return": 1.95,
        "paper's comparison, minutes": 30.0,
        "v3 update with deterministic=true, ms": None,
    }
    assert [row["measured"] for row in rows.values()] == pytest.approx([1.667, 1.667, 5e6, 90, 1.96, 27, 2.5], rel=1e-3)
    assert dry == [(600_000, ()), (1_000_000, ("algo=v2", "network=paper"))]
    assert found["v3, 4096 worlds, 8 steps, minibatches x16, frames/s"] == 700_000


def test_what_was_not_measured_is_left_empty(dry):
    rows = gpu.measure("cpu", quick=True, training=False)["table"]
    assert rows["v3, 600,000 frames, seconds"]["measured"] is None
    assert rows["v3 update, ms"]["measured"] is not None and dry == []


@pytest.mark.slow
def test_all_of_it_runs_on_a_cpu():
    found = gpu.measure("cpu", quick=True, training=True, paper=True, worlds=True)
    assert found["paper, gridworld"]["runs"] == 18 and found["v3 update, deterministic, ms"] > 0
    assert found["table"]["v3, 600,000 frames, return"]["measured"] is not None
