"""More worlds, larger minibatches: each step is replayed as often."""

from dataclasses import replace

import pytest
import torch
from helpers import build, collect, small_env, tiny_settings

from hdrqn_torchrl.learning import LearnerSettings

FRAMES = 4_096 * 8 * 10


def sequences_a_frame(name, worlds, scale):
    """Sequences of all minibatches that a training with so many worlds learns from, for each frame."""
    env = small_env(worlds, max_steps=5)
    settings = tiny_settings(batch_size=32, frames_per_update=20, batch_scale=scale, capacity=worlds * 20)
    algorithm = build(name, env, settings=settings)
    batch = collect(algorithm, env, 8)[0]
    learner = next(iter(algorithm.learners.values()))
    learner.store(batch)
    shown = 0
    while learner.frames < FRAMES:
        due = learner.updates_due()
        shown += due * len(learner.sample()) if learner.updates == 0 else due * learner.settings.batch_size
        learner.schedule.updates += due
        learner.schedule.frames += batch.numel()
    return shown / learner.frames


@pytest.mark.parametrize("name", ["drqn", "v3"])
def test_4096_worlds_replay_each_step_as_often_as_32_do(name):
    few, many = sequences_a_frame(name, 32, 1), sequences_a_frame(name, 4_096, 16)
    assert few == pytest.approx(32 / 20, rel=0.01)
    assert many == pytest.approx(few, rel=0.12)  # the last batch of the few is not learned from yet


def test_a_scale_keeps_the_pace_in_frames_of_replay_and_target_network():
    settings = LearnerSettings(batch_size=8, frames_per_update=0.5, batch_scale=4, tau=0.01, learning_rate_end=None)
    scaled = settings.scaled()
    assert (scaled.batch_size, scaled.frames_per_update, scaled.batch_scale) == (32, 2.0, 1)
    assert 1.0 - scaled.tau == pytest.approx(0.99**4)
    assert (scaled.learning_rate, scaled.learning_rate_end) == (2 * settings.learning_rate, None)
    assert replace(settings, learning_rate_end=1e-4).scaled().learning_rate_end == pytest.approx(2e-4)
    assert scaled.scaled() == scaled


@pytest.mark.parametrize("scale", [0, 10_001])
def test_a_scale_out_of_range_is_refused(scale):
    with pytest.raises(ValueError, match=rf"batch_scale must be in \[1, 10,000\], got {scale}; use 1"):
        LearnerSettings(batch_scale=scale)


def test_minibatches_of_a_learner_are_larger():
    env = small_env(8, max_steps=5)
    learner = build("drqn", env, settings=tiny_settings(batch_scale=3)).learners["flat"]
    learner.store(collect(build("drqn", env), env, 10)[0])
    assert len(learner.sample()) == 12 and learner.updates_due() == 80 // 48
    assert torch.isfinite(learner.learn()["loss"])
