import itertools
import math
import signal
import time
import warnings

import pytest
import torch
from helpers import build, make_training, small_env, table
from tensordict import TensorDict
from torch import nn

from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.runs.evaluation import play
from hdrqn_torchrl.runs.interruption import Interrupted, StopRequest
from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints
from hdrqn_torchrl.runs.persistence.weights import load_policy
from hdrqn_torchrl.runs.trainer import Trainer, crossed


@pytest.mark.parametrize(
    ("before", "after", "interval", "expected"),
    [
        (0, 9, 10, False),
        (0, 10, 10, True),
        (9, 10, 10, True),
        (10, 19, 10, False),
        (10, 20, 10, True),
        (5, 35, 10, True),
        (0, 1, 1, True),
        (0, 0, 10, False),
        (12, 12, 10, False),
    ],
)
def test_crossed_says_whether_a_multiple_of_the_interval_was_passed(before, after, interval, expected):
    assert crossed(before, after, interval) == expected


class Stateless:
    """A part without state."""

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        assert state == {}


class FakeCollector(Stateless):
    """Batches of 10 steps in which nothing happens; before batch n it calls ``at[n]``."""

    def __init__(self, at=None):
        self.at, self.weight_updates = at or {}, 0

    def __iter__(self):
        number = 0
        while True:
            number += 1
            self.at.get(number, int)()
            yield quiet_batch()

    def update_policy_weights_(self):
        self.weight_updates += 1

    def give_up(self, frames):
        self.gave_up_at = frames


def quiet_batch(done=False):
    after = {key: torch.zeros(2, 5, 1) for key in ("reward", "extrinsic_reward")}
    after |= {key: torch.zeros(2, 5, 1, dtype=torch.bool) for key in ("success", "attained")}
    after["done"] = torch.full((2, 5, 1), done)
    return TensorDict({"next": TensorDict(after, [2, 5])}, [2, 5])


class FakeLogger(Stateless):
    def __init__(self):
        self.rows, self.closed, self.said, self.advanced = [], False, [], []

    def advance(self, frames):
        self.advanced.append(frames)

    def say(self, sentence):
        self.said.append(sentence)

    def log(self, row):
        self.rows.append(row)

    def close(self):
        self.closed = True


def make_trainer(*, collector=None, results=(), learners=None, **settings):
    """A trainer without learners; ``results`` are the returns of its evaluations."""
    results = iter(results)
    algorithm = Algorithm(
        policy=nn.Linear(1, 1), learners=learners or {}, explorations={}, make_transforms=lambda: None
    )
    return Trainer(
        algorithm,
        collector or FakeCollector(),
        logger=FakeLogger(),
        evaluate=lambda: {"return_mean": next(results, 0.0), "success_rate": 0.5},
        **settings,
    )


class TestTime:
    @pytest.mark.parametrize(
        ("log_frames", "evaluation_frames", "rows", "evaluated"),
        [
            (20, 40, [0, 20, 40, 60, 80, 100], [0, 40, 80, 100]),
            (30, 60, [0, 30, 60, 90, 100], [0, 60, 100]),
            (25, 50, [0, 30, 50, 80, 100], [0, 50, 100]),
            (1, 1, list(range(0, 101, 10)), list(range(0, 101, 10))),
            (1_000, 1_000, [0, 100], [0, 100]),
            (20, 30, [0, 20, 30, 40, 60, 80, 90, 100], [0, 30, 60, 90, 100]),
            (40, 20, [0, 20, 40, 60, 80, 100], [0, 20, 40, 60, 80, 100]),
        ],
    )
    def test_rows_and_evaluations_come_where_their_boundaries_are_crossed(
        self, log_frames, evaluation_frames, rows, evaluated
    ):
        trainer = make_trainer(total_frames=100, log_frames=log_frames, evaluation_frames=evaluation_frames)
        trainer.train()
        assert [row["frames"] for row in trainer.logger.rows] == rows
        assert [row["frames"] for row in trainer.logger.rows if "greedy/return" in row] == evaluated

    def test_the_first_evaluation_comes_before_training(self):
        seen = []
        trainer = make_trainer(total_frames=20)
        trainer.evaluate = lambda: seen.append(trainer.collector.weight_updates) or {"return_mean": 0.0}
        trainer.train()
        assert seen == [1, 3]  # workers get the weights first

    def test_the_logger_is_told_of_every_batch(self):
        trainer = make_trainer(total_frames=30, log_frames=1_000)
        trainer.train()
        assert trainer.logger.advanced == [10, 20, 30]

    def test_training_stops_at_the_first_batch_that_completes_total_frames(self):
        trainer = make_trainer(total_frames=25)
        trainer.train()
        assert trainer.frames == 30 and trainer.collector.weight_updates == 1 + 3

    def test_behaviour_is_averaged_since_the_last_row_only(self):
        trainer = make_trainer(total_frames=1_000, log_frames=10)
        first, second = quiet_batch(done=True), quiet_batch(done=True)
        second["next", "reward"].fill_(1.0)
        for batch in (first, second, quiet_batch()):
            trainer.step(batch)
        returns = [row.get("behaviour/return") for row in trainer.logger.rows]
        assert returns == [0.0, 1.0, None] and trainer.episodes == 20


