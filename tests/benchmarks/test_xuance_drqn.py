"""XuanCe's agent sees, does and earns exactly what ours do."""

import numpy as np
import pytest
import torch
from torchrl.envs import InitTracker, TransformedEnv

pytest.importorskip("xuance")

import xuance_drqn
from arguments import Arguments
from evaluations import read
from worlds import Worlds
from xuance_drqn import Player, XuanceTraining, XuanceWorlds

from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.runs.evaluation import play

WORLDS, LONGEST = 4, 12


def task(seed=0):
    return MultiGoalGridEnv(WORLDS, max_steps=LONGEST, seed=seed)


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr(xuance_drqn, "NUM_ENVS", 2)
    monkeypatch.setattr(xuance_drqn, "CHUNK", 64)
    small = {"parallels": 2, "batch_size": 2, "start_training": 40, "recurrent_hidden_size": 8}
    monkeypatch.setattr(xuance_drqn, "SETTINGS", xuance_drqn.SETTINGS | small)


def asked(folder, **more):
    common = {"id": "gridworld", "max_steps": LONGEST, "interval_frames": 64, "episodes": 2, "final_episodes": 4}
    return Arguments(**common | more, runs=folder, results=folder)


def test_a_step_shows_what_it_led_to_and_beside_that_the_new_episode():
    plain, worlds = Worlds(task()), XuanceWorlds(Worlds(task()), LONGEST)
    assert np.array_equal(plain.reset(), worlds.buf_obs)
    generator, ends, scores = np.random.default_rng(0), 0, np.zeros(WORLDS)
    for _ in range(40):
        actions = generator.integers(worlds.action_space.n, size=WORLDS)
        expected = plain.step(actions)
        last, reward, terminated, truncated, infos = worlds.step(actions)
        assert np.array_equal(last, expected.last) and np.array_equal(reward, expected.reward)
        assert np.array_equal(terminated, expected.terminated) and np.array_equal(truncated, expected.truncated)
        assert np.array_equal(np.stack([info["reset_obs"] for info in infos]), expected.shown)
        scores += reward
        assert np.allclose([info["episode_score"] for info in infos], scores)
        ended = terminated | truncated
        ends += ended.sum()
        scores[ended] = 0.0
    assert ends >= 3 * WORLDS


@pytest.mark.usefixtures("tiny")
class TestRun:
    def test_it_learns_and_what_is_learned_is_what_is_evaluated(self, tmp_path):
        run = XuanceTraining(asked(tmp_path, frames=128, bonus=1.0), str(tmp_path))
        before = [each.clone() for each in run.learner.policy.parameters()]
        run.train()
        assert any(not torch.equal(a, b) for a, b in zip(before, run.learner.policy.parameters(), strict=True))
        found = read(run.results)
        assert [each.episodes for each in found] == [2, *[2] * (len(found) - 2), 4] and found[-1].frames >= 128
        assert all(each.sampled_success_rate is None for each in found)

    def test_its_memory_is_as_large_as_ours(self, tmp_path):
        memory = XuanceTraining(asked(tmp_path), str(tmp_path)).learner.memory
        assert memory.n_size * LONGEST == pytest.approx(xuance_drqn.CAPACITY, abs=LONGEST)

    def test_a_player_keeps_no_memory_between_evaluations(self, tmp_path):
        run = XuanceTraining(asked(tmp_path), str(tmp_path))
        env = TransformedEnv(task(), InitTracker())
        player = Player(run.learner.policy, run.worlds.worlds.encode)
        first, second = (play(env, player, episodes=WORLDS, seed=9)["return"] for _ in range(2))
        assert torch.equal(first, second)
