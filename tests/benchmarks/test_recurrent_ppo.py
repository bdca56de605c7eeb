"""The peer sees, does and earns exactly what our agents do."""

import time

import numpy as np
import pytest
import torch
from torchrl.data import Unbounded
from torchrl.envs import InitTracker, TransformedEnv

pytest.importorskip("minigrid")
pytest.importorskip("sb3_contrib")

import recurrent_ppo
import training
from arguments import Arguments
from evaluations import read
from recurrent_ppo import PeerVecEnv, Player, RecurrentPPOTraining
from training import EVALUATION_SEED
from worlds import OneHot, Worlds

from hdrqn_torchrl.envs import MultiGoalGridEnv, make_minigrid
from hdrqn_torchrl.runs.evaluation import evaluate, play

TASK, WORLDS = "MiniGrid-DoorKey-5x5-v0", 4


def task(seed=0, max_steps=25):
    return make_minigrid(TASK, WORLDS, max_steps=max_steps, seed=seed)


def steps(env, number=300, seed=0):
    """Observations, rewards, ends and infos under random actions."""
    generator = np.random.default_rng(seed)
    first = env.reset()
    return first, [env.step(generator.integers(env.action_space.n, size=env.num_envs)) for _ in range(number)]


@pytest.fixture(scope="module")
def ours():
    """The same actions in our environment: first observation, and what each step and each reset returned."""
    env, generator = task(), np.random.default_rng(0)
    now = first = env.reset()
    found = []
    for _ in range(300):
        step, now = env.step_and_maybe_reset(now.set("action", torch.tensor(generator.integers(6, size=WORLDS))))
        found.append((step["next"].clone(), now["observation"].clone()))
    return first["observation"], found


def codes_of(env, observation):
    """Codes of one-hot observations ``[N, S]``."""
    numbers = (env.worlds.env.observation_spec["observation"].high[0].long() + 1).tolist()
    parts = torch.tensor(observation).split(numbers, -1)
    assert all(bool((part.sum(-1) == 1).all()) for part in parts)
    return torch.stack([part.argmax(-1) for part in parts], -1)


class TestPeerVecEnv:
    def test_every_step_is_that_of_our_environment(self, ours):
        env = PeerVecEnv(Worlds(task()))
        first, found = steps(env)
        assert torch.equal(codes_of(env, first), ours[0].long())
        ends = 0
        for (shown, reward, done, infos), (after, following) in zip(found, ours[1], strict=True):
            assert torch.equal(codes_of(env, shown), following.long())
            assert np.array_equal(reward, after["reward"].squeeze(-1).numpy())
            assert np.array_equal(done, after["done"].squeeze(-1).numpy())
            for index in done.nonzero()[0]:
                ends += 1
                assert infos[index]["TimeLimit.truncated"] == bool(after["truncated"][index])
                last = codes_of(env, infos[index]["terminal_observation"][None])[0]
                assert torch.equal(last, after["observation"][index].long())
        assert ends >= 40

    def test_the_bonus_is_for_what_our_agents_count_as_attained(self, ours):
        _, found = steps(PeerVecEnv(Worlds(task(), bonus=0.5)))
        attained = torch.stack([after["attained"].sum(-1) for after, _ in ours[1]])
        plain = torch.stack([after["reward"].squeeze(-1) for after, _ in ours[1]])
        assert attained.sum() > 10
        assert np.allclose(np.stack([reward for _, reward, _, _ in found]), plain + 0.5 * attained)

    def test_a_seed_repeats_and_another_does_not(self):
        env = PeerVecEnv(Worlds(task()))
        runs = []
        for seed in (3, 3, 4):
            env.seed(seed)
            runs.append(steps(env, 30))
        same = [[np.array_equal(a[0], b[0]) for a, b in zip(runs[0][1], other[1], strict=True)] for other in runs[1:]]
        assert all(same[0]) and not all(same[1])

    def test_a_bonus_without_subgoals_is_refused(self):
        with pytest.raises(ValueError, match="bonus must be 0 for a task without subgoals, got 1"):
            Worlds(make_minigrid(TASK, 1, subgoals=None), bonus=1)

    def test_what_are_no_codes_is_refused(self):
        with pytest.raises(ValueError, match="env must show codes"):
            OneHot(Unbounded((1, 3)))

    def test_cells_are_codes_too(self):
        env = MultiGoalGridEnv(num_envs=2, seed=0)
        cells = env.reset()["observation"]
        shown = Worlds(env).encode(cells).reshape(2, 5, 5, -1)
        assert np.array_equal(shown.argmax(-1), cells.numpy()) and np.array_equal(shown.sum(-1), np.ones((2, 5, 5)))


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr(recurrent_ppo, "NUM_ENVS", 2)
    small = {"n_steps": 8, "batch_size": 16, "n_epochs": 1, "policy_kwargs": {"lstm_hidden_size": 8}}
    monkeypatch.setattr(recurrent_ppo, "SETTINGS", recurrent_ppo.SETTINGS | small)


def asked(folder, **more):
    common = {"id": TASK, "interval_frames": 16, "episodes": 2, "final_episodes": 4, "bonus": 1.0}
    return Arguments(**common | more, runs=folder, results=folder)


