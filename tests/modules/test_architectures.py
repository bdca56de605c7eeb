import pytest
import torch
from helpers import small_env
from torch import nn
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, Unbounded

from hdrqn_torchrl.algorithms import make_drqn, make_v3
from hdrqn_torchrl.modules import Architecture, CellsToImage, compact_network, observation_predictor, paper_network

IMAGE = Bounded(0, 255, shape=(4, 3, 44, 44), dtype=torch.uint8)


SPECS = {
    "cells": small_env(4, view=5).observation_spec["observation"],
    "image": IMAGE,
    "small image": Bounded(0, 255, shape=(4, 4, 10, 7), dtype=torch.uint8),
    "wide image": Unbounded(shape=(4, 1, 36, 84)),
    "vector": Unbounded(shape=(4, 5)),
    "flags": Binary(shape=(4, 5), dtype=torch.bool),
    "codes": MultiCategorical([5, 3, 7], shape=(4, 3), dtype=torch.uint8),
    "planes": Categorical(6, shape=(4, 2, 5, 5), dtype=torch.uint8),
    "one code": Categorical(6, shape=(4,)),
}


@pytest.fixture(params=[*SPECS, "size"])
def inputs(request):
    """A spec (or size), and a batch of two sequences of three inputs for it."""
    if request.param == "size":
        return 16, torch.randn(2, 3, 16)
    spec = SPECS[request.param]
    torch.manual_seed(0)
    return spec, torch.stack([torch.stack([spec.rand()[0] for _ in range(3)]) for _ in range(2)])


@pytest.mark.parametrize("make", [compact_network, paper_network])
@pytest.mark.parametrize("recurrent", [True, False])
def test_every_architecture_reads_every_kind_of_input(make, recurrent, inputs):
    spec, batch = inputs
    architecture = make(hidden_size=12)
    network = architecture.q_network(spec, num_actions=4, num_conditions=2, recurrent=recurrent)
    values = network.unroll(batch, torch.zeros(2, 3, dtype=torch.int64))
    assert values.shape == (2, 3, 4) and network.hidden_size == architecture.hidden_size == 12
    assert isinstance(network.memory, nn.LSTM) == recurrent


def layers(network):
    kinds = (nn.Conv2d, nn.Linear, nn.LSTM)
    return [kind.__name__ for module in network.modules() for kind in kinds if isinstance(module, kind)]


def test_the_papers_network_on_images():
    network = paper_network().q_network(IMAGE, num_actions=4, num_conditions=2)
    assert layers(network) == ["Conv2d"] * 4 + ["Linear", "LSTM", "Linear"]
    assert network.features.out_features == network.hidden_size == 256
    assert network.memory.input_size == 256 + 2


def test_the_papers_network_on_a_hidden_state():
    network = paper_network().q_network(256, num_actions=2)
    assert layers(network) == ["Linear"] * 4 + ["LSTM", "Linear"]
    assert network.memory.input_size == 256


def test_the_papers_network_draws_cells_as_a_44x44_image():
    spec = small_env(4, view=5).observation_spec["observation"]
    network = paper_network().q_network(spec, num_actions=4)
    drawing = next(module for module in network.modules() if isinstance(module, CellsToImage))
    assert drawing(torch.zeros(1, 5, 5, dtype=torch.uint8)).shape == (1, 3, 44, 44)
    assert layers(network) == ["Conv2d"] * 4 + ["Linear", "LSTM", "Linear"]


def test_sizes_of_the_compact_network():
    spec = small_env(4, view=3).observation_spec["observation"]
    network = compact_network(hidden_size=10, widths=[7, 5]).q_network(spec, num_actions=4)
    shapes = [tuple(layer.weight.shape) for layer in network.features.modules() if isinstance(layer, nn.Linear)]
    assert shapes == [(7, 3 * 3 * 5), (5, 7)]
    assert (network.memory.input_size, network.memory.hidden_size) == (5, 10)


