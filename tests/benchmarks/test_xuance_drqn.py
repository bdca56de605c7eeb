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
    def test_acting_keeps_no_graph(self, tmp_path):
        """The memory is passed from step to step to the end of the training, and its graph would be, too."""
        run = XuanceTraining(asked(tmp_path, frames=64), str(tmp_path))
        run.train()
        assert not any(state.requires_grad for state in run.learner.rnn_hidden)

    def test_it_learns_and_what_is_learned_is_what_is_evaluated(self, tmp_path):
        run = XuanceTraining(asked(tmp_path, frames=256, bonus=1.0), str(tmp_path))
        before = [each.clone() for each in run.learner.policy.parameters()]
        run.train()
        assert any(not torch.equal(a, b) for a, b in zip(before, run.learner.policy.parameters(), strict=True))
        found = read(run.results)
        assert [each.episodes for each in found] == [2, *[2] * (len(found) - 2), 4] and [
            each.frames for each in found
        ] == [0, 64, 128, 192, 256]
        assert all(each.sampled_success_rate is None for each in found)

    def test_its_memory_is_as_large_as_ours_however_short_episodes_are(self, tmp_path, monkeypatch):
        monkeypatch.setattr(xuance_drqn, "CAPACITY", 60)
        run = XuanceTraining(asked(tmp_path, frames=400), str(tmp_path))
        run.train()
        memory = run.learner.memory
        assert memory.size == len(memory.memory)
        assert 60 - 2 * LONGEST < sum(len(each) for each in memory.memory) == memory.steps <= 60

    def test_an_episode_is_stored_with_what_it_ended_in(self, tmp_path, monkeypatch):
        run, shown, stored = XuanceTraining(asked(tmp_path, frames=400), str(tmp_path)), [[], []], []
        step, store = run.worlds.step, run.learner.memory.store

        def watched(actions):
            last, reward, terminated, truncated, infos = step(actions)
            for index, frame in enumerate(last):
                shown[index].append((frame.copy(), bool(terminated[index] | truncated[index])))
            return last, reward, terminated, truncated, infos

        def keep(episode):
            stored.append(episode)
            store(episode)

        monkeypatch.setattr(run.worlds, "step", watched)
        monkeypatch.setattr(run.learner.memory, "store", keep)
        run.train()
        ends = [frame for frames in shown for frame, over in frames if over]
        assert len(stored) == len(ends) > 20  # no episode is lost between two evaluations
        found = {np.asarray(episode.obs[-1]).tobytes() for episode in stored}
        assert found == {frame.tobytes() for frame in ends}

    def test_results_of_a_run_that_was_begun_are_kept(self, tmp_path):
        XuanceTraining(asked(tmp_path, frames=128), str(tmp_path)).train()
        (path,) = tmp_path.glob("*.jsonl")
        before = path.read_text()
        XuanceTraining(asked(tmp_path, frames=128), str(tmp_path)).train()
        with pytest.raises(SystemExit, match="must be moved away"):
            XuanceTraining(asked(tmp_path, frames=256), str(tmp_path))
        assert path.read_text() == before

    def test_a_player_keeps_no_memory_between_evaluations(self, tmp_path):
        run = XuanceTraining(asked(tmp_path), str(tmp_path))
        env = TransformedEnv(task(), InitTracker())
        player = Player(run.learner.policy, run.worlds.worlds.encode)
        first, second = (play(env, player, episodes=WORLDS, seed=9)["return"] for _ in range(2))
        assert torch.equal(first, second)
