import warnings

import pytest
import torch
from gym_toys import Counter
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from helpers import LEFT, RIGHT, build, collect, house, small_env, subgoal_env
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import ExplorationType, set_exploration_type
from user_envs import Corridor

from hdrqn_torchrl.analysis.episodes import summarise
from hdrqn_torchrl.envs import Task, make_gym
from hdrqn_torchrl.learning.legs import LegCounter
from hdrqn_torchrl.runs.episode_tracker import EpisodeTracker
from hdrqn_torchrl.runs.evaluation import PlaceCounter, evaluate, play, seed_of_round

PAIR = ("####", "#  #", "####")  # agent and goal side by side


def pair_env(num_envs, max_steps=3):
    return small_env(num_envs, layout=PAIR, num_obstacles=0, num_goals=1, max_steps=max_steps)


def always(action):
    return TensorDictModule(lambda observation: torch.full(observation.shape[:1], action), ["observation"], ["action"])


def always_right():
    return always(RIGHT)


class TestEvaluate:
    def test_evaluate_averages_the_episodes_of_a_scripted_player(self):
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
        assert "intrinsic_mean" not in result

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

    def test_every_policy_meets_the_same_worlds_in_every_round_however_long_its_episodes_are(self, monkeypatch):
        """Going right or left in a corridor: who finds the goal at once is done sooner, and resets more often."""
        env, starts = pair_env(4), []
        reset = env.reset

        def recorded(*tensordict, **options):
            if not tensordict:  # all worlds at once: a round begins
                starts.append(reset(**options))
                return starts[-1].clone()
            return reset(*tensordict, **options)

        monkeypatch.setattr(env, "reset", recorded)

        def worlds_and_steps(direction, seed=7):
            starts.clear()
            steps = play(env, always(direction), episodes=40, seed=seed)["steps"]
            return torch.stack([start["observation"] for start in starts]), steps

        (right, right_steps), (left, left_steps) = worlds_and_steps(RIGHT), worlds_and_steps(LEFT)
        assert len(right) == 10 and (right == left).all() and (right_steps != left_steps).any()
        assert len(right.flatten(1).unique(dim=0)) > 5  # rounds differ
        following, _ = worlds_and_steps(RIGHT, seed=8)
        assert (following != right).flatten(1).any(1).float().mean() > 0.5

    def test_the_first_round_has_the_given_seed(self):
        env = pair_env(8)
        env.set_seed(3)
        on_the_right = env.reset()["observation"][:, 1, 2] == 3
        assert (play(env, always(RIGHT), episodes=8, seed=3)["success"].bool() == on_the_right).all()

    def test_rounds_of_neighbouring_seeds_share_nothing(self):
        seeds = [seed_of_round(seed, number) for seed in range(1_000_000, 1_000_020) for number in range(20)]
        assert len(set(seeds)) == 400 and all(0 <= seed < 2**31 for seed in seeds)
        assert isinstance(seed_of_round(-5, 1), int)

    def test_the_random_numbers_of_training_are_untouched(self, agent):
        env, policy = agent
        before = torch.get_rng_state()
        evaluate(env, policy, episodes=8, exploration_type=ExplorationType.RANDOM)
        assert (torch.get_rng_state() == before).all()

    def test_evaluation_is_greedy_by_default(self, agent):
        env, policy = agent
        greedy = evaluate(env, policy, episodes=8)
        for level in (policy.sub_controller, policy.meta_controller):
            level.exploration.epsilon.fill_(0.0)
        assert evaluate(env, policy, episodes=8, exploration_type=ExplorationType.RANDOM) == greedy
        for level in (policy.sub_controller, policy.meta_controller):
            level.exploration.epsilon.fill_(1.0)
        assert evaluate(env, policy, episodes=8) == greedy
        assert evaluate(env, policy, episodes=8, exploration_type=ExplorationType.RANDOM) != greedy


