import pytest
import torch
from helpers import small_env
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, OneHot, Unbounded
from user_envs import Corridor

from hdrqn_torchrl.envs.observations import code_sizes, observation_kind, observation_problem
from hdrqn_torchrl.envs.specs import interface, interface_differences

N = 4


@pytest.mark.parametrize(
    ("spec", "kind"),
    [
        (small_env(N).observation_spec["observation"], "cells"),
        (Categorical(5, shape=(N, 3, 3), dtype=torch.int64), "cells"),
        (Categorical(5, shape=(N, 3, 4), dtype=torch.uint8), "codes"),
        (Categorical(5, shape=(N, 2, 3, 3)), "codes"),
        (Categorical(5, shape=(N, 7)), "codes"),
        (Categorical(5, shape=(N,)), "codes"),
        (MultiCategorical([5, 3], shape=(N, 2)), "codes"),
        (MultiCategorical([5, 5, 5, 5], shape=(N, 4), dtype=torch.uint8), "codes"),
        (Bounded(0, torch.tensor([4, 2]).expand(N, 2), shape=(N, 2), dtype=torch.int32), "codes"),
        (Bounded(0, 64, shape=(N, 2), dtype=torch.uint8), "codes"),
        (Bounded(0, 254, shape=(N, 2), dtype=torch.uint8), "codes"),
        (Bounded(0, 20_000, shape=(N, 2), dtype=torch.int16), "codes"),
        (Bounded(0, 255, shape=(N, 3, 44, 60), dtype=torch.uint8), "image"),
        (Bounded(0, 255, shape=(N, 12, 5, 5), dtype=torch.uint8), "image"),
        (Bounded(0, 1, shape=(N, 1, 7, 9)), "image"),
        (Unbounded(shape=(N, 2, 40, 40)), "image"),
        (Unbounded(shape=(N, 4)), "vector"),
        (Bounded(-1, 1, shape=(N, 1)), "vector"),
        (Binary(shape=(N, 6), dtype=torch.bool), "vector"),
        (OneHot(6, shape=(N, 6)), "vector"),
    ],
    ids=lambda value: f"{type(value).__name__} {list(value.shape)}" if hasattr(value, "shape") else value,
)
def test_what_built_in_networks_take_an_observation_for(spec, kind):
    shape = spec.shape[1:]
    assert observation_kind(spec, shape) == kind and observation_problem(spec, shape) is None


@pytest.mark.parametrize(
    ("spec", "remedy"),
    [
        (Unbounded(shape=(N, 4), dtype=torch.float64), "cast it to float32, for instance with DoubleToFloat"),
        (Unbounded(shape=(N, 4), dtype=torch.int64), "number codes from 0, with bounds for each entry"),
        (Bounded(-3, 3, shape=(N, 4), dtype=torch.int64), "cast it to float32 if it holds quantities"),
        (Bounded(0, 2**30, shape=(N, 4), dtype=torch.int64), "cast it to float32 if it holds quantities"),
        (Bounded(0, 2**63 - 1, shape=(N, 4), dtype=torch.int64), "cast it to float32 if it holds quantities"),
        (Bounded(0, 255, shape=(N, 44, 44), dtype=torch.uint8), "UnsqueezeTransform"),
        (Bounded(0, 255, shape=(N, 44, 60, 3), dtype=torch.uint8), "put the channels first"),
        (Bounded(0, 255, shape=(N, 6, 10, 4), dtype=torch.uint8), "(where they are first, exchange height and width)"),
        (Bounded(0, 255, shape=(N, 3, 44, 44), dtype=torch.float32), "divide it by its largest value"),
        (Unbounded(shape=(N,)), "flatten it"),
    ],
    ids=lambda value: f"{type(value).__name__} {list(value.shape)}" if hasattr(value, "shape") else "",
)
def test_what_to_do_about_observations_that_cannot_be_read(spec, remedy):
    assert observation_kind(spec, spec.shape[1:]) is None
    rule, told = observation_problem(spec, spec.shape[1:])
    assert rule.startswith("a square of cell codes [V, V]") and remedy in told
    assert told.endswith("or use an Architecture with your own observation_features")


@pytest.mark.parametrize(
    ("spec", "sizes"),
    [
        (MultiCategorical([5, 3, 2], shape=(N, 3)), (5, 3, 2)),
        (MultiCategorical([5, 3, 2], shape=(3,), dtype=torch.uint8).expand(N, 3), (5, 3, 2)),
        (torch.stack([MultiCategorical([5, 3], shape=(2,))] * N), (5, 3)),
        (Categorical(4, shape=(N, 1, 2, 2)), (4, 4, 4, 4)),
        (Categorical(4, shape=(N,)), (4,)),
        (Bounded(0, torch.tensor([4, 2]).expand(N, 2), shape=(N, 2), dtype=torch.uint8), (5, 3)),
    ],
    ids=str,
)
def test_every_entry_has_its_own_number_of_codes(spec, sizes):
    assert code_sizes(spec, spec.shape[1:]) == sizes


def test_agents_for_other_numbers_of_codes_are_told_apart():
    def corridor(*highs):
        high = torch.tensor(highs).expand(N, len(highs))
        return Corridor(N, odd={"observation": Bounded(0, high, shape=high.shape, dtype=torch.uint8)})

    assert interface(corridor(4, 4, 2))["observation"] == "uint8 [3] below 5 (2 times), 3"
    assert interface_differences(corridor(4, 4, 2), corridor(4, 3, 2)) == (
        "observation is uint8 [3] below 5, 4, 3 instead of uint8 [3] below 5 (2 times), 3"
    )
