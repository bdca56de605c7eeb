"""Sums per episode against plain loops."""

import pytest
import torch
from helpers import build, collect, small_env
from tensordict import TensorDict

from hdrqn_torchrl.envs import task_of
from hdrqn_torchrl.runs.episode_tracker import EpisodeTracker

TRACKED = ("return", "extrinsic", "intrinsic", "success", "in_order", "steps")


def test_sums_over_many_batches_equal_a_plain_loop():
    torch.manual_seed(0)
    env = small_env(5)
    batches = collect(build("v2", env), env, 3, batches=20)
    tracker, expected, open_sums = EpisodeTracker(task_of(env)), [], [dict.fromkeys(TRACKED, 0.0) for _ in range(5)]
    for batch in batches:
        ended = []
        for t in range(3):
            for n in range(5):
                step, sums = batch["next"][n, t], open_sums[n]
                sums["return"] += step["reward"].item()
                sums["extrinsic"] += step["extrinsic_reward"].item()
                sums["intrinsic"] += step["intrinsic_reward"].item()
                sums["success"] += step["success"].item()
                sums["in_order"] += (step["extrinsic_reward"].item() >= 1) / 2  # of two goals
                sums["steps"] += 1
                if step["done"]:
                    ended.append(sums)
                    open_sums[n] = dict.fromkeys(TRACKED, 0.0)
        finished = tracker.finished(batch)
        assert len(finished) == len(ended)
        for row, sums in zip(finished, ended, strict=True):
            assert {key: row[key].item() for key in TRACKED} == pytest.approx(sums)
        expected += ended
    assert len(expected) > 20 and any(sums["success"] for sums in expected)


def test_an_episode_with_several_steps_of_success_is_one_success():
    """As where the goal, once reached, stays reached until the time limit."""
    tracker, flags = EpisodeTracker(), torch.tensor([[0, 1, 1, 1, 0, 0], [0, 0, 0, 0, 1, 0]]).bool()
    done = torch.tensor([[0, 0, 0, 1, 0, 1]] * 2).bool()
    after = TensorDict(success=flags.unsqueeze(-1), done=done.unsqueeze(-1), batch_size=[2, 6])
    after["reward"] = torch.ones(2, 6, 1)
    found = [tracker.finished(TensorDict(next=part, batch_size=part.shape)) for part in after.split(3, 1)]
    assert [each["success"].tolist() for each in found] == [[], [1.0, 0.0, 0.0, 1.0]]


def test_flat_agents_have_no_intrinsic_reward():
    env = small_env(5)
    finished = EpisodeTracker(task_of(env)).finished(collect(build("drqn", env), env, 10)[0])
    assert set(finished.keys()) == set(TRACKED) - {"intrinsic"}
