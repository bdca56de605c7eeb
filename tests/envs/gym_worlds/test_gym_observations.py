import re

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.data import Bounded, Categorical, Unbounded

from hdrqn_torchrl.envs.gym import make_encoder

GREY = spaces.Box(0, 255, (84, 84), np.uint8)
SCREEN = spaces.Box(0, 255, (210, 160, 3), np.uint8)
STACK = spaces.Box(0, 255, (4, 84, 84), np.uint8)
PLANES = spaces.Box(0, 255, (7, 7, 3), np.uint8)


@pytest.mark.parametrize(
    ("space", "shape"),
    [(SCREEN, (3, 210, 160)), (STACK, (4, 84, 84)), (GREY, (1, 84, 84)), (PLANES, (3, 7, 7))],
)
def test_images_have_their_channels_first(space, shape):
    encoder = make_encoder(space)
    image = encoder.encode(space.sample())
    assert image.shape == encoder.space.shape == shape and image.dtype == np.uint8
    spec = encoder.spec(4)
    assert isinstance(spec, Bounded) and spec.shape == (4, *shape) and spec.dtype == torch.uint8


def test_channels_are_moved_not_reshaped():
    image = np.zeros((6, 5, 3), np.uint8)
    image[2, 4, 1] = 9
    assert make_encoder(spaces.Box(0, 255, (6, 5, 3), np.uint8)).encode(image)[1, 2, 4] == 9


@pytest.mark.parametrize(("shape", "channels"), [((8, 10, 4), "first"), ((4, 20, 3), "last"), ((84, 80, 6), "last")])
def test_images_have_their_channels_where_the_user_says(shape, channels):
    image = np.arange(np.prod(shape), dtype=np.int64).astype(np.uint8).reshape(shape)
    encoder = make_encoder(spaces.Dict({"image": spaces.Box(0, 255, shape, np.uint8)}), channels=channels)
    expected = image if channels == "first" else image.transpose(2, 0, 1)
    assert encoder.space.shape == expected.shape and (encoder.encode({"image": image}) == expected).all()


@pytest.mark.parametrize("shape", [(84, 80, 6), (12, 5, 5), (4, 20, 3)])
def test_an_image_whose_shape_does_not_tell_where_its_channels_are_is_refused(shape):
    words = f"channels must be 'first' or 'last' for images of shape {list(shape)}, which does not tell"
    with pytest.raises(ValueError, match=re.escape(words)):
        make_encoder(spaces.Box(0, 255, shape, np.uint8))


def test_images_of_floats_about_1_stay_images():
    encoder = make_encoder(spaces.Box(0.0, 1.0, (3, 40, 30), np.float32))
    assert encoder.is_image and encoder.space.dtype == np.float32


@pytest.mark.parametrize("high", [np.inf, 1000.0])
def test_any_other_box_is_a_vector_of_floats(high):
    space = spaces.Box(-high, high, (2, 3), np.float64)
    encoder = make_encoder(space)
    assert encoder.encode(np.arange(6.0).reshape(2, 3)).tolist() == [0, 1, 2, 3, 4, 5]
    spec = encoder.spec(4)
    assert spec.dtype == torch.float32 and spec.shape == (4, 6)
    assert isinstance(spec, Unbounded if high == np.inf else Bounded)


def highest(encoder):
    return encoder.spec(2).space.high[0].tolist()


@pytest.mark.parametrize(
    ("space", "value", "codes", "highs"),
    [
        (spaces.Discrete(4, start=3), 5, [2], [3]),
        (spaces.MultiDiscrete([2, 5]), np.array([1, 4]), [1, 4], [1, 4]),
        (spaces.MultiDiscrete([[2, 3], [4, 5]]), np.array([[1, 2], [3, 4]]), [1, 2, 3, 4], [1, 2, 3, 4]),
        (spaces.MultiBinary(3), np.array([0, 1, 1]), [0, 1, 1], [1, 1, 1]),
    ],
)
def test_discrete_spaces_are_vectors_of_codes(space, value, codes, highs):
    encoder = make_encoder(space)
    assert encoder.encode(value).tolist() == codes and encoder.encode(value).dtype == np.uint8
    assert highest(encoder) == highs


def test_codes_beyond_a_byte_are_kept():
    encoder = make_encoder(spaces.Discrete(500))
    assert encoder.encode(499).tolist() == [499] and encoder.spec(2).dtype == torch.int32


def test_planes_of_codes_become_one_vector_with_the_number_of_codes_of_each_plane():
    encoder = make_encoder(PLANES, codes=(11, 6, 4))
    planes = np.arange(49)[:, None] % np.array([11, 6, 4])
    assert encoder.encode(planes.reshape(7, 7, 3)).tolist() == planes.reshape(-1).tolist()
    assert highest(encoder)[:4] == [10, 5, 3, 10]


