"""The twins in plain PyTorch, against which speed is measured, still give the same results."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import collection
import updates
import updates_v3


@pytest.mark.parametrize(("version", "level"), [("v2", "sub"), ("v2", "meta"), ("v1", "meta")])
def test_updates_of_the_paper_s_agents(version, level):
    learner = updates.filled(version, "compact", 12).learners[level]
    updates.check_equal(learner, updates.raw_twin(learner, level, version), level, version)


def test_updates_of_v3():
    learner = updates_v3.filled("fp32", 24)
    updates_v3.check_equal(learner, updates_v3.RawLearner(learner, "fp32"))


def test_collection():
    collection.check_equal(*collection.make("compact", 8, 0.5))
