import shutil
from pathlib import Path

import pytest
import torch
from helpers import build, collect, compact_network, make_training, small_env

from hdrqn_torchrl.runs.persistence.transfer import find_weights, load_weights_of, start_from
from hdrqn_torchrl.runs.persistence.weights import save_weights

ALGORITHMS = ("dqn", "drqn", "hdqn", "v1", "v2", "v3")


def train_a_little(algorithm, env):
    """Until networks and target networks differ."""
    for batch in collect(algorithm, env, 8, batches=8):
        for learner in algorithm.learners.values():
            learner.store(batch)
    for learner in algorithm.learners.values():
        for _ in range(3):
            learner.learn()


@pytest.mark.parametrize("name", ALGORITHMS)
def test_networks_and_target_networks_are_copied_and_all_else_is_new(name):
    torch.manual_seed(0)
    source, target = build(name, small_env(4)), build(name, small_env(2, max_steps=9))
    train_a_little(source, small_env(4))
    for exploration in source.explorations.values():
        exploration.step(50_000)
    start_from(target, source.policy.state_dict())
    expected = dict(source.policy.named_parameters())
    assert all((value == expected[key]).all() for key, value in target.policy.named_parameters())
    for learner in target.learners.values():
        (params,) = (each for key, each in vars(learner.loss)["_modules"].items() if key.startswith("target_"))
        live = vars(learner.loss)["_modules"][_live_name(learner.loss)]
        for key, value in params.items(True, True):
            assert (value == live[key]).all(), key
        assert (learner.updates, learner.frames, len(learner.buffer)) == (0, 0, 0)
        assert not learner.optimizer.state_dict()["state"]
    assert all(exploration.frames == 0 and exploration.epsilon == 1.0 for exploration in target.explorations.values())


def test_buffers_of_a_network_are_copied_too():
    """For example the statistics of a normaliser."""

    def with_statistics():
        algorithm = build("drqn", small_env(2))
        algorithm.policy.get_submodule("network").register_buffer("mean", torch.zeros(3))
        return algorithm

    source, target = with_statistics(), with_statistics()
    source.policy.get_submodule("network").mean += 2.0
    start_from(target, source.policy.state_dict())
    assert (target.policy.get_submodule("network").mean == 2.0).all()


def _live_name(loss):
    (name,) = (key for key in vars(loss)["_modules"] if key.startswith("target_"))
    return name.removeprefix("target_")


def test_weights_of_other_shapes_are_refused_by_name_before_anything_is_copied():
    source, target = build("v2", small_env(2), compact_network(16, (8,))), build("v2", small_env(2))
    before = {key: value.clone() for key, value in target.policy.state_dict().items()}
    with pytest.raises(
        ValueError, match=r"init_from must hold .* same networks, got others: .* is \[.*\] there and \["
    ):
        start_from(target, source.policy.state_dict())
    assert all((value == before[key]).all() for key, value in target.policy.state_dict().items())


def test_weights_of_another_algorithm_are_refused():
    with pytest.raises(ValueError, match=r"is missing there and .*; .* and \d+ more; use the algo and network"):
        start_from(build("v2", small_env(2)), build("v3", small_env(2)).policy.state_dict())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder whose best checkpoint is not its last, and its trainer."""
    folder = tmp_path_factory.mktemp("run")
    trainer = make_training(folder, "v2", evaluation_frames=96)
    returns = iter([0.0, 1.0, 0.5, 0.25])
    trainer.evaluate = lambda: {"return_mean": next(returns), "success_rate": 0.0}
    trainer.train()
    return folder, trainer


class TestFinding:
    def test_initial_weights_are_found_as_best_last_by_name_or_in_a_file(self, run, tmp_path):
        folder, trainer = run
        steps = [int(find_weights(folder, which).name[-12:]) for which in ("best", "last")]
        assert steps == [96, 256]
        last = find_weights(folder, "last")
        assert find_weights(last) == last
        save_weights(trainer.algorithm.policy, tmp_path / "weights.safetensors")
        expected = trainer.algorithm.policy.state_dict()
        for path in (last, find_weights(tmp_path / "weights.safetensors")):
            weights = load_weights_of(path)
            assert weights.keys() == expected.keys()
            assert all((value == expected[key]).all() for key, value in weights.items())

    def test_the_folder_of_an_agent_that_has_weights_alone_will_do(self, run, tmp_path):
        folder = tmp_path / "agent"
        folder.mkdir()
        save_weights(build("v2", small_env(2)).policy, folder / "weights.safetensors")
        assert find_weights(folder) == folder / "weights.safetensors"

    def test_a_path_without_weights_is_refused(self, tmp_path):
        with pytest.raises(ValueError, match="init_from must be a run folder, a checkpoint or a weights file, got"):
            find_weights(tmp_path / "nothing")
        (tmp_path / "text").write_text("text")
        with pytest.raises(ValueError, match="must be a safetensors file"):
            load_weights_of(tmp_path / "text")

    @pytest.mark.parametrize("place", ["/dev/null", "x" * 5000])
    def test_a_device_or_an_impossible_path_is_refused(self, place):
        with pytest.raises(ValueError, match=r"^init_from can't be read: "):
            find_weights(Path(place))

    def test_damaged_weights_are_refused(self, run, tmp_path):
        folder, _ = run
        copy = shutil.copytree(find_weights(folder, "last"), tmp_path / "checkpoints" / "checkpoint-000000000256")
        (copy / "manifest.json").write_text("{}")
        with pytest.raises(ValueError, match=r"init_from can't be read: .* is damaged"):
            load_weights_of(copy)
