import numpy as np
import pytest
import torch
from helpers import State
from tensordict import TensorDict
from torch import nn

from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints


def round_trip(state, folder):
    checkpoints, copy = Checkpoints(folder / "checkpoints"), State()
    checkpoints.load({"part": copy}, checkpoints.save({"part": State(state)}, step=1))
    return copy.state


class TestWhatAStateMayHold:
    @pytest.mark.parametrize(
        "state",
        [
            None,
            True,
            -3,
            0.1 + 0.2,
            float("inf"),
            "text",
            [],
            {},
            (),
            [1, [2.5, "x"], (None, False)],
            {"a": {"b": {}}, 0: "zero", 1: {2: [3]}},
            {"size": torch.Size([2, 3]), "tuple": (2, 3), "list": [2, 3]},
            {"a/b": 1, "a": {"b": 2}},
            2**70,
        ],
        ids=repr,
    )
    def test_plain_values_come_back_with_their_types(self, tmp_path, state):
        found = round_trip(state, tmp_path)
        assert found == state and repr(found) == repr(state)

    @pytest.mark.parametrize(
        "tensor",
        [
            torch.randn(3, 4),
            torch.tensor(2.5),
            torch.zeros(0, 3),
            torch.zeros(0, dtype=torch.int64),
            torch.tensor([True, False]),
            torch.tensor([[255]], dtype=torch.uint8),
            torch.tensor([-(2**40)]),
            torch.randn(2, dtype=torch.float64),
            torch.randn(2).to(torch.bfloat16),
            torch.arange(12).view(3, 4).t(),
            torch.arange(4).expand(3, 4),
            torch.tensor([float("nan"), float("inf"), -0.0]),
            nn.Parameter(torch.ones(2)),
        ],
        ids=lambda tensor: f"{tensor.dtype}-{tuple(tensor.shape)}".replace("torch.", ""),
    )
    def test_tensors_come_back_bit_for_bit(self, tmp_path, tensor):
        found = round_trip({"tensor": tensor}, tmp_path)["tensor"]
        assert (found.dtype, found.shape, found.requires_grad) == (tensor.dtype, tensor.shape, False)
        wanted = tensor.detach().contiguous()
        assert (found.view(torch.uint8) if found.ndim else found).equal(
            wanted.view(torch.uint8) if found.ndim else wanted
        )

    @pytest.mark.parametrize(
        "array",
        [np.arange(6, dtype=np.int16).reshape(2, 3).T, np.array(2.5), np.zeros((0, 2)), np.array([True, False])],
        ids=lambda array: f"{array.dtype}-{array.shape}",
    )
    def test_arrays_come_back_as_arrays(self, tmp_path, array):
        found = round_trip({"a": [array]}, tmp_path)["a"][0]
        assert isinstance(found, np.ndarray) and found.dtype == array.dtype and np.array_equal(found, array)
        assert found.shape == array.shape and found.flags.writeable

    def test_numbers_of_numpy_come_back_as_numbers(self, tmp_path):
        found = round_trip([np.int64(3), np.bool_(True), np.float32(0.5)], tmp_path)
        assert found == [3, True, 0.5] and [type(each) for each in found] == [int, bool, float]

    def test_tensors_that_share_memory_come_back_separately(self, tmp_path):
        whole = torch.arange(6.0)
        found = round_trip([whole, whole, whole[2:4], whole.view(2, 3)], tmp_path)
        assert [each.tolist() for each in found] == [
            [0, 1, 2, 3, 4, 5],
            [0, 1, 2, 3, 4, 5],
            [2, 3],
            [[0, 1, 2], [3, 4, 5]],
        ]
        found[0].fill_(-1)
        assert found[1].tolist() == [0, 1, 2, 3, 4, 5]

    def test_a_loaded_state_does_not_depend_on_the_file(self, tmp_path):
        found = round_trip({"tensor": torch.ones(1000)}, tmp_path)["tensor"]
        for file in tmp_path.rglob("*.safetensors"):
            file.write_bytes(bytes(file.stat().st_size))
        found += 1
        assert (found == 2).all()

    def test_tensordicts_come_back_with_batch_size_and_names(self, tmp_path):
        state = TensorDict({"a": torch.ones(2, 3, 1), "in": {"b": torch.zeros(2, 3, dtype=torch.bool)}}, [2, 3])
        state.names = [None, "time"]
        plain = TensorDict({("next", "c"): torch.arange(0)}, [0])
        found, found_plain = round_trip([state, plain], tmp_path)
        assert found.batch_size == state.batch_size == found["in"].batch_size and found.names == [None, "time"]
        assert (found == state).all() and set(found.keys(True, True)) == {"a", ("in", "b")}
        assert found_plain.batch_size == plain.batch_size and found_plain["next", "c"].dtype == torch.int64

    def test_a_generator_goes_on_where_it_was(self, tmp_path):
        generator = torch.Generator().manual_seed(3)
        torch.rand(5, generator=generator)
        state = round_trip(generator.get_state(), tmp_path)
        expected = torch.rand(5, generator=generator)
        generator.set_state(state)
        assert torch.rand(5, generator=generator).equal(expected)

    @pytest.mark.parametrize(
        "value", [{1, 2}, b"bytes", object(), torch.float32, lambda: 0], ids=lambda v: str(type(v))
    )
    def test_other_objects_are_refused_by_their_path(self, tmp_path, value):
        checkpoints = Checkpoints(tmp_path)
        with pytest.raises(TypeError, match=r"a state may hold tensors, arrays of numbers, .*at inner/0\."):
            checkpoints.save({"part": State({"inner": [value]})}, step=1)
        assert not list(tmp_path.iterdir())
