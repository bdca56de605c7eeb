"""What only a GPU can show: ``make test-gpu``. Skipped without one, and not yet run on one."""

from itertools import islice

import pytest
import torch
from helpers import ALGORITHMS, build, collect, house, small_env, tiny_settings

from hdrqn_torchrl.data import Continuity
from hdrqn_torchrl.modules import RepeatingEpsilonGreedy
from hdrqn_torchrl.runs.captured_collector import CapturedCollector

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


@pytest.mark.parametrize(("name", "levels"), EVERY, ids=IDS)
class TestUpdates:
    def test_weights_after_100_updates_are_those_without_capture(self, name, levels):
        """To 1e-3, in float32: some sums on a GPU have no fixed order."""
        batch, weights = None, []
        for capture in (True, False):
            algorithm, env = make(name, levels, capture=capture)
            batch = collect(algorithm, env, 10)[0] if batch is None else batch
            for learner in algorithm.learners.values():
                learner.store(batch)
                torch.manual_seed(5)
                for _ in range(100):
                    learner.learn()
                learner.check_finite()
            weights.append([dict(each.network.named_parameters()) for each in algorithm.learners.values()])
        for captured, plain in zip(*weights, strict=True):
            assert max((captured[key] - plain[key]).abs().max().item() for key in plain) < 1e-3

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