@pytest.mark.parametrize("make", [compact_network, paper_network])
def test_gate_features_decides_whether_the_network_has_a_gate(make):
    spec = small_env(4).observation_spec["observation"]
    for gated in (True, False):
        network = make(8, gate_features=gated).q_network(spec, num_actions=4, num_conditions=2)
        assert (network.gate is not None) == gated


@pytest.mark.parametrize("make", [compact_network, paper_network])
def test_memory_span_reaches_the_memory_of_every_agent(make):
    """Cells that remember for up to 50 steps have biases between 0 and log 49; PyTorch's are all below 0.2."""
    env, architecture = small_env(2), make(hidden_size=32, memory_span=50)
    for agent in (make_drqn(env, architecture), make_v3(env, architecture, memory_size=32)):
        memories = [each for each in agent.policy.modules() if isinstance(each, nn.LSTM)]
        assert memories
        for memory in memories:
            kept = (memory.bias_ih_l0 + memory.bias_hh_l0)[32:64]
            assert kept.min() >= 0 and kept.max() > 3


def test_each_network_has_its_own_weights():
    architecture = compact_network(4, (4,))
    first, second = (architecture.q_network(6, num_actions=2) for _ in range(2))
    assert not {id(p) for p in first.parameters()} & {id(p) for p in second.parameters()}


@pytest.mark.parametrize("kind", SPECS)
def test_every_kind_of_observation_is_predicted(kind):
    torch.manual_seed(0)
    spec = SPECS[kind]
    predictor = observation_predictor(spec, 8, 4, 2, width=16)
    observation = torch.stack([spec.rand() for _ in range(5)], 1)  # [4, 5, ...]
    memory, action = torch.randn(4, 5, 8), torch.randint(4, (4, 5))
    error = predictor(memory, action, observation, steps=2)
    assert error.shape == (4, 3) and error.isfinite().all()
    error.sum().backward()
    assert all(each.grad is not None for each in predictor.parameters())


def test_small_images_are_predicted_in_full_and_large_ones_coarsely():
    sizes = [observation_predictor(SPECS[kind], 8, 4, 2).decoder.size for kind in ("small image", "wide image")]
    assert sizes == [(10, 7), (14, 14)]


def test_what_networks_cannot_read_is_not_predicted():
    spec = Unbounded(shape=(4, 5), dtype=torch.float64)
    with pytest.raises(ValueError, match=r"prediction_steps must be 0 if .*, got 3 for \[4, 5\]"):
        observation_predictor(spec, 8, 4, 3)


class Summed(nn.Module):
    """Says that it has eight features, and has twenty-five."""

    out_features = 8

    def forward(self, observation):
        return observation.flatten(-2).float()


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (Summed(), r"returns \[\*, out_features=8\], got \[1, 25\] for an input \[1, 5, 5\]; set out_features to"),
        (nn.Flatten(), r"must make a module with the attribute out_features, got Flatten\("),
        (None, "must make a module with the attribute out_features, got None"),
        (len, "must make a module with the attribute out_features, got <built-in function len>"),
    ],
    ids=["another number", "no number", "nothing", "function"],
)
def test_a_users_feature_extractor_that_networks_can_not_read_is_refused(made, message):
    spec = small_env(4, view=5).observation_spec["observation"]
    architecture = Architecture(hidden_size=8, observation_features=lambda _: made, vector_features=lambda _: made)
    with pytest.raises(ValueError, match=message):
        architecture.q_network(spec, num_actions=2)


def test_trying_a_feature_extractor_draws_no_random_number_and_leaves_it_in_training():
    made = nn.Sequential(nn.Flatten(), nn.Dropout(0.5), nn.BatchNorm1d(25))
    made.out_features = 25
    before = torch.get_rng_state()
    spec = Bounded(0, 1, shape=(4, 5, 5), dtype=torch.float32)
    architecture = Architecture(hidden_size=8, observation_features=lambda _: made, vector_features=lambda _: made)
    assert architecture.features(spec) is made and made.training
    assert torch.equal(torch.get_rng_state(), before) and made[2].num_batches_tracked == 0