@pytest.mark.usefixtures("tiny")
class TestRun:
    def test_an_evaluation_plays_the_worlds_of_all_agents_and_keeps_no_memory(self, tmp_path):
        run = RecurrentPPOTraining(asked(tmp_path))
        seen = []

        class Watching(Player):
            def forward(self, tensordict):
                seen.append(tensordict["observation"].clone())
                return super().forward(tensordict)

        env = TransformedEnv(task(), InitTracker())
        player = Watching(run.model, run.worlds.encode)
        first = play(env, player, episodes=WORLDS, seed=9)["return"]
        worlds = task(seed=9).reset()["observation"]
        assert torch.equal(seen[0], worlds)
        assert torch.equal(first, play(env, player, episodes=WORLDS, seed=9)["return"])
        half = len(seen) // 2
        assert all(torch.equal(a, b) for a, b in zip(seen[:half], seen[half:], strict=True))

    def test_a_run_goes_on_from_its_last_checkpoint(self, tmp_path):
        RecurrentPPOTraining(asked(tmp_path, frames=32)).train()
        (path,) = tmp_path.glob("*.jsonl")
        not_saved = path.read_text().splitlines(keepends=True)[-1].replace('"frames": 32', '"frames": 48')
        path.write_text(path.read_text() + not_saved)
        run = RecurrentPPOTraining(asked(tmp_path, frames=64))
        assert run.model.num_timesteps == 32 and run.seconds > read(path)[-1].seconds
        run.train()
        assert [each.frames for each in read(path)] == [0, 16, 32, 48, 64]
        assert [each.episodes for each in read(path)] == [2, 2, 4, 2, 4]
        RecurrentPPOTraining(asked(tmp_path, frames=64)).train()
        assert len(read(path)) == 5

    def test_a_run_without_its_checkpoint_is_left_alone(self, tmp_path):
        RecurrentPPOTraining(asked(tmp_path, frames=32)).train()
        (path,) = tmp_path.glob("*.jsonl")
        before = path.read_text()
        for checkpoint in tmp_path.glob("*.zip"):
            checkpoint.unlink()
        RecurrentPPOTraining(asked(tmp_path, frames=32)).train()  # it is over
        with pytest.raises(SystemExit, match="must be moved away to begin anew, got 3 evaluations"):
            RecurrentPPOTraining(asked(tmp_path, frames=64))
        assert path.read_text() == before

    def test_time_that_is_up_ends_a_run_with_the_final_evaluation(self, tmp_path, monkeypatch):
        run = RecurrentPPOTraining(asked(tmp_path, seconds=1000.0))
        learn = run.model.learn

        def slowly(*args, **kwargs):
            run._cpu_began -= 600.0
            learn(*args, **kwargs)

        monkeypatch.setattr(run.model, "learn", slowly)
        run.train()
        assert [(each.frames, each.episodes) for each in read(run.results)] == [(0, 2), (16, 2), (32, 4)]
        assert read(run.results)[-1].cpu_seconds > 1200.0

    def test_the_second_evaluation_draws_actions_and_takes_no_time(self, tmp_path, monkeypatch):
        run = RecurrentPPOTraining(asked(tmp_path))
        evaluate, asked_for, now = run.evaluate, [], [time.process_time()]
        monkeypatch.setattr(training.time, "process_time", lambda: now[0])

        def slowly(*, final, greedy):
            asked_for.append(greedy)
            now[0] += 70.0 if greedy else 500.0
            return {**evaluate(final=final, greedy=greedy), "success_rate": 0.25 if greedy else 0.75}

        monkeypatch.setattr(run, "evaluate", slowly)
        run.record()
        (told,) = read(run.results)
        assert asked_for == [True, False] and (told.success_rate, told.sampled_success_rate) == (0.25, 0.75)
        assert told.cpu_seconds < 70.0 < run.cpu_seconds < 500.0  # a line has the time before its evaluation

    def test_drawn_actions_differ_from_the_likeliest(self, tmp_path):
        run = RecurrentPPOTraining(asked(tmp_path))
        shown = TransformedEnv(task(), InitTracker()).reset()
        for greedy, number in ((True, 1), (False, 6)):
            player = Player(run.model, run.worlds.encode, greedy=greedy)
            assert len({int(player(shown.clone())["action"][0]) for _ in range(100)}) == number

    def test_a_seed_repeats(self, tmp_path):
        lines = []
        for name in "ab":
            RecurrentPPOTraining(asked(tmp_path / name, frames=16)).train()
            (path,) = (tmp_path / name).glob("*.jsonl")
            lines.append([(each.frames, each.return_mean, each.steps_mean) for each in read(path)])
        assert lines[0] == lines[1]

    def test_what_is_learned_is_what_is_evaluated(self, tmp_path):
        run = RecurrentPPOTraining(asked(tmp_path, frames=32))
        before = [each.clone() for each in run.model.policy.parameters()]
        run.train()
        assert any(not torch.equal(a, b) for a, b in zip(before, run.model.policy.parameters(), strict=True))
        player = Player(run.model, run.worlds.encode)
        found = evaluate(run.evaluation_env, player, episodes=4, seed=EVALUATION_SEED + 1)
        assert found["steps_mean"] == read(run.results)[-1].steps_mean
