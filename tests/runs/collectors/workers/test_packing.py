"""What goes between processes arrives as it was, and as a copy."""

from __future__ import annotations

import pickle

import pytest
import torch
from tensordict import TensorDict

from hdrqn_torchrl.runs.collectors.workers.packing import pack, unpack


@pytest.mark.parametrize(
    "tensor",
    [
        torch.arange(6.0).reshape(2, 3).t(),
        torch.tensor(3),
        torch.zeros(0, 3, dtype=torch.uint8),
        torch.tensor([True, False]),
        torch.ones(3, dtype=torch.bfloat16),
        torch.ones(1, 4).expand(5, 4),
        torch.ones(2, requires_grad=True),
    ],
    ids=["transposed", "number", "empty", "flags", "bfloat16", "expanded", "parameter"],
)
def test_a_tensor_arrives_as_it_was(tensor):
    found = unpack(pack({"x": tensor}))["x"]
    assert found.dtype == tensor.dtype and found.shape == tensor.shape and torch.equal(found, tensor)
    assert found.requires_grad == tensor.requires_grad


def test_what_arrives_is_a_copy_that_can_be_changed():
    batch = TensorDict({"a": torch.zeros(2, 3), "next": {"b": torch.ones(2, 3)}}, [2, 3])
    found = unpack(pack(batch))
    found["a"].fill_(7)
    assert found.batch_size == batch.batch_size and (found["next"] == batch["next"]).all()
    assert (batch["a"] == 0).all() and not found["a"].is_shared()


def test_a_slice_does_not_bring_along_the_whole():
    assert len(pack(torch.zeros(1_000_000)[:10])) < 1_000 < len(pickle.dumps(torch.zeros(1_000_000)[:10]))
