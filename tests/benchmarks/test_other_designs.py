"""The parts of the comparison of ways to tell events."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from torch.nn.functional import one_hot

sys.path.append(str(Path(__file__).parents[2] / "benchmarks" / "discovery"))
import other_designs
from clusters import k_means, scored
from predictor import Predictor, errors


def test_clusters_are_the_points_that_lie_together():
    torch.manual_seed(0)
    centers = torch.tensor([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]])
    label = k_means(centers.repeat(20, 1) + torch.rand(60, 2), 3)
    assert sorted(label[:3].tolist()) == [0, 1, 2] and torch.equal(label, label[:3].repeat(20))


def test_the_best_cluster_of_each_goal_counts():
    true = torch.tensor([[1, 0], [0, 0], [0, 1], [0, 1], [0, 0]]).bool()
    rows = torch.tensor([0, 1, 2])
    assert scored(true, rows, one_hot(torch.tensor([0, 0, 1]))) == "0.75 / 0.75"


def test_episodes_keep_their_steps():
    played = other_designs.play(640, seed=0)
    assert played.real.sum() == 640 and played.views.shape[1:] == (16, 9, 5)
    moved = (played.views != played.after).any(-1).any(-1)
    assert torch.equal(played.changes.any(-1), moved & played.real)
    following = played.real[:, 1:]
    assert torch.equal(played.after[:, :-1][following], played.views[:, 1:][following])


def test_a_predictor_learns_what_follows(capsys):
    torch.manual_seed(0)
    predictor, played = Predictor(9, 5, 4), other_designs.play(640, seed=0)
    other_designs.train(predictor, played, updates=20)
    first, *_, last = (float(line.split()[3]) for line in capsys.readouterr().out.splitlines())
    assert last < 0.8 * first
    logits = torch.full((1, 1, 9, 5), 0.0)
    assert errors(logits, played.after[:1, :1]).item() == pytest.approx(9 * 1.609, rel=1e-3)
