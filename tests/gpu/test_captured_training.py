"""What only a GPU can show: ``make test-gpu``. Skipped without one, and not yet run on one."""

from copy import deepcopy
from itertools import islice

import pytest
import torch
from captured_trainings import captured_training
from helpers import ALGORITHMS, build, collect, house, small_env, tiny_settings

from hdrqn_torchrl.data import Continuity
from hdrqn_torchrl.devices import Arriving, to_device
from hdrqn_torchrl.learning.captured import CudaRecording
from hdrqn_torchrl.modules import RepeatingEpsilonGreedy, paper_network
from hdrqn_torchrl.runs.collectors.captured import CapturedCollector
from hdrqn_torchrl.runs.together import take_turns

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
EVERY = [(name, 2) for name in ALGORITHMS] + [("v2", 3), ("v3", 1), ("v3", 2), ("v3", 3)]
IDS = [f"{name}-{levels}" for name, levels in EVERY]


def make(name, levels=2, num_envs=8, **settings):
    """An algorithm and worlds on the GPU."""
    torch.manual_seed(0)
    worlds = house if levels == 3 else small_env
    env = worlds(num_envs, max_steps=5, obstacle="teleport", device="cuda")
    options = {} if name in ("dqn", "drqn") else {"max_option_steps": 2}
    if name == "v3":
        options["sub_exploration"] = RepeatingEpsilonGreedy()
    if name in ("v1", "v2", "v3"):
        options["levels"] = levels
    return build(name, env, settings=tiny_settings(max_grad_norm=1.0, **settings), **options), env


def check_updates(pair, batch, updates=100):
    """Updates of two algorithms on the same minibatches, the first captured."""
    for captured, plain in zip(*(each.learners.values() for each, _ in pair), strict=True):
        captured.store(batch)
        plain.load_state_dict(deepcopy(captured.state_dict()))
        for _ in range(updates):
            sample = captured.sample()
            for each in (captured, plain):
                torch.manual_seed(5)
                each.update(sample.clone())
        for each in (captured, plain):
            each.check_finite()
        weights = [dict(each.network.named_parameters()) for each in (captured, plain)]
        assert max((weights[0][key] - weights[1][key]).abs().max().item() for key in weights[0]) < 1e-3


@pytest.mark.parametrize("name", ["v2", "v3"])
def test_the_papers_network_can_be_captured(name):
    pair = []
    for capture in (True, False):
        torch.manual_seed(0)
        env = small_env(8, max_steps=5, obstacle="teleport", device="cuda")
        pair.append((build(name, env, paper_network(8), settings=tiny_settings(capture=capture)), env))
    check_updates(pair, collect(*pair[0], 10)[0], updates=30)


@pytest.mark.parametrize("changes", [{"priority_exponent": 0.9}, {}], ids=["priorities", "hindsight"])
def test_draws_belong_to_the_graph(changes):
    torch.manual_seed(0)
    env = small_env(8, max_steps=5, obstacle="teleport", device="cuda")
    hindsight = {} if changes else {"sub_hindsight": True, "meta_hindsight": True}
    algorithm = build("v2", env, settings=tiny_settings(capture=True, **changes), max_option_steps=2, **hindsight)
    for batch in collect(algorithm, env, 10, batches=3):
        for learner in algorithm.learners.values():
            learner.store(batch)
            assert all(learner.learn()["loss"].isfinite() for _ in range(30))
            learner.check_finite()
            if changes:
                assert len(learner.buffer.state_dict()["_sampler"]["priorities"].unique()) > 4


def test_the_host_waits_for_nothing_within_an_iteration(tmp_path):
    """Torch itself looks for operations that wait."""
    trainer = captured_training(tmp_path, "v3", recording=CudaRecording, device="cuda")
    trainer.log_frames = trainer.evaluation_frames = 10**9
    batches = iter(trainer.collector)
    for _ in range(5):
        trainer.step(next(batches))
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(2):
            trainer.step(next(batches))
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_two_trainings_in_one_process_both_learn(tmp_path):
    def pieces(seed):
        trainer = captured_training(tmp_path / str(seed), "v3", recording=CudaRecording, device="cuda", seed=seed)
        yield
        yield from trainer.pieces()
        return trainer.updates

    results, ended = take_turns({str(seed): pieces(seed) for seed in (0, 1)}, kind="cuda")
    assert ended == {} and results["0"] == results["1"] > 10


def test_what_comes_from_the_host_arrives_as_it_was():
    sent = [torch.arange(5) + number for number in range(20)]
    there = [to_device(each, torch.device("cuda")) for each in sent]
    back = [Arriving(each) for each in there]
    assert all(torch.equal(each.get(), expected) for each, expected in zip(back, sent, strict=True))


@pytest.mark.parametrize(("name", "levels"), EVERY, ids=IDS)
class TestUpdates:
    def test_weights_after_100_updates_are_those_without_capture(self, name, levels):
        """To 1e-3, in float32: some sums on a GPU have no fixed order."""
        pair = [make(name, levels, capture=capture) for capture in (True, False)]
        batch = collect(*pair[0], 10)[0]
        check_updates(pair, batch)

    def test_updates_in_bfloat16_can_be_captured(self, name, levels):
        algorithm, env = make(name, levels, capture=True)
        batch = collect(algorithm, env, 10)[0]
        for learner in algorithm.learners.values():
            learner.precision = "bf16"
            learner.store(batch)
            assert all(learner.learn()["loss"].isfinite() for _ in range(30))
            learner.check_finite()

    def test_batches_go_on_and_differ(self, name, levels):
        algorithm, env = make(name, levels, num_envs=64)
        collector = CapturedCollector(algorithm.transform(env), algorithm.policy, frames_per_batch=64 * 8)
        continuity, batches = Continuity(), []
        for batch in islice(collector, 6):
            continuity.check(batch)
            algorithm.observe(batch)
            batches.append(batch)
        assert not torch.equal(batches[-1]["action"], batches[-2]["action"])  # random numbers go on
        assert sum(batch["next", "done"].sum() for batch in batches) > 64


def test_a_fault_is_reported_and_changes_no_weight():
    algorithm, env = make("drqn", capture=True)
    learner = algorithm.learners["flat"]
    learner.store(collect(algorithm, env, 10)[0])
    for _ in range(6):
        learner.learn()
    before = {name: value.clone() for name, value in learner.network.named_parameters()}
    bad = learner.sample()
    bad["next", "reward"][:] = torch.nan
    learner.update(bad)
    with pytest.raises(ArithmeticError, match="the loss became nan in update 7"):
        learner.check_finite()
    assert all(torch.equal(before[name], value) for name, value in learner.network.named_parameters())
