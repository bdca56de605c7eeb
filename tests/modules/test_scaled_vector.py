"""Vectors whose entries have bounds, on one scale."""

from __future__ import annotations

import torch
from torchrl.data import Bounded, Unbounded

from hdrqn_torchrl.modules import compact_network
from hdrqn_torchrl.modules.architectures import observation_predictor
from hdrqn_torchrl.modules.scaled_vector import ScaledVector


def bounded(low, high):
    low, high = torch.tensor(low), torch.tensor(high)
    return Bounded(low.expand(3, -1), high.expand(3, -1), shape=(3, len(low)))


def test_bounds_become_minus_one_and_one():
    scaled = ScaledVector(bounded([0.0, -0.4], [4.0, 0.4]))
    assert torch.equal(scaled(torch.tensor([[0.0, -0.4], [4.0, 0.4]])), torch.tensor([[-1.0, -1.0], [1.0, 1.0]]))


def test_entries_without_real_bounds_stay_as_they_are():
    vector = torch.tensor([[3.0, -5.0, 2.0]])
    largest = torch.finfo(torch.float32).max
    assert torch.equal(ScaledVector(bounded([-torch.inf, -largest, 2.0], [torch.inf, largest, 2.0]))(vector), vector)
    assert torch.equal(ScaledVector(Unbounded(shape=(2, 3)))(vector), vector)


def test_a_network_reads_equal_shares_of_the_bounds_alike():
    narrow, wide = bounded([-0.1], [0.1]), bounded([-10.0], [10.0])
    torch.manual_seed(0)
    first = compact_network().features(narrow)
    torch.manual_seed(0)
    second = compact_network().features(wide)
    assert torch.allclose(first(torch.tensor([[0.05]])), second(torch.tensor([[5.0]])))


def test_predictions_are_of_scaled_vectors():
    torch.manual_seed(0)
    decoder = observation_predictor(bounded([-0.1], [0.1]), 8, 2, 1).decoder
    torch.manual_seed(0)
    other = observation_predictor(bounded([-10.0], [10.0]), 8, 2, 1).decoder
    vector = torch.randn(4, 128)
    found = decoder.error(vector, torch.full((4, 1), 0.1)), other.error(vector, torch.full((4, 1), 10.0))
    assert torch.allclose(*found)