class TestTasksOfOthers:
    """A user's environment may have fewer entries, and episodes that are long or never end."""

    STATED = Task(max_steps=6, ordered=True)

    def played(self, name="v2", **settings):
        env = Corridor(4, **settings)
        algorithm = build(name, env)
        return evaluate(algorithm.transform(env), algorithm.policy, episodes=4)

    @pytest.mark.parametrize(
        ("name", "without", "task", "figures"),
        [
            ("v2", ("hazard", "success"), None, {"extrinsic_mean", "intrinsic_mean"}),
            ("v3", ("hazard",), None, {"extrinsic_mean", "intrinsic_mean", "success_rate"}),
            ("v1", ("success",), STATED, {"extrinsic_mean", "intrinsic_mean", "in_order_rate"}),
            ("dqn", ("attained", "extrinsic_reward", "hazard", "success"), None, set()),
        ],
    )
    def test_a_result_has_the_figures_that_agent_and_environment_provide(self, name, without, task, figures):
        env = Corridor(4, without=without, task=task)
        algorithm = build(name, env)
        played = play(algorithm.transform(env), algorithm.policy, episodes=4)
        result = summarise(played)
        assert set(result["intervals"]) == {"return_mean", "steps_mean"} | figures
        assert set(result) == set(result["intervals"]) | {"episodes", "per_subgoal", "intervals"}
        assert len(result["per_subgoal"]) == (0 if name == "dqn" else 2)

    def test_large_rewards_do_not_count_as_goals_in_order(self):
        """Ten for each of many goals: the rate was once reported as 13.5."""
        result = self.played(pays=27.0, without=("success",))
        assert "in_order_rate" not in result
        assert "in_order" not in EpisodeTracker().finished(collect(build("v1", Corridor(4)), Corridor(4), 8)[0])

    def test_tasks_without_end_need_a_limit(self, monkeypatch):
        monkeypatch.setattr("hdrqn_torchrl.runs.evaluation.PATIENCE", 20)
        with pytest.raises(ValueError, match=r"max_steps must be given where .* none of 4 has ended after 20 steps"):
            self.played(length=None)
        assert self.played(length=20)["steps_mean"] == 20
        with pytest.raises(ValueError, match="env must end its episodes, got 4 of 4 that had not ended after 5 steps"):
            self.played(length=6, task=Task(max_steps=5))
        assert self.played(length=41, task=Task(max_steps=41))["steps_mean"] == 41

    def test_a_stated_length_is_waited_for_without_a_word(self, monkeypatch):
        monkeypatch.setattr("hdrqn_torchrl.runs.evaluation.PATIENCE", 20)
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            self.played(length=30, task=Task(max_steps=30))

    def test_a_wait_for_the_last_episodes_to_end_is_announced_and_has_an_end(self, monkeypatch):
        """One of two counters ends at 10, and the other one counts on."""
        monkeypatch.setattr("hdrqn_torchrl.runs.evaluation.PATIENCE", 20)
        monkeypatch.setattr("hdrqn_torchrl.runs.evaluation.LONGEST_EPISODE", 40)
        vector = SyncVectorEnv([Counter, lambda: Counter(ends=False)], autoreset_mode=AutoresetMode.DISABLED)
        with (
            pytest.warns(
                UserWarning, match=r"got 1 of 2 that have not ended after 20 steps; .* or evaluation.max_steps"
            ),
            pytest.raises(ValueError, match=r"env must end its episodes, got 1 of 2 .* after 40 steps; give it a time"),
        ):
            play(make_gym(vector, 2), always(1), episodes=2)

    @pytest.mark.parametrize(("length", "steps", "cut"), [(None, 9, 1.0), (6, 6, 0.0), (9, 9, 0.0)])
    def test_evaluations_can_cut_episodes_off_and_say_so(self, length, steps, cut):
        env = Corridor(4, length=length)
        algorithm = build("v1", env)
        result = evaluate(algorithm.transform(env), algorithm.policy, episodes=8, max_steps=9)
        assert (result["steps_mean"], result["cut_off_rate"], result["episodes"]) == (steps, cut, 8)

    def test_the_return_of_an_episode_until_its_cut_off_counts(self):
        env = Corridor(4, length=None)  # to the right end in two steps, and there it stays
        right = TensorDictModule(lambda place: torch.ones(len(place), dtype=torch.int64), ["observation"], ["action"])
        assert evaluate(env, right, episodes=4, max_steps=7)["return_mean"] == 1.0
        with pytest.raises(ValueError, match="max_steps must be >= 1 or None, got 0"):
            evaluate(env, right, episodes=4, max_steps=0)
        with pytest.raises(ValueError, match="episodes must be >= 1, got 0"):
            evaluate(env, right, episodes=0)


