"""The model of collection by workers."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from scaling import Times, frames_per_second

ACTING = Times(act=1e-3, jitter=0.0, order=0.0, receive=0.0, latency=0.0, store=0.0)
SHAPE = {"worlds": 4, "steps": 8}


def test_one_worker_is_as_fast_as_it_acts():
    assert frames_per_second(ACTING, workers=1, cores=4, sync=True, **SHAPE) == pytest.approx(1000.0)


def test_workers_with_cores_of_their_own_add_up():
    assert frames_per_second(ACTING, workers=4, cores=8, sync=True, **SHAPE) == pytest.approx(4000.0)
    assert frames_per_second(ACTING, workers=4, cores=2, sync=True, **SHAPE) == pytest.approx(2000.0)


def test_learning_and_collecting_take_turns_or_overlap():
    learning = Times(**{**vars(ACTING), "update": 32e-3, "frames_per_update": 32})  # 1 ms for each frame, too
    assert frames_per_second(learning, workers=1, cores=4, sync=True, **SHAPE) == pytest.approx(500.0)
    assert frames_per_second(learning, workers=1, cores=4, sync=False, **SHAPE) == pytest.approx(1000.0, rel=0.02)


def test_updates_are_the_limit_in_the_end():
    learning = Times(**{**vars(ACTING), "update": 32e-3, "frames_per_update": 32})
    assert frames_per_second(learning, workers=64, cores=100, sync=False, **SHAPE) == pytest.approx(1000.0, rel=0.02)
