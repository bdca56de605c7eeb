"""Several trainings in one process are the same as each alone, bit for bit."""

import random
import signal
from functools import partial

import numpy
import pytest
import torch
from captured_trainings import captured_training
from helpers import check_same, make_training, seed_everything
from tape import Tape

from hdrqn_torchrl.learning import learner as learner_module
from hdrqn_torchrl.learning.captured import Captured
from hdrqn_torchrl.runs.interruption import Interrupted, StopRequest
from hdrqn_torchrl.runs.together import Turn, finish, take_turns


def pieces(make, folder, seed, stop=None, resumed=False):
    """A training as ``train.py`` begins it: everything random is seeded first."""
    seed_everything(99 if resumed else seed)
    trainer = make(folder / str(seed), seed=seed)
    trainer._stop = stop or trainer._stop
    if resumed:
        trainer.resume(trainer.checkpoints.newest())
    yield
    yield from trainer.pieces()
    return trainer.frames


def all_of(make, folder, seeds, stop=None, resumed=False):
    return {str(seed): pieces(make, folder, seed, stop, resumed) for seed in seeds}


def numbers():
    return torch.rand(()).item(), random.random(), numpy.random.rand()


class TestTrainings:
    @pytest.mark.parametrize("name", ["drqn", "v2", "v3"])
    def test_each_is_the_same_as_alone(self, name, tmp_path):
        make, seeds = partial(make_training, name=name), (0, 3)
        for seed in seeds:
            assert finish(pieces(make, tmp_path / "alone", seed)) == 256
        results, ended = take_turns(all_of(make, tmp_path / "together", seeds), kind="cpu")
        assert results == {"0": 256, "3": 256} and ended == {}
        for seed in map(str, seeds):
            check_same(tmp_path / "together" / seed, tmp_path / "alone" / seed)

    def test_so_is_each_that_is_captured(self, as_on_gpu, monkeypatch, tmp_path):
        monkeypatch.setattr(learner_module, "wants_capture", lambda *_: True)
        monkeypatch.setattr(learner_module, "Captured", partial(Captured, recording=Tape, warm_ups=2))
        make = partial(captured_training, name="v3", recording=Tape)
        for seed in (0, 1):
            finish(pieces(make, tmp_path / "alone", seed))
        take_turns(all_of(make, tmp_path / "together", (0, 1)), kind="cpu")
        for seed in "01":
            check_same(tmp_path / "together" / seed, tmp_path / "alone" / seed)

    def test_a_stop_saves_all_of_them_and_each_goes_on_as_if_nothing_had_been(self, tmp_path):
        make, seeds = partial(make_training, name="v2"), (0, 1, 2)
        take_turns(all_of(make, tmp_path / "whole", seeds), kind="cpu")
        with StopRequest() as stop:
            trainings = all_of(make, tmp_path / "cut", seeds, stop)

            def asking(inner):
                for number, _ in enumerate(inner):
                    if number == 14:
                        signal.raise_signal(signal.SIGTERM)
                    yield

            trainings["1"] = asking(trainings["1"])
            results, ended = take_turns(trainings, kind="cpu")
        assert results == {} and {type(each) for each in ended.values()} == {Interrupted}
        results, _ = take_turns(all_of(make, tmp_path / "cut", seeds, resumed=True), kind="cpu")
        assert set(results) == {"0", "1", "2"}
        for seed in "012":
            check_same(tmp_path / "cut" / seed, tmp_path / "whole" / seed)

    def test_one_that_fails_leaves_the_others_alone(self, tmp_path):
        def failing():
            yield
            torch.rand(7)
            yield
            raise RuntimeError("no more")

        make = partial(make_training, name="drqn", total_frames=96)
        finish(pieces(make, tmp_path / "alone", 0))
        results, ended = take_turns({"bad": failing(), **all_of(make, tmp_path, (0,))}, kind="cpu")
        assert results == {"0": 96} and str(ended["bad"]) == "no more"
        check_same(tmp_path / "0", tmp_path / "alone" / "0")

    def test_nothing_is_trained_if_one_cannot_begin(self):
        done = []

        def good():
            try:
                yield
                done.append("trained")
            finally:
                done.append("closed")

        def bad():
            raise ValueError("it is in use")
            yield

        with pytest.raises(ValueError, match="it is in use"):
            take_turns({"good": good(), "bad": bad()}, kind="cpu")
        assert done == ["closed"]

    def test_pieces_end_where_the_host_would_wait(self, tmp_path):
        """After the worlds' steps, and after each learner's updates: eight batches and an iteration at the start."""
        trainer = make_training(tmp_path, "v2")
        assert len(list(trainer.pieces())) == 8 * (1 + 2) + 2


class TestTurn:
    def test_random_numbers_go_on_where_the_last_turn_left_them(self):
        seed_everything(1)
        expected = [numbers() for _ in range(4)]
        seed_everything(2)
        outside = [numbers() for _ in range(2)]
        first, second = Turn("cpu"), Turn("cpu")
        found = []
        for turn in (first, second):
            with turn:
                seed_everything(1)
        seed_everything(2)
        for _ in range(4):
            with first:
                found.append(numbers())
            with second:
                numbers()
                numbers()
        assert found == expected and [numbers() for _ in range(2)] == outside

    def test_an_error_ends_a_turn_as_well(self):
        seed_everything(2)
        expected = numbers()
        seed_everything(2)
        with pytest.raises(RuntimeError), Turn("cpu"):
            numbers()
            raise RuntimeError
        assert numbers() == expected
