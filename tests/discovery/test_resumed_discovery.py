"""A training that finds its subgoals, stopped and resumed, equals an uninterrupted one bit for bit."""

import signal
from functools import partial

import pytest
from helpers import check_same, make_training, seed_everything, small_env

from hdrqn_torchrl.discovery import DiscoverySettings
from hdrqn_torchrl.runs.interruption import Interrupted

SETTINGS = DiscoverySettings(max_subgoals=3, warmup_frames=480, discovery_frames=160)
TRAIN = partial(
    make_training,
    name="v3",
    worlds=partial(small_env, num_obstacles=0),
    learner={"capacity": 400, "slice_len": 7, "frames_per_update": 32},
    options={"subgoals": "discovered", "discovery": SETTINGS},
    total_frames=1_280,
    log_frames=640,
    evaluation_frames=640,
)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("training")
    seed_everything(0)
    trainer = TRAIN(folder)
    trainer.train()
    assert trainer.algorithm.monitors["discovery"].metrics()["discovery/subgoals"] >= 2
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("frames", [320, 480, 896, 1_088])  # while the detector learns, ..., once there are subgoals
def test_a_stopped_and_resumed_training_finds_the_same_subgoals(frames, uninterrupted, tmp_path):
    seed_everything(0)
    trainer = TRAIN(tmp_path)
    update = trainer.collector.update_policy_weights_

    def stopping():
        if trainer.frames == frames:
            signal.raise_signal(signal.SIGTERM)
        return update()

    trainer.collector.update_policy_weights_ = stopping
    with pytest.raises(Interrupted):
        trainer.train()
    seed_everything(99)
    resumed = TRAIN(tmp_path, seed=99)
    resumed.resume(resumed.checkpoints.newest())
    assert resumed.frames == frames
    resumed.train()
    check_same(tmp_path, uninterrupted)
