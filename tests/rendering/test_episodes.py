from functools import cache

import pytest
import torch
from helpers import RIGHT, build, small_env
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type
from torchrl.envs.transforms import ExcludeTransform
from walk import FLAT, SECOND_GOAL, TWO_LEVELS, make_agent, walk

from hdrqn_torchrl.rendering import Score, record_episodes


def recorded(name, *, episodes=1, seed=0, epsilon=0.0):
    """Environment, agent and frames of an untrained agent in the 3x3 room."""
    env = small_env(1, max_steps=12)
    agent = make_agent(name, env)
    env = agent.transform(env)
    return env, agent, record_episodes(env, agent, episodes=episodes, seed=seed, epsilon=epsilon)


def rollouts_of(env, agent, *, episodes, seed, epsilon):
    """The same episodes by TorchRL's own rollout."""
    for exploration in agent.explorations.values():
        exploration.epsilon.fill_(epsilon)
    env.set_seed(seed)
    torch.manual_seed(seed)
    kind = ExplorationType.RANDOM if epsilon else ExplorationType.DETERMINISTIC
    with set_exploration_type(kind), torch.no_grad():
        return [env.rollout(99, agent.policy)[0] for _ in range(episodes)]


@cache
def recorded_and_replayed(name, epsilon):
    """Rules, policy, the frames of every episode, and the steps ``[T]`` of its replay."""
    settings = {"episodes": 8 if epsilon else 2, "seed": 3, "epsilon": epsilon}
    env, agent, frames = recorded(name, **settings)
    pairs = list(zip(episodes_of(frames), rollouts_of(env, agent, **settings), strict=True))
    return env.base_env.rules, agent.policy, pairs


def episodes_of(frames):
    numbers = sorted({frame.episode for frame in frames})
    return [[frame for frame in frames if frame.episode == number] for number in numbers]


def facts(frame):
    """What can be compared with ``==``."""
    return frame.score, frame.action, frame.pursuits, frame.event, frame.outcome, frame.scene.state.agent.item()


def values_in_one_pass(name, policy, steps):
    """Q-values of actions ``[T, A]`` and, where options start, of subgoals ``[M, G]``, as learning computes them."""
    starts = steps["option_init"].squeeze(-1) if name not in FLAT else steps["is_init"].squeeze(-1)
    observation = steps["observation"][None]
    if name in FLAT:
        return policy.network.unroll(observation, None, starts[None])[0], None
    if name == "v3":
        given = (steps[key][None] for key in ("previous_action", "is_init", "subgoal_mask"))
        previous, init, mask = given
        (actions, subgoals), _ = policy.network.unroll(observation, previous, init.squeeze(-1), [mask])
        return actions[0, torch.arange(len(steps)), steps["subgoal"]], subgoals[0, starts, 0]
    inputs = steps[starts]["sub_hidden" if name == "v2" else "observation"][None]
    actions = policy.sub_controller.network.unroll(observation, steps["subgoal"][None], starts[None])
    return actions[0], policy.meta_controller.network.unroll(inputs)[0]


