"""Sequences as they would be in changed worlds."""

from dataclasses import replace

import pytest
import torch
from helpers import small_env
from tensordict import TensorDict

from hdrqn_torchrl.algorithms import make_v3
from hdrqn_torchrl.algorithms.presets import V3_LEARNER
from hdrqn_torchrl.envs import Symmetry
from hdrqn_torchrl.learning import RandomSymmetry
from hdrqn_torchrl.modules import compact_network

MIRROR = Symmetry(places=(2, 1, 0, 5, 4, 3), actions=(1, 0, 2))


def test_each_sequence_is_changed_as_a_whole_or_not_at_all():
    torch.manual_seed(0)
    change = RandomSymmetry([MIRROR], observation_key="observation", action_keys=["action"], mask_keys=["action_mask"])
    sample = TensorDict(
        observation=torch.randint(9, (64, 7, 2, 3), dtype=torch.uint8),
        action=torch.randint(3, (64, 7)),
        action_mask=torch.rand(64, 7, 3) < 0.5,
        rest=torch.arange(64 * 7).view(64, 7),
        batch_size=(64, 7),
    )
    before = sample.clone()
    after = change(sample)
    assert (sample == before).all(), "the given minibatch stays as it is"
    mirrored = TensorDict(
        observation=before["observation"].flip(-1),
        action=torch.tensor([1, 0, 2])[before["action"]],
        action_mask=before["action_mask"][..., [1, 0, 2]],
        rest=before["rest"],
        batch_size=(64, 7),
    )
    rows = torch.tensor([bool((a == m).all()) for a, m in zip(after, mirrored, strict=True)])
    kept = torch.tensor([bool((a == b).all()) for a, b in zip(after, before, strict=True)])
    assert (rows ^ kept).all()
    assert 16 < rows.sum() < 48, "half of them"


def test_a_mask_follows_an_action_whose_change_is_not_its_own_inverse():
    torch.manual_seed(0)
    turn = Symmetry(places=(0,), actions=(1, 2, 0))
    change = RandomSymmetry([turn], observation_key="observation", action_keys=["action"], mask_keys=["action_mask"])
    action = torch.randint(3, (32, 4))
    mask = torch.nn.functional.one_hot(action, 3).bool()
    after = change(TensorDict(observation=torch.zeros(32, 4, 1), action=action, action_mask=mask, batch_size=(32, 4)))
    assert not torch.equal(after["action"], action)
    assert torch.equal(after["action_mask"].long().argmax(-1), after["action"])


@pytest.mark.parametrize(
    ("symmetry", "argument"),
    [({"places": (0, 0)}, "places"), ({"actions": (1, 2)}, "actions"), ({"places": 3}, "places")],
)
def test_a_symmetry_is_made_of_permutations(symmetry, argument):
    with pytest.raises(ValueError, match=f"^{argument} must be each of the numbers"):
        Symmetry(**({"places": (1, 0), "actions": (0, 1)} | symmetry))


def test_v3_refuses_symmetries_that_would_not_hold():
    with pytest.raises(ValueError, match=r"^symmetries must be False for a task that states none"):
        make_v3(small_env(2, layout=["######", "#    #", "#   ##", "######"]), compact_network(), symmetries=True)
    env = small_env(2)
    env.task = replace(env.task, symmetries=(MIRROR,))
    with pytest.raises(
        ValueError, match=r"^symmetries must be of the observation's 9 places and of 4 actions, .* 6 and 3"
    ):
        make_v3(env, compact_network(), symmetries=True)
    stored = {**vars(V3_LEARNER), "stored_state": True, "sampling": "steps", "slice_len": 8}
    with pytest.raises(ValueError, match=r"^symmetries must be False with learner.stored_state=True"):
        make_v3(small_env(2), compact_network(), symmetries=True, learner=type(V3_LEARNER)(**stored))