def test_a_square_of_codes_stays_a_window_of_cells():
    spec = make_encoder(spaces.Box(0, 255, (5, 5), np.uint8), codes=7).spec(2)
    assert type(spec) is Categorical and spec.n == 7 and spec.shape == (2, 5, 5)


class TestWords:
    def test_are_numbered_as_listed_and_others_are_0(self):
        encoder = make_encoder(spaces.Text(30), words=("go", "left"), text_length=4)
        assert encoder.encode("Go far, left").tolist() == [1, 0, 2, 0]
        assert highest(encoder) == [2] * 4

    def test_have_the_same_number_in_every_process_without_a_list(self):
        encoder = make_encoder(spaces.Text(30), text_length=3)
        assert encoder.encode("open the door").tolist() == [155, 189, 202]

    def test_beyond_the_length_are_not_seen(self):
        assert make_encoder(spaces.Text(30), words=("a",), text_length=2).encode("a b a a").tolist() == [1, 0]


class TestDict:
    SPACE = spaces.Dict({"a": spaces.Discrete(3), "b": spaces.MultiDiscrete([2, 2]), "c": spaces.Box(-1, 1, (2,))})

    def test_of_codes_is_one_vector_of_codes(self):
        encoder = make_encoder(self.SPACE, entries=["b", "a"])
        assert encoder.encode({"a": 2, "b": np.array([0, 1]), "c": None}).tolist() == [0, 1, 2]
        assert highest(encoder) == [1, 1, 2]

    def test_of_codes_and_floats_is_one_vector_of_floats(self):
        value = {"a": 2, "b": np.array([0, 1]), "c": np.array([0.5, -0.5], np.float32)}
        assert make_encoder(self.SPACE).encode(value).tolist() == [0, 0, 1, 1, 0, 0, 1, 0.5, -0.5]

    def test_of_one_entry_is_that_entry(self):
        space = spaces.Dict({"image": SCREEN, "steps": spaces.Discrete(9)})
        assert make_encoder(space, entries=["image"]).is_image

    def test_with_an_image_among_others_is_refused(self):
        space = spaces.Dict({"image": SCREEN, "steps": spaces.Discrete(9)})
        with pytest.raises(ValueError, match=r"entries must not mix an image .* choose some \(entries=\[image\]\)"):
            make_encoder(space)

    def test_tuples_are_read_by_place(self):
        encoder = make_encoder(spaces.Tuple([spaces.Discrete(3), spaces.Discrete(2)]))
        assert encoder.encode((2, 1)).tolist() == [2, 1]

    def test_nested_ones_are_read_too(self):
        encoder = make_encoder(spaces.Dict({"x": spaces.Dict({"y": spaces.Discrete(3)}), "z": spaces.Discrete(2)}))
        assert encoder.encode({"x": {"y": 1}, "z": 1}).tolist() == [1, 1]


@pytest.mark.parametrize(
    ("space", "options", "words"),
    [
        (spaces.Dict({"a": spaces.Discrete(2)}), {"entries": ["b"]}, r"entries must be some of \['a'\], got \['b'\]"),
        (SCREEN, {"entries": ["b"]}, "entries must be None for observations that are no Dict"),
        (SCREEN, {"channels": "middle"}, "channels must be 'first', 'last' or None, got 'middle'"),
        (PLANES, {"codes": (11, 6)}, r"codes must be one number >= 1, or one for each of 3 planes .* got \(11, 6\)"),
        (PLANES, {"codes": 0}, "codes must be one number >= 1"),
        (spaces.Text(3), {"text_length": 0}, "text_length must be a whole number >= 1, got 0"),
        (spaces.Text(3), {"words": 0}, "words must be a list of words, got 0"),
        (
            spaces.Dict({"a": spaces.Discrete(2)}),
            {"entries": "a"},
            "entries must be a list of names of entries, got 'a'",
        ),
        (spaces.Dict({"a": spaces.Discrete(2)}), {"entries": ["a", "a"]}, "entries must be different names of entries"),
        (
            spaces.Box(0, 1, (3,)),
            {"codes": 4},
            "codes must be None for .* no Box of integers, got 4",
        ),
        (spaces.Box(0, 1, (3,)), {"channels": "first"}, "channels must be None for observations that are no image"),
        (spaces.MultiDiscrete([2**40, 5]), {}, "observation must have codes below"),
        (spaces.Discrete(10**12), {}, "observation must have codes below"),
        (spaces.Box(0, 1, (0,)), {}, "observation must have at least one entry, got Box"),
        (None, {}, "observation space must be a Box, .* got None"),
        (spaces.Sequence(spaces.Discrete(2)), {}, "observation space must be a Box, Discrete"),
    ],
)
def test_what_cannot_be_read_is_refused(space, options, words):
    with pytest.raises(ValueError, match=words):
        make_encoder(space, **options)