class StepLog:
    """Counts flags in the steps of episodes that count."""

    def __init__(self):
        self.steps = []

    def add_step(self, step, counted):
        self.steps.append(step["next"][counted].clone())

    def total(self, key):
        return sum(step[key].sum().item() for step in self.steps)


class TestPerSubgoal:
    def test_subgoals_attained_and_reached_on_a_scripted_walk_are_counted(self):
        """In a row of three cells, going right from its left end takes both goals."""
        env = subgoal_env(1, env_settings={"layout": ("#####", "#   #", "#####"), "num_obstacles": 0, "max_steps": 2})
        chosen = torch.tensor([0])
        policy = TensorDictModule(
            lambda observation: (torch.full(observation.shape[:1], RIGHT), chosen),
            ["observation"],
            ["action", "subgoal"],
        )
        played = [play(env, policy, episodes=1, seed=seed) for seed in range(40)]
        in_order = [each for each in played if each["steps"] == 2 and each["in_order"] == 1]
        assert in_order
        for each in in_order:  # the first option reaches goal 0; the second, for the goal that is gone, ends in vain
            assert each["attained"].tolist() == [[1.0, 1.0]]
            assert each["chosen"].tolist() == [[2.0, 0.0]] and each["reached"].tolist() == [[1.0, 0.0]]
        summary = summarise(in_order[0])
        assert summary["per_subgoal"] == [
            {"attained": 1.0, "options": 2.0, "success_rate": 0.5},
            {"attained": 1.0, "options": 0.0, "success_rate": None},
        ]

    def test_nearer_sets_have_figures_of_their_own(self):
        torch.manual_seed(0)
        base = house(20)
        algorithm = build("v3", base, levels=3)
        steps, env = StepLog(), algorithm.transform(base)
        random = ExplorationType.RANDOM
        played = play(env, algorithm.policy, episodes=20, observers=[steps], exploration_type=random)
        (rooms, goals), result = base.task.subgoals, summarise(played, nearer=base.task.subgoals[:-1])
        assert [each["name"] for each in result["rooms_per_subgoal"]] == list(rooms.names) and len(goals) == 2
        assert len(result["per_subgoal"]) == 2
        for name, key in (("chosen", "option_done"), ("reached", "subgoal_reached"), ("attained", "attained")):
            assert played[f"rooms_{name}"].sum() == steps.total(f"rooms_{key}") > 0
        options = sum(each["options"] for each in result["rooms_per_subgoal"])
        assert options * 20 == pytest.approx(steps.total("rooms_option_done"))

    def test_flat_agents_have_no_options(self):
        played = play(pair_env(4), always_right(), episodes=4)
        assert set(summarise(played)["per_subgoal"][0]) == {"attained"}


