import pytest
import torch
from helpers import build, make_collector, small_env
from torchrl.envs import GymEnv, InitTracker, SerialEnv, TransformedEnv

from hdrqn_torchrl.runs.collectors.resumable import ResumableCollector


def make(name, seed=0, total_frames=-1):
    torch.manual_seed(seed)
    env = small_env(3, seed=seed)
    algorithm = build(name, env)
    return algorithm, make_collector(algorithm, env, 4, total_frames, ResumableCollector)


@pytest.mark.parametrize("name", ["drqn", "v1", "v2", "v3"])
def test_a_second_collector_goes_on_with_the_same_steps(name):
    (source, first), (copy, second) = make(name), make(name, seed=1)
    batches = iter(first)
    for _ in range(3):
        next(batches)
    state, policy = first.state_dict(), {key: value.clone() for key, value in source.policy.state_dict().items()}
    torch.manual_seed(5)
    expected = [next(batches) for _ in range(4)]
    copy.policy.load_state_dict(policy)
    second.load_state_dict(state)
    torch.manual_seed(5)
    for wanted, found in zip(expected, second, strict=False):
        assert set(found.keys(True, True)) == set(wanted.keys(True, True))
        assert (found == wanted).all()
    assert expected[0]["is_init"].any() and not expected[0]["is_init"][:, 0].all()  # some went on in mid-episode


def test_the_state_of_a_collector_is_a_copy():
    _, collector = make("v2")
    batches = iter(collector)
    next(batches)
    state = collector.state_dict()
    before = state["carrier"].clone(), {key: value.clone() for key, value in state["base_env"].items()}
    next(batches)
    assert (state["carrier"] == before[0]).all() and all(
        (state["base_env"][key] == before[1][key]).all() for key in before[1]
    )
    collector.load_state_dict(state)
    next(iter(collector))
    assert (state["carrier"] == before[0]).all()


def test_a_resumed_collector_stops_at_total_frames():
    _, first = make("drqn", total_frames=48)
    batches = iter(first)
    for _ in range(2):
        next(batches)
    _, second = make("drqn", seed=1, total_frames=48)
    second.load_state_dict(first.state_dict())
    assert len(list(second)) == 2


def test_the_state_of_a_collector_holds_no_policy():
    _, collector = make("drqn")
    assert set(collector.state_dict()) == {"env_state_dict", "frames", "iter", "traj_pool", "base_env", "carrier"}


def test_an_environment_without_a_state_is_refused():
    with pytest.raises(
        ValueError, match=r"the environment must return its state from state_dict\(\), got nothing from"
    ):
        ResumableCollector(GymEnv("CartPole-v1"), frames_per_batch=4, total_frames=8)


def test_several_environments_without_a_state_are_refused():
    with pytest.raises(ValueError, match=r"use torchrl\.collectors\.Collector without checkpoints"):
        ResumableCollector(SerialEnv(2, lambda: GymEnv("CartPole-v1")), frames_per_batch=4, total_frames=8)


def test_several_environments_in_one_are_resumed():
    def collector(seed):
        worlds = SerialEnv(2, lambda: small_env(2, seed=seed))
        return ResumableCollector(TransformedEnv(worlds, InitTracker()), frames_per_batch=16, total_frames=-1)

    first, second = collector(0), collector(1)
    batches = iter(first)
    next(batches)
    state = first.state_dict()
    torch.manual_seed(5)
    expected = next(batches)
    second.load_state_dict(state)
    torch.manual_seed(5)
    assert (next(iter(second)) == expected).all()


def test_the_state_of_another_number_of_worlds_is_refused():
    _, collector = make("drqn")
    torch.manual_seed(0)
    env = small_env(5)
    other = make_collector(build("drqn", env), env, 4, kind=ResumableCollector)
    with pytest.raises(ValueError, match="state_dict must hold 5 worlds, got 3"):
        other.load_state_dict(collector.state_dict())
