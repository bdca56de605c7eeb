"""Killed processes, full disks, NaN and infinity: a training loses little and reports what happened."""

import os
import random
import re
import signal
import statistics
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pytest
from helpers import check_same, make_training, seed_everything, table
from processes import Diary, leftovers, limited_file_size, start, train_with_diary
from torchrl.checkpoint import CheckpointError

from hdrqn_torchrl.learning.finite import NonFiniteError
from hdrqn_torchrl.runs.persistence.durable import verify

INTERVAL = 32  # frames: every batch is saved


@dataclass
class Kill:
    """What one ``kill -9`` interrupted and what it cost."""

    in_write: bool
    frames_lost: int
    seconds_lost: float
    seconds_to_start: float
    orphans: int
    left: int


class Campaign:
    """Starts a training, kills it, starts it again, until it is done.

    Half of the kills wait for a checkpoint that is being written, the others for a batch; both strike a random time
    later.

    Args:
        folder: of the runs.
        seed: of the moments.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.random, self.kills = folder, random.Random(seed), list[Kill]()

    def run(self, name: str, seed: int, **settings) -> None:
        """Runs one training to its end and compares it with an uninterrupted one."""
        settings |= {"checkpoint_frames": INTERVAL}
        folder, reference = self.folder / f"{name}-{seed}", self.folder / f"{name}-{seed}-uninterrupted"
        folder.mkdir()
        diary, killed_at = Diary(folder / "diary.jsonl"), None
        while not any(note["event"] == "done" for note in diary.read()):
            before = diary.read()
            process = start(train_with_diary, folder, name, seed, settings)
            self.kill_some_time(process, folder, diary, len(before))
            process.join(60)
            killed = process.exitcode == -signal.SIGKILL
            assert killed or process.exitcode == 0, (folder / "error.txt").read_text()
            self.judge(diary.read(), len(before), killed_at)
            killed_at = time.monotonic() if killed else None
            self.in_write = any((folder / "checkpoints").glob(".*"))
        assert leftovers(folder) == 0
        seed_everything(seed)
        make_training(reference, name, seed=seed, **settings).train()
        check_same(folder, reference)

    def kill_some_time(self, process, folder: Path, diary: Diary, known: int) -> None:
        """Kills a process, unless it has finished."""
        count, in_write = self.random.randint(1, 2), self.random.random() < 0.5
        events, size = [], 0
        while process.is_alive():
            time.sleep(0.001)
            if size != (size := diary.size()):
                events = [note["event"] for note in diary.read()[known:]]
            if in_write:
                now = events.count("saved") == count - 1 and any((folder / "checkpoints").glob(".*.stage-*"))
            else:
                now = events.count("batch") == count
            if "start" in events and now:
                time.sleep(self.random.uniform(0.0, 0.01 if in_write else 0.1))
                process.kill()
                return

    def judge(self, notes: list[dict], known: int, killed_at: float | None) -> None:
        """Compares where the last start continued with where the process before it was killed."""
        began = next((note for note in notes[known:] if note["event"] == "start"), None)
        assert began is not None, "killed before it began"
        assert began["left"] == 0
        if killed_at is None:
            return
        saved = [note for note in notes[:known] if note["event"] == "saved"]
        assert began["frames"] >= max((note["frames"] for note in saved), default=0)  # all that was saved is there
        reached = max(note["frames"] for note in notes[:known] if note["event"] in ("start", "batch"))
        since = [note["time"] for note in notes[:known] if note.get("frames") == began["frames"]]
        self.kills.append(
            Kill(
                in_write=self.in_write,
                frames_lost=reached - began["frames"],
                seconds_lost=killed_at - max(since, default=killed_at),
                seconds_to_start=began["seconds"],
                orphans=began["orphans"],
                left=began["left"],
            )
        )
        assert 0 <= self.kills[-1].frames_lost <= INTERVAL

    def __str__(self) -> str:
        kills = self.kills
        frames, seconds = [kill.frames_lost for kill in kills], [kill.seconds_lost for kill in kills]
        starts, orphans = [kill.seconds_to_start for kill in kills], [kill.orphans for kill in kills]
        return (
            f"{len(kills)} kills, {sum(kill.in_write for kill in kills)} in a write; lost per kill: "
            f"{statistics.mean(frames):.1f} frames (at most {max(frames)}), {statistics.mean(seconds):.2f} s (at most "
            f"{max(seconds):.2f} s); start: {statistics.mean(starts):.2f} s (at most {max(starts):.2f} s); orphans: "
            f"{sum(orphans):,} bytes, {sum(kill.left for kill in kills)} after the next start"
        )


def test_a_training_killed_at_any_moment_loses_only_the_last_interval(tmp_path):
    campaign = Campaign(tmp_path, seed=0)
    campaign.run("v2", seed=0, total_frames=192)
    print(campaign)
    assert len(campaign.kills) >= 3 and 0 < sum(kill.in_write for kill in campaign.kills) < len(campaign.kills)


@pytest.mark.slow
def test_a_training_killed_two_hundred_times_loses_only_the_last_intervals(tmp_path):
    campaign, seed = Campaign(tmp_path, seed=1), 0
    while len(campaign.kills) < 200:
        campaign.run(("v2", "v3", "v1", "drqn")[seed % 4], seed, total_frames=1024)
        seed += 1
    print(campaign)
    assert sum(kill.in_write for kill in campaign.kills) >= len(campaign.kills) / 3
    assert sum(kill.orphans for kill in campaign.kills) > 0


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("uninterrupted")
    seed_everything(0)
    make_training(folder).train()
    return folder


class TestFullDisk:
    """The kernel's limit on file sizes stands in for a full disk: writes beyond it fail in the same way."""

    @pytest.mark.parametrize("size", [100, 3_000, 20_000], ids="files of {} bytes".format)
    def test_a_full_disk_keeps_the_previous_checkpoint_which_can_be_resumed(self, tmp_path, uninterrupted, size):
        """Text, small and large tensors fail, one after the other."""
        seed_everything(0)
        trainer = make_training(tmp_path, checkpoint_frames=96)
        good = tmp_path / "checkpoints" / "checkpoint-000000000128"  # was evaluated, and the best so far
        save = trainer.checkpoints.save

        def save_on_a_full_disk(*args, step, **kwargs):
            if step <= 128:
                return save(*args, step=step, **kwargs)
            with limited_file_size(size):
                return save(*args, step=step, **kwargs)

        trainer.checkpoints.save = save_on_a_full_disk
        with pytest.raises(CheckpointError) as error:
            trainer.train()
        told = str(error.value)
        assert "the checkpoint at step 192 can't be written to" in told and "File too large" in told
        assert told.endswith(
            f"the last good checkpoint is {good}. Make room or make the folder writable, then resume the run."
        )
        verify(good)
        assert (
            sorted((tmp_path / "checkpoints").iterdir()) == [good.with_name("checkpoint-000000000096"), good]
            and leftovers(tmp_path) == 0
        )
        trainer = make_training(tmp_path, seed=99)
        trainer.resume(trainer.checkpoints.newest())
        trainer.train()
        check_same(tmp_path, uninterrupted)

    def test_on_a_full_disk_before_the_first_checkpoint_the_error_names_none(self, tmp_path):
        trainer = make_training(tmp_path, checkpoint_frames=32)
        trainer.logger.log = lambda row: None  # the table would not fit either
        with (
            limited_file_size(100),
            pytest.raises(CheckpointError, match=r"; there is no earlier checkpoint\. Make room"),
        ):
            trainer.train()
        assert not list((tmp_path / "checkpoints").iterdir())

    def test_half_a_row_of_metrics_is_removed_on_resume(self, tmp_path, uninterrupted):
        seed_everything(0)
        trainer = make_training(tmp_path, checkpoint_frames=32)
        log, metrics = trainer.logger.log, tmp_path / "metrics.csv"

        def log_on_a_full_disk(row):
            if row["frames"] < 192:
                return log(row)
            with limited_file_size(metrics.stat().st_size + 7):
                return log(row)

        trainer.logger.log = log_on_a_full_disk
        with pytest.raises(OSError, match="File too large"):
            trainer.train()
        assert metrics.read_text().splitlines()[-1].startswith("192,")  # and no more
        trainer = make_training(tmp_path, seed=99)
        trainer.resume(trainer.checkpoints.newest())
        assert trainer.frames == 160 and [row["frames"] for row in table(tmp_path)] == ["0", "96", "128"]
        trainer.train()
        check_same(tmp_path, uninterrupted)


