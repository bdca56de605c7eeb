"""Sums of rows of a table are dense layers on one-hot codes."""

import pytest
import torch
from torch.nn.functional import one_hot

from hdrqn_torchrl.modules import CodeFeatures
from hdrqn_torchrl.modules.code_features import sum_of_rows

SIZES = (3, 5, 2)


def codes_of(*batch, sizes=SIZES):
    torch.manual_seed(0)
    return torch.stack([torch.randint(size, batch) for size in sizes], -1).to(torch.uint8)


def one_hots(codes, sizes=SIZES):
    return torch.cat([one_hot(codes[..., place].long(), size) for place, size in enumerate(sizes)], -1).float()


def test_the_first_layer_is_a_dense_layer_on_one_hot_codes():
    features, codes = CodeFeatures(SIZES, (6, 4)), codes_of(2, 7)
    first = torch.relu(one_hots(codes) @ features.table * features.scale + features.bias)
    assert features(codes).shape == (2, 7, 4) and features.out_features == 4
    torch.testing.assert_close(features(codes), features.dense(first))


def test_gradients_are_those_of_a_dense_layer_even_of_rows_that_are_not_used():
    torch.manual_seed(0)
    table = torch.randn(10, 4, dtype=torch.float64, requires_grad=True)
    rows = torch.tensor([[0, 3, 3], [9, 3, 0], [5, 5, 5], [1, 0, 9]], dtype=torch.int32)
    assert torch.autograd.gradcheck(lambda weights: sum_of_rows(weights, rows), table)
    codes, features = codes_of(50), CodeFeatures(SIZES, (6,))
    output = torch.randn(50, 6)
    (features(codes) * output).sum().backward()
    found = features.table.grad.clone()
    features.table.grad = None
    first = torch.relu(one_hots(codes) @ features.table * features.scale + features.bias)
    (first * output).sum().backward()
    torch.testing.assert_close(found, features.table.grad)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3), (2, 2, 2)], ids=str)
@pytest.mark.parametrize("leading", [(), (4,), (2, 4)], ids=str)
def test_observations_of_any_shape_and_any_leading_dimensions(shape, leading):
    torch.manual_seed(0)
    entries = torch.Size(shape).numel()
    features = CodeFeatures((5,) * entries, (6,), num_dims=len(shape))
    codes = torch.randint(5, (*leading, *shape))
    assert features(codes).shape == (*leading, 6)
    first = (0,) * len(leading)
    torch.testing.assert_close(features(codes)[first], features(codes[first]))


def test_autocast_changes_only_the_later_layers():
    features, codes = CodeFeatures(SIZES, (16, 4)), codes_of(8)
    with torch.autocast("cpu", torch.bfloat16):
        lower = features(codes)
        lower.float().sum().backward()
    assert lower.dtype == torch.bfloat16 and features.table.grad.dtype == torch.float32
    torch.testing.assert_close(lower.float(), features(codes), atol=0.02, rtol=0.02)


def test_features_can_be_compiled_as_a_whole():
    features, codes = CodeFeatures(SIZES, (6,)), codes_of(8)
    compiled = torch.compile(features, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(codes), features(codes))


@pytest.mark.parametrize("entries", [4, 25, 150])
def test_features_begin_as_spread_out_for_any_number_of_entries(entries):
    torch.manual_seed(0)
    features = CodeFeatures((10,) * entries, (256,))
    sums = one_hots(codes_of(64, sizes=(10,) * entries), (10,) * entries) @ features.table * features.scale
    assert sums.std().item() == pytest.approx((1 / 30) ** 0.5, rel=0.2)


@pytest.mark.parametrize("entries", [4, 25, 150])
def test_one_learning_rate_serves_short_and_long_vectors(entries):
    """The target depends on one entry, the others are noise."""
    torch.manual_seed(0)
    sizes = (10,) * entries
    network = torch.nn.Sequential(CodeFeatures(sizes, (64,)), torch.nn.Linear(64, 1))
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    errors = []
    for _ in range(200):
        codes = torch.randint(10, (64, entries))
        loss = (network(codes).squeeze(-1) - (codes[:, 0] < 5).float()).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(loss.item())
    assert sum(errors[-20:]) / 20 < 0.05
