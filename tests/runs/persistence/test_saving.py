"""What a training saves when something in it fails."""

import pytest
import torch
from helpers import check_same, make_training, seed_everything, small_env, table
from torchrl.checkpoint import CheckpointError

from hdrqn_torchrl.learning.finite import NonFiniteError
from hdrqn_torchrl.runs.collectors.resumable import has_given_up
from hdrqn_torchrl.runs.persistence.checkpoint import _score

NAMES = ["drqn", "v2", "v3"]


def failing(function, *, at, error=ZeroDivisionError):
    """The function, which fails from its call number ``at`` on."""
    calls = []

    def called(*args, **kwargs):
        calls.append(1)
        if len(calls) >= at:
            raise error("broken")
        return function(*args, **kwargs)

    return called


def saved(folder):
    """Frames of the checkpoints."""
    return sorted(int(path.name[-12:]) for path in (folder / "checkpoints").glob("checkpoint-*"))


def go_on(folder, name="v2"):
    """Resumes a training from its newest checkpoint, to its end."""
    trainer = make_training(folder, name, seed=99)
    trainer.resume(trainer.checkpoints.newest())
    began = trainer.frames
    trainer.train()
    return trainer, began


class TestAnErrorOfTheEnvironment:
    def stopped(self, folder, name, **settings):
        trainer = make_training(folder, name, checkpoint_frames=10_000, **settings)
        base = trainer.collector.env.base_env
        base._step = failing(base._step, at=4 * 8 + 3)  # in the fifth batch of eight steps
        with pytest.raises(ZeroDivisionError, match="broken"):
            trainer.train()
        return trainer

    @pytest.mark.parametrize("name", NAMES)
    def test_a_training_goes_on_after_the_last_whole_batch_with_new_episodes(self, tmp_path, name):
        trainer = self.stopped(tmp_path, name)
        assert trainer.frames == 128 and saved(tmp_path) == [128] and has_given_up(trainer.collector.state_dict())
        again, began = go_on(tmp_path, name)
        assert (began, again.frames) == (128, 256) and again.updates > trainer.updates
        assert [row["frames"] for row in table(tmp_path)] == ["0", "96", "128", "192", "256"]

    def test_the_new_worlds_are_not_those_of_the_beginning(self, tmp_path):
        trainer = self.stopped(tmp_path, "v2")
        first = make_training(tmp_path / "first", "v2").collector
        again = make_training(tmp_path, "v2")
        again.resume(again.checkpoints.newest())
        batch = next(iter(again.collector))
        assert batch["is_init"][:, 0].all() and not batch["is_init"][:, 1].any()
        assert (batch["observation"][:, 0] != next(iter(first))["observation"][:, 0]).any()
        assert batch["collector", "traj_ids"].min() > trainer.collector.state_dict()["traj_pool"]["traj_id"] - 5

    def test_a_checkpoint_at_the_same_frames_is_written_again_and_keeps_its_score(self, tmp_path):
        trainer = self.stopped(tmp_path, "v2")  # was evaluated at its last frame, 128
        newest = trainer.checkpoints.newest()
        assert saved(tmp_path) == [128]
        assert trainer.checkpoints.best() == newest and _score(newest) == trainer.best_return
        assert has_given_up(trainer.collector.state_dict())
        again = make_training(tmp_path, "v2")
        again.resume(newest)
        assert has_given_up(again.collector.state_dict())

    def test_the_same_trainer_can_go_on(self, tmp_path):
        trainer = self.stopped(tmp_path, "v2")
        del trainer.collector.env.base_env._step
        trainer.train()
        assert trainer.frames == 256 and not has_given_up(trainer.collector.state_dict())

    def test_a_batch_with_a_nan_costs_nothing_but_itself(self, tmp_path):
        trainer = make_training(tmp_path, checkpoint_frames=10_000)
        step, calls = trainer.collector.env.base_env._step, []

        def poisoned(tensordict):
            after = step(tensordict)
            calls.append(1)
            return after.set("reward", after["reward"] * float("nan")) if len(calls) > 40 else after

        trainer.collector.env.base_env._step = poisoned
        with pytest.raises(NonFiniteError, match=r"after frame 160; .* the last good checkpoint is .*-000000000160"):
            trainer.train()
        assert go_on(tmp_path)[0].frames == 256


class TestAnErrorOfTheLearner:
    def stopped(self, folder, break_it):
        trainer = make_training(folder, checkpoint_frames=96)
        break_it(trainer.algorithm.learners["sub"])
        with pytest.raises(ZeroDivisionError, match="broken"):
            trainer.train()
        return trainer

    def test_before_weights_change_it_loses_nothing(self, tmp_path):
        def break_it(learner):
            learner._step.loss = failing(learner._step.loss, at=9)

        trainer = self.stopped(tmp_path, break_it)
        assert trainer.frames == 160 and saved(tmp_path) == [128, 160]  # the best, and after the error
        assert go_on(tmp_path)[0].frames == 256

    def test_while_weights_change_nothing_is_saved(self, tmp_path):
        def break_it(learner):
            learner.target_updater.step = failing(learner.target_updater.step, at=9)

        trainer = self.stopped(tmp_path, break_it)
        assert trainer.frames == 160 and saved(tmp_path) == [96, 128]

    def test_of_a_batch_that_is_stored_in_part_nothing_is_saved(self, tmp_path):
        def break_it(learner):
            learner.buffer.extend = failing(learner.buffer.extend, at=5)

        trainer = self.stopped(tmp_path, break_it)
        assert trainer.frames == 160 and saved(tmp_path) == [96, 128]


def test_a_training_whose_evaluation_fails_goes_on_bit_for_bit(tmp_path):
    seed_everything(0)
    make_training(tmp_path / "plain").train()
    seed_everything(0)
    trainer = make_training(tmp_path / "failed", checkpoint_frames=10_000)
    trainer.evaluate = failing(trainer.evaluate, at=2)
    with pytest.raises(ZeroDivisionError, match="broken"):
        trainer.train()
    go_on(tmp_path / "failed")
    check_same(tmp_path / "failed", tmp_path / "plain")


def test_a_state_that_can_not_be_stored_is_told_with_the_first_batch(tmp_path):
    def with_a_set(*args, **settings):
        env = small_env(*args, **settings)
        state = env.state_dict
        env.state_dict = lambda *args, **kwargs: {**state(*args, **kwargs), "visited": {1, 2}}
        return env

    trainer = make_training(tmp_path, worlds=with_a_set)
    with pytest.raises(CheckpointError, match=r"got <class 'set'> at collector/.*/visited\. Where that is the env"):
        trainer.train()
    assert trainer.frames == 0


def test_an_error_is_told_even_if_the_training_can_not_be_saved(tmp_path):
    trainer = make_training(tmp_path, checkpoint_frames=10_000)
    trainer.evaluate = failing(trainer.evaluate, at=2)
    trainer.checkpoints.save = failing(trainer.checkpoints.save, at=1, error=CheckpointError)
    with pytest.raises(ZeroDivisionError, match="broken") as error:
        trainer.train()
    assert error.value.__notes__ == ["The training could not be saved, either: broken"]
    assert torch.is_grad_enabled()