class TestUnwritableFolder:
    def test_a_file_in_place_of_the_checkpoints_folder_is_reported(self, tmp_path):
        (tmp_path / "checkpoints").write_text("mine")
        with pytest.raises(CheckpointError, match="checkpoints must be what a run leaves there, got a file;"):
            make_training(tmp_path, checkpoint_frames=32).train()
        assert (tmp_path / "checkpoints").read_text() == "mine"

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
    def test_a_folder_without_write_permission_is_reported(self, tmp_path):
        trainer = make_training(tmp_path, checkpoint_frames=96)
        before(trainer, 192, lambda: (tmp_path / "checkpoints").chmod(0o500))
        with pytest.raises(CheckpointError, match=r"Permission denied.*the last good checkpoint is .*000096"):
            trainer.train()
        (tmp_path / "checkpoints").chmod(0o700)
        verify(tmp_path / "checkpoints" / "checkpoint-000000000096")


def before(trainer, frames, action):
    """Calls ``action`` after the batch that ends at ``frames``, before the updates."""
    learner = next(iter(trainer.algorithm.learners.values()))
    store = learner.store

    def acting(batch):
        store(batch)
        if trainer.frames == frames:
            action()

    learner.store = acting


class TestNanAndInfinity:
    """Training stops before the optimiser's step, and reports where, and the last good checkpoint."""

    def stopped(self, folder, poison):
        """The message, after ``poison(trainer)`` at 192 frames, and the last good checkpoint."""
        trainer, steps = make_training(folder, checkpoint_frames=96), Counter()
        for learner in trainer.algorithm.learners.values():
            learner.optimizer.register_step_pre_hook(lambda *_, learner=learner: steps.update([learner]))
        before(trainer, 192, lambda: poison(trainer))
        with pytest.raises(NonFiniteError) as error:
            trainer.train()
        assert all(steps[learner] == learner.updates > 0 for learner in trainer.algorithm.learners.values())
        return str(error.value), max((folder / "checkpoints").iterdir())

    @pytest.mark.parametrize("level", ["sub", "meta"])
    def test_a_weight_that_is_not_finite_stops_training(self, tmp_path, level):
        def poison(trainer):
            learner = trainer.algorithm.learners[level]
            sample = learner.sample

            def sample_and_poison():
                drawn = sample()
                next(learner.network.parameters()).data.view(-1)[0] = float("nan")
                return drawn

            learner.sample = sample_and_poison

        told, good = self.stopped(tmp_path, poison)
        what = "(the loss became nan|the gradient of .* became NaN or infinite)"  # a sample may train no step at all
        where = (
            "in update 13, frame 192; training stopped before it could reach the weights; the last good checkpoint is"
        )
        assert re.fullmatch(f"{level}: {what} {where} {good}\\.", told) and good.name.endswith("128")

    def test_a_gradient_that_is_not_finite_stops_training(self, tmp_path):
        def poison(trainer):
            parameters = dict(trainer.algorithm.learners["meta"].network.named_parameters())
            parameters["network.memory.bias_hh_l0"].register_hook(lambda gradient: gradient / 0)

        told, good = self.stopped(tmp_path, poison)
        assert told.startswith(
            "meta: the gradient of network.memory.bias_hh_l0 became NaN or infinite in update 13, frame 192;"
        )
        assert told.endswith(f"the last good checkpoint is {good}.")

    @pytest.mark.parametrize(
        ("key", "value"), [("reward", float("nan")), ("extrinsic_reward", float("inf"))], ids=["reward", "extrinsic"]
    )
    def test_a_reward_that_is_not_finite_stops_training(self, tmp_path, key, value):
        def poison(trainer):
            env = trainer.collector.env.base_env
            step = env._step

            def poisoned_step(tensordict):
                after = step(tensordict)
                after[key][2] = value
                return after

            env._step = poisoned_step

        told, _ = self.stopped(tmp_path, poison)
        assert told.startswith(
            f"next.{key} holds a NaN or an infinity, environment 2, after frame 192; training stopped"
        )

    def test_an_observation_that_is_not_finite_stops_training(self, tmp_path):
        """The policy's weights are finite, so the environment is at fault."""

        def poison(trainer):
            collector = trainer.collector
            rollout = collector.rollout

            def poisoned_rollout():
                batch = rollout()
                batch["observation"] = batch["observation"].float()
                batch["observation"][3, 5] = float("inf")
                return batch

            collector.rollout = poisoned_rollout

        told, good = self.stopped(tmp_path, poison)
        assert told.startswith(
            "observation holds a NaN or an infinity, environment 3, after frame 192; training stopped"
        )
        assert told.endswith(f"the last good checkpoint is {good}.")

    def test_the_error_before_the_first_checkpoint_names_none(self, tmp_path):
        trainer = make_training(tmp_path)
        before(
            trainer, 96, lambda: next(trainer.algorithm.learners["sub"].network.parameters()).data.fill_(float("nan"))
        )
        with pytest.raises(NonFiniteError, match=r"update 1, frame 96; .*; there is no earlier checkpoint\.$"):
            trainer.train()

    def test_checkpoints_saved_before_the_error_can_be_loaded(self, tmp_path, uninterrupted):
        seed_everything(0)
        trainer = make_training(tmp_path, checkpoint_frames=96)
        before(
            trainer, 192, lambda: next(trainer.algorithm.learners["sub"].network.parameters()).data.fill_(float("nan"))
        )
        with pytest.raises(NonFiniteError):
            trainer.train()
        trainer = make_training(tmp_path, seed=99)
        trainer.resume(trainer.checkpoints.newest())
        trainer.train()
        check_same(tmp_path, uninterrupted)
