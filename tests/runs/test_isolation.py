"""A training goes on as if nothing had been played meanwhile."""

import random

import numpy
import pytest
import torch
from helpers import build, make_training, small_env
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import ExplorationType
from torchrl.envs.utils import exploration_type

from hdrqn_torchrl.random_numbers import own_random_numbers
from hdrqn_torchrl.rendering import record_episodes
from hdrqn_torchrl.runs.evaluation import evaluate
from hdrqn_torchrl.runs.isolation import isolated

INSIDE = {"seed": 3, "exploration_type": ExplorationType.RANDOM}


def draw():
    """The next numbers of every stream that a training on a CPU may draw from."""
    return random.random(), numpy.random.rand(), torch.rand(()).item()


class Observer(nn.Module):
    """A policy with every kind of state: running averages, dropout, a counter."""

    def __init__(self):
        super().__init__()
        self.average, self.dropout = nn.BatchNorm1d(9), nn.Dropout()
        self.register_buffer("calls", torch.zeros((), dtype=torch.int64))
        self.dropout.eval()

    def forward(self, observation):
        self.calls += 1
        return self.dropout(self.average(observation.flatten(1).float())).argmax(-1) % 4


def in_order(env, policy):
    return evaluate(env, policy, episodes=4)


def with_an_error(env, policy):
    with pytest.raises(RuntimeError), isolated(env, policy, **INSIDE):
        draw()
        policy(env.reset())
        raise RuntimeError


@pytest.mark.parametrize("play", [in_order, with_an_error])
def test_playing_changes_no_state_of_the_training(play):
    policy = TensorDictModule(Observer(), ["observation"], ["action"])
    modes = [module.training for module in policy.modules()]
    buffers = {name: buffer.clone() for name, buffer in policy.named_buffers()}
    before, kind = [random.getstate(), numpy.random.get_state()[1].tolist(), torch.get_rng_state()], exploration_type()
    play(small_env(4), policy)
    assert random.getstate() == before[0] and numpy.random.get_state()[1].tolist() == before[1]
    assert torch.equal(torch.get_rng_state(), before[2])
    assert [module.training for module in policy.modules()] == modes and True in modes and False in modes
    assert all(torch.equal(buffer, buffers[name]) for name, buffer in policy.named_buffers())
    assert exploration_type() == kind


def test_recording_changes_no_state_of_the_training():
    env = small_env(1)
    agent, state = build("v3", env), torch.get_rng_state()
    record_episodes(agent.transform(env), agent, epsilon=0.5)
    assert torch.equal(torch.get_rng_state(), state) and agent.policy.training


def test_the_seed_decides_every_stream_inside_and_modules_are_not_in_training_mode():
    env, policy, found = small_env(2), TensorDictModule(Observer(), ["observation"], ["action"]), []
    for seed in (3, 3, 4, 2**33):
        draw()
        with isolated(env, policy, **(INSIDE | {"seed": seed})):
            found.append((*draw(), env.reset()["observation"].tolist()))
            assert not any(module.training for module in policy.modules())
            assert exploration_type() == ExplorationType.RANDOM
    assert found[0] == found[1]
    assert all(first != second for first, second in zip(found[1][:3], found[2][:3], strict=True))


def test_the_random_numbers_of_gpus_are_restored(monkeypatch):
    """Generators that stand for those of two GPUs."""
    gpus, inside = [torch.Generator().manual_seed(seed) for seed in (7, 8)], []
    monkeypatch.setattr(torch.cuda, "default_generators", gpus)
    state = [gpu.get_state() for gpu in gpus]
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    for _ in range(2):
        with isolated(small_env(2), build("v2", small_env(2)).policy, **INSIDE):
            inside.append([torch.rand(3, generator=gpu).tolist() for gpu in gpus])
        assert all(torch.equal(gpu.get_state(), before) for gpu, before in zip(gpus, state, strict=True))
    assert inside[0] == inside[1] != [torch.rand(3, generator=gpu).tolist() for gpu in gpus]


def test_without_a_seed_the_streams_continue_inside():
    torch.manual_seed(0)
    with own_random_numbers():
        inside = draw()
    assert draw() == inside


@pytest.mark.parametrize("name", ["v2", "v3"])
def test_a_training_is_the_same_however_often_it_is_evaluated(name, tmp_path):
    weights = []
    for frames in (32, 10**9):
        trainer = make_training(tmp_path / str(frames), name, total_frames=160, evaluation_frames=frames)
        trainer.train()
        weights.append(trainer.algorithm.policy.state_dict())
        assert trainer.updates > 5
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
