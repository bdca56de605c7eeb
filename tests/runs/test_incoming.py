"""What the host learns of batches that lie on a GPU, without waiting for the work that it has just begun."""

from functools import partial

import pytest
import torch
from captured_trainings import captured_training
from helpers import build, collect, small_env
from tape import Tape
from waits import HostWaits

from hdrqn_torchrl.devices import LateCheck
from hdrqn_torchrl.learning import learner as learner_module
from hdrqn_torchrl.learning.captured import Captured
from hdrqn_torchrl.learning.finite import NonFiniteError
from hdrqn_torchrl.runs.episode_tracker import EpisodeTracker
from hdrqn_torchrl.runs.incoming import Incoming

ARRIVED = {"devices.py:truth", "runs/incoming.py:_arrived"}  # places that read what a GPU has copied to the host
DRAWN_BY_THE_HOST = "objectives/prediction.py:draw_ahead"  # a number of its own generator


def batches_of(name, number):
    """Batches ``[8, 6]`` of an algorithm in which episodes end."""
    env = small_env(8, max_steps=5, obstacle="teleport")
    options = {} if name == "drqn" else {"max_option_steps": 2}
    return collect(build(name, env, **options), env, 6, batches=number)


def test_an_iteration_of_v3_reads_only_what_has_arrived_before(as_on_gpu, monkeypatch, tmp_path):
    """Once all is recorded: collecting, storing, drawing and learning, as with the default settings on a GPU."""
    monkeypatch.setattr(learner_module, "wants_capture", lambda *_: True)
    monkeypatch.setattr(learner_module, "Captured", partial(Captured, recording=Tape, warm_ups=1))
    trainer = captured_training(tmp_path, "v3", recording=Tape)
    trainer.log_frames = trainer.evaluation_frames = 10**9
    batches = iter(trainer.collector)
    for _ in range(4):
        trainer.step(next(batches))
    before = trainer.updates
    with HostWaits() as waits:
        trainer.step(next(batches))
    assert trainer.updates > before
    assert {wait.split()[1] for wait in waits.found} <= ARRIVED | {DRAWN_BY_THE_HOST}


class TestLateCheck:
    def test_a_gpu_is_asked_at_the_next_question(self, as_on_gpu):
        check, told, wrong = LateCheck(), [], torch.tensor(True)
        check.ask(wrong, lambda: told.append("first"))
        wrong.fill_(False)  # the answer is of the time of the question
        assert told == []
        check.ask(wrong, lambda: told.append("second"))
        check.settle()
        assert told == ["first"]

    def test_a_question_can_be_taken_back(self, as_on_gpu):
        check, told = LateCheck(), []
        check.ask(torch.tensor(True), lambda: told.append("first"))
        check.forget()
        check.settle()
        assert told == []


def test_episodes_from_a_gpu_are_counted_a_batch_later_and_none_is_lost(as_on_gpu):
    batches = batches_of("v2", 4)
    late, known = Incoming(EpisodeTracker()), []
    for batch in batches:
        known.append(late.take(batch))
    known.append(late.settle())
    tracker = EpisodeTracker()
    expected = [tracker.finished(batch) for batch in batches]
    assert known[0] == [] and sum(map(len, expected)) > 8
    for (found,), episodes in zip(known[1:], expected, strict=True):
        assert (found == episodes).all() and set(found.keys()) == set(episodes.keys())


def test_a_batch_from_a_gpu_that_is_not_finite_is_found_at_the_next_one(as_on_gpu):
    bad, good = batches_of("drqn", 2)
    bad["next", "reward"][2, 3] = torch.nan
    incoming = Incoming(EpisodeTracker())
    incoming.check(bad, 0)
    incoming.check_late(bad, 0)
    with pytest.raises(NonFiniteError, match=r"^next.reward holds a NaN or an infinity, environment 2, after frame 0$"):
        incoming.check_late(good, 48)
