"""Tensors on their way to a GPU, seen from a CPU."""

import pytest
import torch
from tensordict import TensorDict

from hdrqn_torchrl.devices import to_device
from hdrqn_torchrl.envs.gym import environment as gym_module


@pytest.fixture
def sent(monkeypatch):
    """What is copied, and how; the copies stay on the CPU."""
    calls, pinned = [], set()

    def pin(tensor):
        copy = tensor.clone()
        pinned.add(copy.data_ptr())
        return copy

    def to(tensor, device, non_blocking=False):
        calls.append((str(device), tensor.data_ptr() in pinned, non_blocking))
        return tensor.clone()

    monkeypatch.setattr(torch.Tensor, "pin_memory", pin)
    monkeypatch.setattr(torch.Tensor, "to", to)
    monkeypatch.setattr(torch.cuda, "synchronize", None)
    return calls


def test_a_batch_is_copied_from_pinned_memory_and_nobody_waits(sent):
    batch = TensorDict({"x": torch.arange(6.0).view(2, 3), "next": {"done": torch.ones(2, 3, 1).bool()}}, [2, 3])
    values = [to_device(value, torch.device("cuda")) for value in batch.values(True, True)]
    assert sent == [("cuda", True, True)] * 2
    assert all(torch.equal(*pair) for pair in zip(values, batch.values(True, True), strict=True))


def test_on_a_cpu_nothing_is_copied(sent):
    tensor = torch.ones(2)
    assert to_device(tensor, None) is tensor
    to_device(tensor, torch.device("cpu"))
    assert sent == [("cpu", False, False)]


def test_worlds_outside_send_what_they_show_that_way(monkeypatch):
    pytest.importorskip("gymnasium")
    from hdrqn_torchrl.envs import make_gym

    seen = []
    monkeypatch.setattr(gym_module, "to_device", lambda tensor, device: seen.append(device) or tensor)
    env = make_gym("CartPole-v1", num_envs=2)
    seen.clear()
    env.reset()
    assert seen and set(seen) == {env.device}
