import pytest
import torch
from helpers import build, small_env
from torch import nn

from hdrqn_torchrl.checkpoint import load_weights, save_weights


def test_a_policy_comes_back_with_its_weights_and_schedules(tmp_path):
    torch.manual_seed(0)
    source, copy = build("v2", small_env(2)), build("v2", small_env(2))
    for level in source.explorations.values():
        level.step(12_345)
    save_weights(source.policy, tmp_path / "checkpoints" / "last.safetensors")
    load_weights(copy.policy, tmp_path / "checkpoints" / "last.safetensors")
    wanted, found = source.policy.state_dict(), copy.policy.state_dict()
    assert wanted.keys() == found.keys() and all((wanted[key] == found[key]).all() for key in wanted)
    assert copy.explorations["sub"].epsilon == source.explorations["sub"].epsilon < 1.0
    copy.explorations["sub"].step(1)
    assert copy.explorations["sub"].frames == 12_346


def test_loaded_weights_are_those_that_the_learners_train(tmp_path):
    source, copy = build("v2", small_env(2)), build("v2", small_env(2))
    save_weights(source.policy, tmp_path / "weights.safetensors")
    load_weights(copy.policy, tmp_path / "weights.safetensors")
    stored = copy.learners["sub"].loss.value_network_params["network", "head", "streams", "weight"]
    assert (stored == source.policy.sub_controller.network.head.streams.weight).all()


def test_saving_replaces_the_file_and_leaves_nothing_else(tmp_path):
    path, module = tmp_path / "weights.safetensors", nn.Linear(2, 2)
    save_weights(module, path)
    with torch.no_grad():
        module.weight.fill_(3.0)
    save_weights(module, path)
    other = nn.Linear(2, 2)
    load_weights(other, path)
    assert (other.weight == 3.0).all()
    assert [file.name for file in tmp_path.iterdir()] == ["weights.safetensors"]


def test_a_failed_save_keeps_the_file_before(tmp_path):
    path, module = tmp_path / "weights.safetensors", nn.Linear(2, 2)
    save_weights(module, path)
    before = path.read_bytes()

    class Broken(nn.Linear):
        def state_dict(self):
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        save_weights(Broken(2, 2), path)
    assert path.read_bytes() == before


class TestFilesThatDoNotFit:
    def test_other_sizes(self, tmp_path):
        save_weights(nn.Linear(2, 2), tmp_path / "weights.safetensors")
        with pytest.raises(ValueError, match=r"weights\.safetensors does not fit this policy; .*settings of its run"):
            load_weights(nn.Linear(3, 2), tmp_path / "weights.safetensors")

    def test_another_module(self, tmp_path):
        save_weights(nn.LSTM(2, 2), tmp_path / "weights.safetensors")
        with pytest.raises(ValueError, match="does not fit this policy"):
            load_weights(nn.Linear(2, 2), tmp_path / "weights.safetensors")

    @pytest.mark.parametrize("content", [b"", b"no weights at all", bytes(64)], ids=["empty", "text", "zeros"])
    def test_another_kind_of_file(self, tmp_path, content):
        path = tmp_path / "weights.safetensors"
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"weights\.safetensors must be a safetensors file, got .*; "):
            load_weights(nn.Linear(2, 2), path)

    def test_a_missing_file(self, tmp_path):
        with pytest.raises(ValueError, match=r"path must name a weights file, got .*nothing\.safetensors; "):
            load_weights(nn.Linear(2, 2), tmp_path / "nothing.safetensors")