@pytest.mark.parametrize("epsilon", [0.0, 0.9])
@pytest.mark.parametrize("name", [*FLAT, *TWO_LEVELS])
class TestReplay:
    def test_worlds_actions_and_rewards_equal_an_independent_replay(self, name, epsilon):
        rules, _, pairs = recorded_and_replayed(name, epsilon)
        assert any(len(steps) < 12 for _, steps in pairs) or not epsilon
        for played, steps in pairs:
            last = steps[-1]["next"]
            assert len(played) == len(steps) + 1
            seen = torch.cat([rules.observe(frame.scene.state) for frame in played])
            assert (seen == torch.cat([steps["observation"], last["observation"][None]])).all()
            assert [frame.action.choice for frame in played[:-1]] == steps["action"].tolist()
            for key, entry in (
                ("reward", "total"),
                ("extrinsic_reward", "extrinsic"),
                ("intrinsic_reward", "intrinsic"),
            ):
                if ("next", key) in steps.keys(True):
                    sums = torch.cat([torch.zeros(1), steps["next", key].squeeze(-1).cumsum(0)])
                    found = torch.tensor([getattr(frame.score, entry) for frame in played])
                    torch.testing.assert_close(found, sums)
            assert played[-1].score.reached == tuple(steps["next", "attained"].any(0).tolist())
            assert played[-1].success == bool(last["success"])
            assert [bool(frame.outcome) for frame in played] == [False] * len(steps) + [True]

    def test_q_values_equal_those_that_the_controllers_compute(self, name, epsilon):
        _, policy, pairs = recorded_and_replayed(name, epsilon)
        for played, steps in pairs:
            with torch.no_grad():
                actions, subgoals = values_in_one_pass(name, policy, steps)
            torch.testing.assert_close(torch.tensor([frame.action.values for frame in played[:-1]]), actions)
            if name in FLAT:
                assert {frame.subgoal for frame in played} == {None}
                continue
            chosen, starts = [frame for frame in played if frame.starts_option], steps[steps["option_init"].squeeze(-1)]
            torch.testing.assert_close(torch.tensor([frame.subgoal.values for frame in chosen]), subgoals)
            assert [list(frame.subgoal.allowed) for frame in chosen] == starts["subgoal_mask"].tolist()
            assert [frame.subgoal.choice for frame in played[:-1]] == steps["subgoal"].tolist()


@pytest.mark.parametrize("name", [*FLAT, *TWO_LEVELS])
def test_greedy_choices_are_the_best_of_the_shown_values(name):
    frames = recorded(name, episodes=4)[2]
    for decision in [decision for frame in frames for decision in (frame.action, frame.subgoal) if decision]:
        allowed = [value for value, ok in zip(decision.values, decision.allowed, strict=True) if ok]
        assert decision.values[decision.choice] == max(allowed)
        assert not decision.explores
    frames = recorded(name, episodes=4, epsilon=1.0)[2]
    assert {frame.action.explores for frame in frames} == {True, False}
    assert name in FLAT or {frame.subgoal.explores for frame in frames} == {True, False}


def test_one_seed_repeats_and_another_differs():
    env, agent, first = recorded("v2", seed=4, epsilon=0.5, episodes=2)
    again, other = (record_episodes(env, agent, seed=seed, epsilon=0.5, episodes=2) for seed in (4, 5))
    assert [facts(frame) for frame in first] == [facts(frame) for frame in again]
    assert [facts(frame) for frame in first] != [facts(frame) for frame in other]


def test_a_task_without_subgoals_hazard_or_success_can_be_watched():
    optional = ("attained", "hazard", "success", "extrinsic_reward")
    env = TransformedEnv(small_env(1), ExcludeTransform(*optional))
    agent = make_agent("drqn", env)
    *played, last = record_episodes(agent.transform(env), agent)
    assert last.outcome and not last.success and last.score.reached == ()
    assert last.score.extrinsic == last.score.total and not any(frame.event for frame in played)


def test_recording_does_not_change_the_agent_or_the_global_generator():
    env = small_env(1)
    agent = build("v2", env)
    agent.explorations["sub"].step(12_345)
    before = {key: value.clone() for key, value in agent.policy.state_dict().items()}
    generator = torch.get_rng_state()
    record_episodes(agent.transform(env), agent, epsilon=0.5)
    after = agent.policy.state_dict()
    assert all((before[key] == after[key]).all() for key in before)
    assert (generator == torch.get_rng_state()).all()
    assert not any(getattr(part, "writes_values", False) for part in agent.policy.modules())


