"""A training that finds its subgoals, stopped and resumed, equals an uninterrupted one bit for bit."""

import signal
from functools import cache, partial

import pytest
from helpers import check_same, make_training, seed_everything, small_env

from hdrqn_torchrl.discovery import DiscoverySettings
from hdrqn_torchrl.runs.interruption import Interrupted


def training(folder, choice="useful", seed=0):
    settings = DiscoverySettings(max_subgoals=3, warmup_frames=480, discovery_frames=160, choice=choice)
    return make_training(
        folder,
        name="v3",
        seed=seed,
        worlds=partial(small_env, num_obstacles=0),
        learner={"capacity": 400, "slice_len": 7, "frames_per_update": 32},
        options={"subgoals": "discovered", "discovery": settings},
        total_frames=1_280,
        log_frames=640,
        evaluation_frames=640,
    )


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    @cache
    def uninterrupted(choice):
        folder = tmp_path_factory.mktemp("training")
        seed_everything(0)
        trainer = training(folder, choice)
        trainer.train()
        assert trainer.algorithm.monitors["discovery"].metrics()["discovery/subgoals"] >= 2
        return folder

    return uninterrupted


WHILE_IT_LEARNS, AT_THE_END, BEFORE, AFTER = 320, 480, 896, 1_088
"""Frames while the detector learns, as it is ready, before there are subgoals and once there are."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("choice", "frames"),
    [("useful", frames) for frames in (WHILE_IT_LEARNS, AT_THE_END, BEFORE, AFTER)]
    + [(choice, frames) for choice in ("random_events", "random_changes") for frames in (WHILE_IT_LEARNS, AFTER)],
)
def test_a_stopped_and_resumed_training_finds_the_same_subgoals(choice, frames, uninterrupted, tmp_path):
    seed_everything(0)
    trainer = training(tmp_path, choice)
    update = trainer.collector.update_policy_weights_

    def stopping():
        if trainer.frames == frames:
            signal.raise_signal(signal.SIGTERM)
        return update()

    trainer.collector.update_policy_weights_ = stopping
    with pytest.raises(Interrupted):
        trainer.train()
    seed_everything(99)
    resumed = training(tmp_path, choice, seed=99)
    resumed.resume(resumed.checkpoints.newest())
    assert resumed.frames == frames
    resumed.train()
    check_same(tmp_path, uninterrupted(choice))
