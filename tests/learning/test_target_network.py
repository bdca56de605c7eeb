"""The target network follows the trained one as TorchRL's own updater lets it."""

import pytest
import torch
from torchrl.objectives import SoftUpdate

from hdrqn_torchrl.learning.target_network import SoftTargetUpdate
from hdrqn_torchrl.modules import CellFeatures, QNetwork, SubController
from hdrqn_torchrl.objectives import RecurrentDQNLoss


def make_loss():
    torch.manual_seed(0)
    network = QNetwork(CellFeatures(5, num_codes=5), num_actions=4, hidden_size=8, num_conditions=2, gate_features=True)
    return RecurrentDQNLoss(SubController(network))


@pytest.mark.parametrize("tau", [1e-3, 3e-3, 5e-3, 0.01, 1.0])
def test_each_step_gives_the_bits_of_torchrls_soft_update(tau):
    losses = make_loss(), make_loss()
    updaters = SoftTargetUpdate(losses[0], tau=tau), SoftUpdate(losses[1], tau=tau)
    for step in range(3):
        for loss, updater in zip(losses, updaters, strict=True):
            generator = torch.Generator().manual_seed(step)
            for weight in loss.parameters():
                weight.data += torch.randn(weight.shape, generator=generator)
            updater.step()
    ours, theirs = (loss.target_value_network_params.flatten_keys() for loss in losses)
    assert all(torch.equal(value, theirs[name]) for name, value in ours.items())
    start = make_loss().target_value_network_params.flatten_keys()
    moved = [name for name, value in ours.items() if not torch.equal(value, start[name])]
    assert len(moved) == len(list(losses[0].parameters()))


def test_weights_that_are_loaded_later_are_followed():
    loss = make_loss()
    updater, weights = SoftTargetUpdate(loss, tau=1.0), {name: value + 1 for name, value in loss.state_dict().items()}
    loss.load_state_dict(weights)
    updater.step()
    trained, target = loss.value_network_params.flatten_keys(), loss.target_value_network_params.flatten_keys()
    assert all(torch.equal(target[name], value) for name, value in trained.items())