class TestWalk:
    """Everything below is computed by hand: obstacle, goal 1 and goal 2 stand in a row to the agent's right."""

    def test_scores_of_a_scripted_walk(self):
        none, one, both = (False, False), (True, False), (True, True)
        assert [frame.score for frame in walk("v2")] == [
            Score(none, 0.0),
            Score(none, -1.0, steps=1, total=-1.0, option_intrinsic=-1.0),
            Score(one, 0.0, steps=2, total=0.0, extrinsic=1.0),  # a new option
            Score(both, 1.0, steps=3, total=1.0, extrinsic=2.0, option_intrinsic=1.0),
        ]
        assert [frame.score.intrinsic for frame in walk("drqn")] == [None] * 4
        assert [frame.score.total for frame in walk("drqn")] == [0.0, -1.0, 0.0, 1.0]

    def test_decisions_and_options_of_a_scripted_walk(self):
        frames = walk("v2")
        assert [frame.starts_option for frame in frames] == [True, False, True, False]
        assert [frame.subgoal.choice for frame in frames] == [0, 0, 1, 1]
        assert [frame.scene.subgoal for frame in frames] == [0, 0, 1, 1]
        assert [frame.subgoal.allowed for frame in frames] == [(True, True)] * 2 + [(False, True)] * 2
        assert {frame.subgoal.values for frame in frames} == {(1.0, 0.5)}
        assert {frame.action.values for frame in frames} == {(0.0, -0.125, 0.25, 0.5)}
        assert [frame.scene.action for frame in frames] == [RIGHT] * 3 + [None]
        assert [frame.scene.state.agent.item() for frame in frames] == [7, 8, 9, 10]

    def test_events_and_end_of_a_scripted_walk(self):
        frames = walk("v2")
        events = ["", "obstacle hit", "goal 1 reached, rᵉˣ +1.00", "goal 2 reached, rᵉˣ +1.00"]
        assert [frame.event for frame in frames] == events
        assert [frame.outcome for frame in frames] == ["", "", "", "both goals in order"]
        assert [frame.success for frame in frames] == [False, False, False, True]
        assert {(frame.episode, frame.episodes, frame.max_steps) for frame in frames} == {(1, 1, 9)}

    def test_goals_reached_out_of_order_are_marked(self):
        frames = walk("v2", objects=torch.tensor([[8, 10, 9]]))
        events = ["", "obstacle hit", "goal 2 reached, rᵉˣ +0.01", "goal 1 reached, rᵉˣ +0.01"]
        assert [frame.event for frame in frames] == events
        assert [frame.starts_option for frame in frames] == [True, False, False, False]  # it wants goal 1 all the time
        assert (frames[-1].outcome, frames[-1].success) == ("all goals, but not in order", False)

    def test_reaching_another_goal_does_not_end_the_option(self):
        frames = walk("v2", wants=SECOND_GOAL)
        assert [frame.subgoal.choice for frame in frames] == [1, 1, 1, 1]
        assert [frame.pursuits[0].steps for frame in frames] == [0, 1, 2, 3]
        assert frames[-1].score.intrinsic == 0.0 and frames[-1].score.extrinsic == 2.0

    def test_time_limits_of_options_and_episodes_are_shown(self):
        frames = walk("v2", max_steps=2)
        assert (len(frames), frames[-1].outcome, frames[-1].max_steps) == (3, "time is up", 2)
        frames = walk("v2", options={"max_option_steps": 1})
        assert [frame.event for frame in frames][:2] == ["", "obstacle hit, option given up"]
        assert [frame.starts_option for frame in frames] == [True, True, True, False]

    def test_several_episodes_are_counted(self):
        frames = walk("hdqn", recording={"episodes": 3})
        assert [frame.episode for frame in frames] == [1] * 4 + [2] * 4 + [3] * 4
        assert {frame.episodes for frame in frames} == {3}
        assert [facts(frame) for frame in frames[:4]] == [facts(frame) for frame in frames[4:8]]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes": 0}, "episodes must be >= 1, got 0"),
        ({"max_steps": 0}, "max_steps must be >= 1 or None, got 0"),
        ({"epsilon": 1.5}, r"epsilon must lie in \[0, 1\], got 1.5"),
        ({"epsilon": -0.1}, "epsilon must lie"),
    ],
)
def test_wrong_arguments_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        walk("v2", recording=changes)


def test_only_one_world_can_be_recorded():
    env = small_env(2)
    agent = build("v2", env)
    with pytest.raises(ValueError, match=r"env must have batch size \[1\], got \[2\]"):
        record_episodes(agent.transform(env), agent)
