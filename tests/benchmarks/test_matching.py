"""Precision and recall of found subgoals."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch

sys.path.append(str(Path(__file__).parents[2] / "benchmarks" / "discovery"))
from matching import first_times, matches, show


def steps(*columns):
    """``[1, T, G]`` of a 0/1 string for each subgoal."""
    return torch.tensor([[int(flag) for flag in column] for column in columns]).bool().T.unsqueeze(0)


def test_first_times_are_those_of_each_episode():
    done = steps("0010000")[..., 0]
    assert first_times(steps("0110101"), done)[0, :, 0].tolist() == [False, True, False, False, True, False, False]
    assert first_times(steps("1000000"), done).sum() == 1


def test_each_true_subgoal_has_the_found_one_that_matches_it_best():
    true = steps("10010", "00000", "01000")
    found = steps("00000", "10010", "01010")
    matched, told = matches(true, found, torch.zeros(1, 5).bool(), names=("a", "b", "c"), events=("explore", "x", "y"))
    assert [(each.subgoal, each.event, each.precision, each.recall) for each in matched] == [
        ("a", "x", 1.0, 1.0), ("b", "none", 0.0, 0.0), ("c", "y", 1.0, 1.0)
    ]  # fmt: skip
    assert [(each.event, each.times, each.first, each.true) for each in told] == [("x", 2, 1, 1.0), ("y", 2, 1, 1.0)]


def test_what_was_found_in_other_steps_too_is_less_precise():
    (match,), _ = matches(
        steps("0100000100"),
        steps("0101000001"),
        steps("0010010000")[..., 0],
        names=("goal",),
        events=("event",),
    )
    assert (match.times, match.precision, match.recall) == (2, pytest.approx(0.333), 0.5)


def test_all_of_it_is_one_json_object_in_the_last_line(capsys):
    show(*matches(steps("10"), steps("10"), torch.zeros(1, 2).bool(), names=("a",), events=("x",)), task="room")
    read = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert read["task"] == "room" and read["matches"][0]["recall"] == 1.0 and read["found"][0]["slot"] == 0