class TestIntervals:
    def test_more_episodes_narrow_them_around_the_mean(self):
        def width(episodes):
            summary = summarise(play(pair_env(50), always_right(), episodes=episodes, seed=1))
            low, high = summary["intervals"]["return_mean"]
            assert low < summary["return_mean"] < high
            return high - low

        assert width(50) == pytest.approx(4 * 0.5 / 50**0.5, rel=0.3)  # 1.96 standard errors of a coin, twice
        assert width(800) == pytest.approx(width(50) / 4, rel=0.3)

    def test_figures_that_never_differ_have_no_interval(self):
        """Between walls above and below nobody who goes up (0) moves."""
        intervals = summarise(play(pair_env(4), always(0), episodes=8))["intervals"]
        assert intervals["return_mean"] is None and intervals["steps_mean"] is None

    def test_one_episode_has_intervals_of_rates_only(self):
        intervals = summarise(play(pair_env(1), always_right(), episodes=1))["intervals"]
        assert intervals["return_mean"] is None
        assert intervals["success_rate"] in ([0.0, pytest.approx(0.975)], [pytest.approx(0.025), 1.0])

    def test_the_share_of_goals_in_order_is_a_mean_of_shares(self):
        """Half of two goals in every episode is no coin that fell evenly."""
        played = play(pair_env(4), always(0), episodes=8)
        played["in_order"] = torch.full((8,), 0.5)
        assert summarise(played)["intervals"]["in_order_rate"] is None
        played["in_order"] = torch.tensor([0.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 1.0])
        low, high = summarise(played)["intervals"]["in_order_rate"]
        assert (low, high) == pytest.approx((0.5 - 0.2235, 0.5 + 0.2235), abs=1e-4)  # t(7) = 2.365, s = 0.267 / sqrt 8
        played["in_order"] = torch.tensor([0.5, *[1.0] * 7])
        assert summarise(played)["intervals"]["in_order_rate"][1] == 1.0

    def test_a_rate_of_0_or_1_has_an_interval(self):
        """Between walls above and below nobody who goes up (0) moves."""
        played = play(pair_env(50), always(0), episodes=100)
        low, high = summarise(played)["intervals"]["success_rate"]
        assert low == 0.0 and high == pytest.approx(1 - 0.025 ** (1 / 100))
        played["success"] = torch.ones(100)
        assert summarise(played)["intervals"]["success_rate"] == [pytest.approx(0.025 ** (1 / 100)), 1.0]


def test_observers_see_every_step_and_know_those_of_episodes_that_count():
    class Steps:
        seen = counted = 0

        def add_step(self, step, counted):
            self.seen += step.numel()
            self.counted += int(counted.sum())
            assert step["next", "done"].shape == (4, 1)

    steps = Steps()
    played = play(pair_env(4), always_right(), episodes=40, observers=[steps])
    assert steps.seen > steps.counted == played["steps"].sum()  # who was lucky at once went on while the others played


@pytest.mark.parametrize("levels", [2, 3])
def test_options_that_an_evaluation_cuts_off_count_as_those_that_did_not_reach_their_subgoal(levels):
    class Begun:
        options = 0

        def add_step(self, step, counted):
            self.options += int((step[prefix + "option_init"].squeeze(-1) & counted).sum())

    torch.manual_seed(0)
    env, prefix = (small_env(16, max_steps=40), "") if levels == 2 else (house(16), "rooms_")
    algorithm = build("v2", env, levels=levels)
    legs, begun = LegCounter(2), Begun()
    random = {"exploration_type": ExplorationType.RANDOM, "max_steps": 5}
    played = play(algorithm.transform(env), algorithm.policy, episodes=16, observers=[legs, begun], **random)
    assert played["cut_off"].sum() > 10
    assert played[prefix + "chosen"].sum() == begun.options >= 16 > played[prefix + "reached"].sum()
    assert legs.options.sum(0).tolist() == played["chosen"].sum(0).tolist()


def test_legs_are_those_of_the_episodes_that_are_reported():
    torch.manual_seed(0)
    env = small_env(16, max_steps=40)
    algorithm = build("v2", env)
    legs = LegCounter(num_subgoals=2)
    random = {"exploration_type": ExplorationType.RANDOM}
    played = play(algorithm.transform(env), algorithm.policy, episodes=32, observers=[legs], **random)
    assert legs.options.sum(0).tolist() == played["chosen"].sum(0).tolist()
    assert legs.reached.sum(0).tolist() == played["reached"].sum(0).tolist()
    assert played["steps"].min() < 40  # some were done early


def test_places_outside_the_screen_count_at_its_edge():
    places = PlaceCounter(5, 6, cell=2)  # 3 rows of 3
    position = torch.tensor([[0.0, 0.0], [-3.0, 1.9], [99.0, 4.0], [3.0, 99.0]])
    places.add_step(TensorDict({"next": {"position": position}}, [4]))
    assert places.counts.tolist() == [[2, 0, 0], [0, 0, 0], [0, 1, 1]]
    places.add_step(TensorDict({"next": {"position": position}}, [4]), torch.tensor([True, False, False, False]))
    assert places.counts.tolist() == [[3, 0, 0], [0, 0, 0], [0, 1, 1]]
