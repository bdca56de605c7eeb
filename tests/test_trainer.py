import io

import pytest
import torch
from helpers import build, make_collector, small_env, tiny_settings
from rich.console import Console
from tensordict import TensorDict
from torch import nn

from hdrqn_torchrl.algorithms import Algorithm
from hdrqn_torchrl.checkpoint import load_weights
from hdrqn_torchrl.evaluation import evaluate
from hdrqn_torchrl.logging import RunLogger
from hdrqn_torchrl.plotting import read_metrics
from hdrqn_torchrl.trainer import Trainer, crossed

CLOCK = ("wall_seconds", "frames_per_second", "updates_per_second")


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
def test_crossed(before, after, interval, expected):
    assert crossed(before, after, interval) == expected


class FakeCollector:
    """Batches of 10 steps in which nothing happens; ``at`` maps the number of a batch to an exception."""

    def __init__(self, at=None):
        self.at, self.weight_updates = at or {}, 0

    def __iter__(self):
        number = 0
        while True:
            number += 1
            if number in self.at:
                raise self.at[number]
            yield quiet_batch()

    def update_policy_weights_(self):
        self.weight_updates += 1


def quiet_batch(done=False):
    after = {key: torch.zeros(2, 5, 1) for key in ("reward", "extrinsic_reward")}
    after |= {key: torch.zeros(2, 5, 1, dtype=torch.bool) for key in ("success", "attained")}
    after["done"] = torch.full((2, 5, 1), done)
    return TensorDict({"next": TensorDict(after, [2, 5])}, [2, 5])


class FakeLogger:
    def __init__(self):
        self.rows, self.closed = [], False

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
        assert seen == [0, 2]

    def test_it_stops_at_the_first_batch_that_completes_total_frames(self):
        trainer = make_trainer(total_frames=25)
        trainer.train()
        assert trainer.frames == 30 and trainer.collector.weight_updates == 3

    def test_behaviour_is_averaged_since_the_last_row_only(self):
        trainer = make_trainer(total_frames=1_000, log_frames=10)
        first, second = quiet_batch(done=True), quiet_batch(done=True)
        second["next", "reward"].fill_(1.0)
        for batch in (first, second, quiet_batch()):
            trainer.step(batch)
        returns = [row.get("behaviour/return") for row in trainer.logger.rows]
        assert returns == [0.0, 1.0, None] and trainer.episodes == 20


class CountingLearner:
    """Owes a fixed number of updates for each batch."""

    learning_rate = 0.001

    def __init__(self, due):
        self.due, self.updates, self.seen = due, 0, []

    def store(self, batch):
        self.owed = self.due
        self.seen.append(batch)

    def updates_due(self):
        return self.owed

    def sample(self):
        return self.updates

    def update(self, sample):
        assert sample == self.updates
        self.updates += 1
        return {"loss": torch.tensor(float(self.updates))}


def test_every_learner_gets_each_batch_and_its_own_updates():
    learners = {"sub": CountingLearner(3), "meta": CountingLearner(0)}
    trainer = make_trainer(total_frames=20, log_frames=10, learners=learners)
    trainer.train()
    assert [len(learner.seen) for learner in learners.values()] == [2, 2] and trainer.updates == 6
    first, last = trainer.logger.rows[1:]
    assert (first["sub/updates"], last["sub/updates"], last["meta/updates"], last["updates"]) == (3, 6, 0, 6)
    assert (first["sub/loss"], last["sub/loss"]) == (2.0, 5.0)  # means of 1, 2, 3 and of 4, 5, 6
    assert "meta/loss" not in last