class CountingLearner(Stateless):
    """Owes a fixed number of updates for each batch; ``told`` collects the calls."""

    learning_rate = 0.001
    is_whole = True

    def state_dict(self, memory=True):
        return {}

    def memory_state_dict(self):
        return {}

    load_memory_state_dict = Stateless.load_state_dict

    def __init__(self, due, told=None):
        self.due, self.updates, self.owed, self.told = due, 0, 0, [] if told is None else told

    def store(self, batch):
        self.owed += self.due
        self.told.append("store")

    def updates_due(self):
        return self.owed

    def learn(self):
        self.updates, self.owed = self.updates + 1, self.owed - 1
        self.told.append("update")
        return {"loss": torch.tensor(float(self.updates))}

    def check_finite(self, *, late=False):
        """Everything is."""


class PlainCollector:
    """As TorchRL's: it can't forget its episodes."""

    def __iter__(self):
        yield quiet_batch()
        raise ZeroDivisionError("of the environment")

    def update_policy_weights_(self):
        pass


def test_an_error_out_of_a_collector_of_torchrl_is_not_hidden():
    with pytest.raises(ZeroDivisionError, match="of the environment"):
        make_trainer(total_frames=30, collector=PlainCollector()).train()


def test_a_collector_that_does_not_keep_its_state_has_no_checkpoints(tmp_path):
    with pytest.raises(ValueError, match="collector must keep its state where checkpoints are given, got a PlainColl"):
        make_trainer(total_frames=30, collector=PlainCollector(), checkpoints=Checkpoints(tmp_path))


def test_every_learner_gets_each_batch_and_its_own_updates():
    learners = {"sub": CountingLearner(3), "meta": CountingLearner(0)}
    trainer = make_trainer(total_frames=20, log_frames=10, learners=learners)
    trainer.train()
    assert [learner.told.count("store") for learner in learners.values()] == [2, 2] and trainer.updates == 6
    first, last = trainer.logger.rows[1:]
    assert (first["sub/updates"], last["sub/updates"], last["meta/updates"], last["updates"]) == (3, 6, 0, 6)
    assert (first["sub/loss"], last["sub/loss"]) == (2.0, 5.0)  # means of 1, 2, 3 and of 4, 5, 6
    assert "meta/loss" not in last


def test_all_learners_store_a_batch_before_any_learns_from_it():
    """So that an iteration can be cut between two updates and leaves nothing to be stored."""
    told = []
    make_trainer(total_frames=20, learners={"sub": CountingLearner(2, told), "meta": CountingLearner(1, told)}).train()
    assert told == ["store", "store", "update", "update", "update"] * 2


def test_the_ceiling_is_logged_beside_the_greedy_return():
    trainer = make_trainer(total_frames=10, ceiling=lambda: 2.0)
    trainer.train()
    assert all(row["greedy/ceiling"] == 2.0 for row in trainer.logger.rows)


