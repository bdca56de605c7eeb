import pytest
import torch
from helpers import RIGHT, build, collect, small_env
from tensordict.nn import TensorDictModule
from torchrl.envs import ExplorationType, set_exploration_type

from hdrqn_torchrl.evaluation import EpisodeTracker, evaluate

PAIR = ("####", "#  #", "####")  # agent and goal side by side
TRACKED = ("return", "extrinsic", "intrinsic", "success", "in_order", "steps")


def pair_env(num_envs):
    return small_env(num_envs, layout=PAIR, num_obstacles=0, num_goals=1, max_steps=3)


def always_right():
    return TensorDictModule(lambda observation: torch.full(observation.shape[:1], RIGHT), ["observation"], ["action"])


class TestEvaluate:
    def test_averages_of_a_scripted_player(self):
        """Going right finds the goal at once or never: 1 step and a return of 1, or 3 steps and nothing."""
        env = pair_env(200)
        env.set_seed(5)
        lucky = (env.reset()["observation"][:, 1, 2] == 3).float().mean().item()
        assert 0.3 < lucky < 0.7
        result = evaluate(env, always_right(), episodes=200, seed=5)
        assert result["episodes"] == 200
        for key in ("return_mean", "extrinsic_mean", "success_rate", "in_order_rate"):
            assert result[key] == pytest.approx(lucky), key
        assert result["steps_mean"] == pytest.approx(lucky * 1 + (1 - lucky) * 3)
        assert result["intrinsic_mean"] == 0.0

    @pytest.mark.parametrize(("episodes", "played"), [(1, 4), (4, 4), (5, 8), (12, 12)])
    def test_every_environment_plays_equally_often(self, episodes, played):
        assert evaluate(pair_env(4), always_right(), episodes=episodes)["episodes"] == played

    def test_half_of_the_goals_in_order_is_a_rate_of_one_half(self):
        """In a row of three cells, one who starts on the left and goes right takes both goals, in either order."""
        env = small_env(300, layout=("#####", "#   #", "#####"), num_obstacles=0, max_steps=2, view=5)
        env.set_seed(3)
        view = env.reset()["observation"][:, 2]
        in_order = ((view[:, 3] == 3) & (view[:, 4] == 4)).float()  # goal 0, then goal 1
        first_only = ((view[:, 3] == 3) & (view[:, 4] == 1)).float()  # goal 1 lies on the left
        result = evaluate(env, always_right(), episodes=300, seed=3)
        assert result["in_order_rate"] == pytest.approx((in_order + first_only / 2).mean().item())
        assert result["success_rate"] == pytest.approx(in_order.mean().item())

    @pytest.fixture
    def agent(self):
        torch.manual_seed(0)
        env = small_env(16, max_steps=40)
        algorithm = build("v2", env)
        return algorithm.transform(env), algorithm.policy

    def test_the_first_episode_of_every_environment_counts_and_no_other(self, agent):
        env, policy = agent
        env.set_seed(3)
        torch.manual_seed(3)
        with set_exploration_type(ExplorationType.RANDOM):
            steps = env.rollout(40, policy, break_when_any_done=False)["next"]
        sums = {"reward": 0.0, "intrinsic_reward": 0.0, "steps": 0}
        for played in steps.unbind(0):
            first = played[: int(played["done"].flatten().long().argmax()) + 1]
            sums["steps"] += len(first)
            for key in ("reward", "intrinsic_reward"):
                sums[key] += first[key].sum().item()
        longest = int(steps["done"].squeeze(-1).long().argmax(1).max()) + 1
        assert (steps["done"][:, :longest].sum(1) > 1).any()  # some finished a second one in the meantime
        result = evaluate(env, policy, episodes=len(steps), seed=3, exploration_type=ExplorationType.RANDOM)
        found = (result["return_mean"], result["intrinsic_mean"], result["steps_mean"])
        assert found == pytest.approx([total / len(steps) for total in sums.values()], abs=1e-6)

    def test_one_seed_gives_the_same_numbers_whatever_came_before(self, agent):
        env, policy = agent
        first = evaluate(env, policy, episodes=16, seed=3)
        other = evaluate(env, policy, episodes=16, seed=4)
        torch.rand(7)
        env.rollout(5)
        assert evaluate(env, policy, episodes=16, seed=3) == first != other

    def test_the_training_streams_of_random_numbers_go_on_untouched(self, agent):
        env, policy = agent
        before = torch.get_rng_state()
        evaluate(env, policy, episodes=8, exploration_type=ExplorationType.RANDOM)
        assert (torch.get_rng_state() == before).all()

    def test_it_is_greedy_unless_told_otherwise(self, agent):
        env, policy = agent
        greedy = evaluate(env, policy, episodes=8)
        for level in (policy.sub_controller, policy.meta_controller):
            level.exploration.epsilon.fill_(0.0)
        assert evaluate(env, policy, episodes=8, exploration_type=ExplorationType.RANDOM) == greedy
        for level in (policy.sub_controller, policy.meta_controller):
            level.exploration.epsilon.fill_(1.0)
        assert evaluate(env, policy, episodes=8) == greedy
        assert evaluate(env, policy, episodes=8, exploration_type=ExplorationType.RANDOM) != greedy


class TestEpisodeTracker:
    def test_sums_over_many_batches_equal_a_plain_loop(self):
        torch.manual_seed(0)
        env = small_env(5)
        batches = collect(build("v2", env), env, 3, batches=20)
        tracker, expected, open_sums = EpisodeTracker(), [], [dict.fromkeys(TRACKED, 0.0) for _ in range(5)]
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

    def test_flat_agents_have_no_intrinsic_reward(self):
        env = small_env(5)
        finished = EpisodeTracker().finished(collect(build("drqn", env), env, 10)[0])
        assert set(finished.keys()) == set(TRACKED) - {"intrinsic"}