class TestWeights:
    def weights(self, folder, name):
        module = nn.Linear(1, 1)
        load_weights(module, folder / f"{name}.safetensors")
        return module.weight.item()

    def test_last_and_best(self, tmp_path):
        trainer = make_trainer(
            results=[0.1, 0.5, 0.3], total_frames=20, log_frames=10, evaluation_frames=10, checkpoints=tmp_path
        )
        policy, evaluate = trainer.algorithm.policy, trainer.evaluate
        values = iter([1.0, 2.0, 3.0])

        def set_and_evaluate():
            nn.init.constant_(policy.weight, next(values))
            return evaluate()

        trainer.evaluate = set_and_evaluate
        trainer.train()
        assert (self.weights(tmp_path, "best"), self.weights(tmp_path, "last")) == (2.0, 3.0)
        assert trainer.best_return == 0.5

    @pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
    def test_they_are_kept_when_training_is_interrupted(self, tmp_path, error):
        trainer = make_trainer(collector=FakeCollector({3: error()}), total_frames=100, checkpoints=tmp_path)
        update = trainer.collector.update_policy_weights_

        def learn():
            update()
            nn.init.constant_(trainer.algorithm.policy.weight, float(trainer.collector.weight_updates))

        trainer.collector.update_policy_weights_ = learn
        with pytest.raises(error):
            trainer.train()
        assert self.weights(tmp_path, "last") == 2.0
        assert trainer.logger.closed and trainer.frames == 20

    def test_the_logger_is_closed_when_the_first_evaluation_fails(self):
        trainer = make_trainer(total_frames=10)
        trainer.evaluate = lambda: 1 / 0
        with pytest.raises(ZeroDivisionError):
            trainer.train()
        assert trainer.logger.closed

    def test_without_a_folder_nothing_is_written(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        make_trainer(total_frames=10).train()
        assert not list(tmp_path.iterdir())

    def test_the_ceiling_stands_beside_the_greedy_return(self):
        trainer = make_trainer(total_frames=10, ceiling=2.0)
        trainer.train()
        assert all(row["greedy/ceiling"] == 2.0 for row in trainer.logger.rows)


def train_really(folder, name="v2", seed=0):
    """A short run with real parts; returns its trainer, its table without the clock, and its final weights."""
    folder.mkdir()
    torch.manual_seed(seed)
    env = small_env(4, seed=seed)
    algorithm = build(name, env, settings=tiny_settings(frames_per_update=8, warmup_frames=32, learning_rate=1e-2))
    evaluation_env = algorithm.transform(small_env(8))
    trainer = Trainer(
        algorithm,
        make_collector(algorithm, env, 8, total_frames=256),
        logger=RunLogger(folder, total_frames=256, console=Console(file=io.StringIO())),
        evaluate=lambda: evaluate(evaluation_env, algorithm.policy, episodes=8),
        total_frames=256,
        log_frames=64,
        evaluation_frames=128,
        checkpoints=folder / "checkpoints",
    )
    trainer.train()
    metrics = read_metrics(folder / "metrics.csv")
    table = {key: str(column) for key, column in metrics.items() if not key.endswith(CLOCK)}
    return trainer, table, {key: value.clone() for key, value in algorithm.policy.state_dict().items()}


class TestWholeRuns:
    def test_one_seed_repeats_bit_for_bit_in_one_process_and_another_differs(self, tmp_path):
        first, table, weights = train_really(tmp_path / "a")
        _, same_table, same_weights = train_really(tmp_path / "b")
        _, other_table, other_weights = train_really(tmp_path / "c", seed=1)
        assert table == same_table != other_table
        assert all((weights[key] == same_weights[key]).all() for key in weights)
        assert any((weights[key] != other_weights[key]).any() for key in weights)
        assert first.frames == 256 and first.updates > 20  # a later trainer does not touch an earlier one

    @pytest.mark.parametrize("name", ["drqn", "v2"])
    def test_what_a_row_holds(self, tmp_path, name):
        trainer, table, _ = train_really(tmp_path / "run", name)
        levels = list(trainer.algorithm.learners)
        per_level = ("loss", "td_error", "q_value", "target", "trained_steps", "updates", "epsilon")
        assert {f"{level}/{key}" for level in levels for key in per_level} <= set(table)
        assert {"frames", "episodes", "updates", "behaviour/return", "behaviour/in_order", "greedy/return"} <= set(
            table
        )
        assert table["frames"] == "[0.0, 64.0, 128.0, 192.0, 256.0]"
        epsilons = [float(value) for value in table[f"{levels[0]}/epsilon"].strip("[]").split(", ")]
        assert epsilons == pytest.approx([1 - 0.9 * frames / 100_000 for frames in range(0, 257, 64)], abs=1e-6)

    def test_the_weights_in_the_folder_are_the_final_ones(self, tmp_path):
        trainer, _, weights = train_really(tmp_path / "run")
        copy = build("v2", small_env(2)).policy
        load_weights(copy, tmp_path / "run" / "checkpoints" / "last.safetensors")
        assert all((value == weights[key]).all() for key, value in copy.state_dict().items())
        assert (tmp_path / "run" / "checkpoints" / "best.safetensors").exists()
        assert trainer.episodes >= 256 // 7 - 4