def test_the_logger_is_closed_when_the_first_evaluation_fails():
    trainer = make_trainer(total_frames=10)
    trainer.evaluate = lambda: 1 / 0
    with pytest.raises(ZeroDivisionError):
        trainer.train()
    assert trainer.logger.closed


class RecordingCheckpoints(Checkpoints):
    """Remembers what was saved, when, and with which score."""

    def __init__(self, directory):
        super().__init__(directory)
        self.saved = []

    def save(self, components, *, step, score=None):
        self.saved.append(step if score is None else (step, score))
        return super().save(components, step=step, score=score)


class TestWhenItSaves:
    @pytest.fixture
    def saved(self, tmp_path, monkeypatch):
        """Steps (with scores, if best) of the checkpoints of a training."""
        clock = [0.0]
        monkeypatch.setattr(time, "monotonic", lambda: clock[0])

        def saved(*, results=(), seconds_per_batch=0.0, at=None, error=None, **settings):
            def tick():
                clock[0] += seconds_per_batch

            at = dict.fromkeys(range(1, 20), tick) | (at or {})
            quiet = {"total_frames": 100, "log_frames": 1_000, "evaluation_frames": 1_000, "checkpoint_frames": 1_000}
            checkpoints = RecordingCheckpoints(tmp_path / "checkpoints")
            results = itertools.chain(results, itertools.repeat(-math.inf))  # which is never the best
            trainer = make_trainer(
                collector=FakeCollector(at), results=results, checkpoints=checkpoints, **(quiet | settings)
            )
            if error is None:
                trainer.train()
            else:
                with pytest.raises(error):
                    trainer.train()
            assert trainer.logger.closed
            return checkpoints.saved

        return saved

    @pytest.mark.parametrize(
        ("interval", "steps"), [(30, [30, 60, 90, 100]), (25, [30, 50, 80, 100]), (50, [50, 100]), (1_000, [100])]
    )
    def test_a_checkpoint_is_saved_at_each_interval_of_frames_and_at_the_end(self, saved, interval, steps):
        assert saved(checkpoint_frames=interval) == steps

    def test_a_checkpoint_is_saved_when_much_time_has_passed_since_the_last(self, saved):
        assert saved(checkpoint_seconds=60.0, seconds_per_batch=25.0) == [30, 60, 90, 100]
        assert saved(checkpoint_seconds=60.0, seconds_per_batch=25.0, checkpoint_frames=20) == [20, 40, 60, 80, 100]

    def test_a_checkpoint_is_saved_at_each_new_best_with_its_score(self, saved):
        steps = saved(results=[0.1, 0.3, 0.2, 0.5, 0.4, 0.5], evaluation_frames=20)
        assert steps == [(20, 0.3), (60, 0.5), 100]  # that before training is not kept: there is nothing to go on from

    def test_a_checkpoint_is_saved_on_a_stop_request_after_the_current_batch(self, saved):
        stop = {3: lambda: signal.raise_signal(signal.SIGTERM)}
        assert saved(at=stop, error=Interrupted) == [30]

    def test_no_checkpoint_is_saved_twice_at_the_same_step(self, saved):
        stop = {3: lambda: signal.raise_signal(signal.SIGTERM)}
        assert saved(at=stop, error=Interrupted, checkpoint_frames=30) == [30]
        assert saved(total_frames=90, checkpoint_frames=30) == [30, 60, 90]

    @pytest.mark.parametrize(("error", "steps"), [(KeyboardInterrupt, [20]), (RuntimeError, [20, 30])])
    def test_a_checkpoint_is_saved_after_an_error_but_not_after_a_second_stop_signal(self, saved, error, steps):
        def fail():
            raise error

        assert saved(at={4: fail}, error=error, checkpoint_frames=20) == steps

    def test_training_works_without_checkpoints(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        make_trainer(total_frames=10).train()
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("untrained", [0.1, 0.9], ids=["worse", "better, but not saved"])
def test_the_best_and_the_last_weights_are_kept(tmp_path, untrained):
    trainer = make_trainer(
        results=[untrained, 0.5, 0.3, 0.2],
        total_frames=30,
        log_frames=10,
        evaluation_frames=10,
        checkpoints=Checkpoints(tmp_path),
        checkpoint_frames=10,
    )
    policy, evaluate, values = trainer.algorithm.policy, trainer.evaluate, iter([1.0, 2.0, 3.0, 4.0])

    def set_and_evaluate():
        nn.init.constant_(policy.weight, next(values))
        return evaluate()

    trainer.evaluate = set_and_evaluate
    trainer.train()
    found = {}
    for which in ("best", "last"):
        copy = nn.Linear(1, 1)
        load_policy(copy, tmp_path, which)
        found[which] = copy.weight.item()
    assert found == {"best": 2.0, "last": 4.0} and trainer.best_return == 0.5


class TestStopRequests:
    def test_a_stop_between_two_updates_leaves_the_rest_owed(self, tmp_path):
        learner = CountingLearner(5)
        learn = learner.learn

        def learn_and_stop():
            if learner.updates == 6:
                signal.raise_signal(signal.SIGTERM)
            return learn()

        learner.learn = learn_and_stop
        trainer = make_trainer(
            total_frames=100, learners={"flat": learner}, log_frames=10, checkpoints=Checkpoints(tmp_path)
        )
        with pytest.raises(Interrupted, match="stopped by SIGTERM"):
            trainer.train()
        assert (learner.updates, learner.owed, trainer.frames) == (7, 3, 20)
        assert [row["frames"] for row in trainer.logger.rows] == [0, 10]
        trainer.train()  # what was owed comes first
        assert learner.told[6:13] == ["store", *["update"] * 5, "store"]
        assert [row["flat/updates"] for row in trainer.logger.rows] == [5 * count for count in range(11)]

    def test_a_stop_during_an_evaluation_ends_it_at_once(self, tmp_path):
        """And leaves no trace: a signal may come while random numbers are brought back."""
        stop = StopRequest()

        class Stopping:
            steps = 0

            def add_step(self, step, counted=None):
                self.steps += 1
                signal.raise_signal(signal.SIGINT)

        seen = Stopping()
        env, before = small_env(2), torch.get_rng_state()
        algorithm = build("drqn", env)
        judge = algorithm.transform(small_env(2))
        trainer = make_trainer(total_frames=10, checkpoints=Checkpoints(tmp_path), stop=stop)
        trainer.evaluate = lambda: play(judge, algorithm.policy, episodes=20, observers=[seen], check=stop.check)
        torch.set_rng_state(before)
        with pytest.raises(Interrupted, match="stopped by SIGINT") as reason:
            trainer.train()
        assert reason.value.exit_code == 130 and not trainer.logger.rows and seen.steps == 1
        assert torch.equal(torch.get_rng_state(), before)

    def test_signal_handlers_are_restored_after_training(self):
        former = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
        make_trainer(total_frames=10).train()
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == former


def test_the_clocks_of_a_training_stand_still_while_it_is_stopped(tmp_path, monkeypatch):
    clock = [5.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(time, "process_time", lambda: clock[0] / 2)

    def take_a_second():
        clock[0] += 1.0

    def make(at):
        at = dict.fromkeys(range(1, 20), take_a_second) | at
        return make_trainer(
            collector=FakeCollector(at),
            total_frames=100,
            log_frames=50,
            evaluation_frames=1_000,
            checkpoints=Checkpoints(tmp_path),
        )

    first = make({4: lambda: take_a_second() or signal.raise_signal(signal.SIGTERM)})
    with pytest.raises(Interrupted):
        first.train()
    clock[0] += 1_000
    second = make({})
    second.resume(second.checkpoints.newest())
    assert second.clock.wall_seconds == 4.0
    second.train()
    rows = second.logger.rows
    old = second.state_dict()
    del old["processor_seconds"]
    make({}).load_state_dict(old)  # of a version that did not store it
    figures = ("frames", "wall_seconds", "processor_seconds", "frames_per_second")
    assert [tuple(row[name] for name in figures) for row in rows] == [(50, 5.0, 2.5, 10.0), (100, 10.0, 5.0, 10.0)]


def train_really(folder, name="v2", seed=0):
    """A short run with real parts; returns its trainer, its table without the clock, and its final weights."""
    trainer = make_training(folder, name, seed=seed)
    trainer.train()
    weights = trainer.algorithm.policy.state_dict()
    return trainer, table(folder), {key: value.clone() for key, value in weights.items()}


class TestWholeRuns:
    def test_one_seed_repeats_bit_for_bit_in_one_process_and_another_differs(self, tmp_path):
        first, rows, weights = train_really(tmp_path / "a")
        _, same_rows, same_weights = train_really(tmp_path / "b")
        _, other_rows, other_weights = train_really(tmp_path / "c", seed=1)
        assert rows == same_rows != other_rows
        assert all((weights[key] == same_weights[key]).all() for key in weights)
        assert any((weights[key] != other_weights[key]).any() for key in weights)
        assert first.frames == 256 and first.updates > 20  # a later trainer does not touch an earlier one

    @pytest.mark.parametrize("name", ["drqn", "v2"])
    def test_a_row_holds_the_columns_of_its_algorithm(self, tmp_path, name):
        trainer, rows, _ = train_really(tmp_path / "run", name)
        levels = list(trainer.algorithm.learners)
        per_level = ("loss", "td_error", "q_value", "target", "trained_steps", "updates", "epsilon")
        assert {f"{level}/{key}" for level in levels for key in per_level} <= set(rows[0])
        assert {"frames", "episodes", "updates", "behaviour/return", "behaviour/in_order", "greedy/return"} <= set(
            rows[0]
        )
        frames = [int(row["frames"]) for row in rows]
        assert frames == [0, 96, 128, 192, 256]
        epsilons = [float(row[f"{levels[0]}/epsilon"]) for row in rows]
        assert epsilons == pytest.approx([max(0.1, 1 - 0.9 * each / 300) for each in frames], abs=1e-6)

    def test_the_weights_in_the_folder_are_the_final_ones(self, tmp_path):
        trainer, _, weights = train_really(tmp_path / "run")
        copy = build("v2", small_env(2)).policy
        load_policy(copy, tmp_path / "run" / "checkpoints", "last")
        assert all((value == weights[key]).all() for key, value in copy.state_dict().items())
        assert trainer.episodes >= 256 // 7 - 4


@pytest.mark.parametrize(
    ("name", "learner"),
    [
        ("v3", {"slice_len": 12}),
        ("v3", {"slice_len": 12, "priority_exponent": 0.9}),
        ("v3", {"slice_len": 7, "sampling": "whole_episodes", "priority_exponent": 0.9}),
        ("v2", {"slice_len": 6, "sampling": "whole_episodes", "priority_exponent": 0.9}),
        ("drqn", {"slice_len": 12, "sampling": "episode_starts"}),
        ("drqn", {"slice_len": 6, "sampling": "whole_episodes"}),
    ],
    ids=str,
)
def test_updates_wait_until_there_is_a_sequence_to_draw(name, learner, tmp_path):
    """Warm-up ends with the first batch of eight steps; missed updates are not made up for later."""
    settings = {"warmup_frames": 0, "capacity": 100, "frames_per_update": 8}
    trainer = make_training(tmp_path, name, learner=settings | learner, total_frames=192, evaluation_frames=1000)
    trainer.train()
    for level in trainer.algorithm.learners.values():
        assert 8 <= level.updates <= 192 // 8


class TestClipping:
    @pytest.mark.parametrize(("limit", "warned"), [(1e-6, True), (100.0, False), (None, False)])
    def test_a_training_warns_once_where_most_gradients_are_clipped(self, tmp_path, limit, warned):
        trainer = make_training(
            tmp_path, "drqn", learner={"max_grad_norm": limit}, total_frames=192, evaluation_frames=1000, log_frames=40
        )
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("default")
            trainer.train()
        told = [str(each.message) for each in caught if "max_grad_norm" in str(each.message)]
        assert len(told) == warned
        assert not warned or ("got 1e-06 for 'flat'" in told[0] and "flat/grad_norm" in told[0])
