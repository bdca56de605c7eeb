"""Batches that do not go on where the last one ended."""

from functools import partial

import pytest
import torch
from helpers import build, collect, make_collector, small_env
from tensordict import TensorDict
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import StepCounter, TransformedEnv
from user_envs import Corridor

from hdrqn_torchrl.data import Continuity

HIERARCHICAL = ["hdqn", "v1", "v2", "v3"]
EVERY = ["dqn", "drqn", *HIERARCHICAL]


def many_batches(name="v2", num_envs=4, steps=3, batches=16):
    env = small_env(num_envs)
    algorithm = build(name, env)
    return algorithm, collect(algorithm, env, steps, batches)


class TestOneCollector:
    @pytest.mark.parametrize("steps", [1, 2, 7, 20])
    def test_batches_of_one_collector_are_accepted(self, steps):
        continuity = Continuity()
        for batch in many_batches(steps=steps)[1]:
            continuity.check(batch)

    def test_batches_of_a_collector_that_starts_again_are_accepted(self):
        continuity, (algorithm, batches) = Continuity(), many_batches()
        collector = make_collector(algorithm, small_env(4), 5)
        for batch, _ in zip(collector, range(3), strict=False):
            continuity.check(batch.clone())
            collector.reset()
        for batch in batches:
            continuity.check(batch)

    def test_a_loaded_learner_accepts_any_first_batch(self):
        algorithm, batches = many_batches("drqn")
        learner = algorithm.learners["flat"]
        for batch in batches[:4]:
            learner.store(batch)
        state = learner.state_dict()
        learner.load_state_dict(state)
        learner.store(batches[-1])


class TestSeveralCollectors:
    @pytest.mark.parametrize("name", EVERY)
    def test_alternating_batches_of_two_collectors_are_refused_by_every_learner(self, name):
        algorithm, first = many_batches(name)
        second = many_batches(name)[1]
        for batch in second:
            batch["collector", "traj_ids"] += 1000
        with pytest.raises(ValueError, match=r"batch must go on where the last one ended, .* give one Collector"):
            for pair in zip(first, second, strict=True):
                for batch in pair:
                    algorithm.observe(batch)

    def test_rows_of_two_collectors_in_one_batch_are_refused(self):
        first, second = (many_batches(num_envs=2)[1][-1] for _ in range(2))
        second["collector", "traj_ids"] += 1000
        Continuity().check(torch.cat([first, second], 0))  # side by side they are worlds like others
        second["is_init"][:, 0] = first["next", "done"][:, -1] = False
        with pytest.raises(ValueError, match=r"got the middle of episode 10\d\d after .* \(environment 0, step 3\)"):
            Continuity().check(torch.cat([first, second], 1))

    def test_a_missing_batch_is_noticed_if_an_episode_ended_in_it(self):
        batches = many_batches(steps=5)[1]
        continuity = Continuity()
        with pytest.raises(ValueError, match="batch must go on where the last one ended"):
            for batch in batches[::2]:
                continuity.check(batch)

    @pytest.mark.parametrize(
        ("name", "option", "message"),
        [
            (
                "drqn",
                "set_truncated",
                "batch must begin a new episode where one is over, .* without set_truncated",
            ),
            ("v2", "set_truncated", r"each end of an episode must end its option, .* Collector\(set_truncated=True\)"),
            ("v2", "compact_obs", "batch must hold all that environment and policy wrote, .* without compact_obs"),
            ("v3", "compact_obs", "batch must hold all that environment and policy wrote, .* without compact_obs"),
        ],
    )
    def test_collector_options_that_alter_the_episodes_are_refused(self, name, option, message):
        env = Corridor(4, length=7)
        algorithm = build(name, env)
        collector = make_collector_of(algorithm.transform(env), algorithm, **{option: True})
        with pytest.raises(ValueError, match=message):
            for batch, _ in zip(collector, range(3), strict=False):
                algorithm.observe(batch)

    def test_a_flat_agent_needs_no_observation_under_next(self):
        env = Corridor(4, length=7)
        algorithm = build("drqn", env)
        collector = make_collector_of(algorithm.transform(env), algorithm, compact_obs=True)
        for batch, _ in zip(collector, range(3), strict=False):
            assert "observation" not in batch["next"]
            algorithm.observe(batch)
        assert torch.isfinite(algorithm.learners["flat"].learn()["loss"])

    @pytest.mark.parametrize("shape", [(2, 4, 3), (12,)])
    def test_stacked_and_flat_batches_are_refused(self, shape):
        batch = many_batches(batches=1)[1][0]
        batch = torch.stack([batch, batch]) if len(shape) == 3 else batch.reshape(-1)
        with pytest.raises(ValueError, match=r"batch must be \[N, T\], N environments and T steps of each, got"):
            Continuity().check(batch)

    def test_another_number_of_environments_is_refused(self):
        continuity = Continuity()
        continuity.check(many_batches(num_envs=4, batches=1)[1][0])
        with pytest.raises(ValueError, match="batch must hold the same 4 environments, got 2"):
            continuity.check(many_batches(num_envs=2, batches=1)[1][0])

    def test_episodes_must_be_numbered(self):
        batch = many_batches(batches=1)[1][0].exclude("collector")
        with pytest.raises(ValueError, match=r"use Collector\(track_traj_ids=True\)"):
            Continuity().check(batch)

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", [MultiSyncCollector, MultiAsyncCollector])
    def test_collectors_of_several_processes_are_refused_with_a_message(self, kind):
        algorithm = build("v1", small_env(2))
        make = partial(seen_by, algorithm.make_transforms)
        collector = kind(
            [make, make], algorithm.policy, frames_per_batch=8, total_frames=400, auto_register_policy_transforms=False
        )
        with pytest.raises(ValueError, match="give one Collector all environments"):
            for batch in collector:
                algorithm.observe(batch)
        collector.shutdown()


class TestTimeLimits:
    """An end of an episode that the option book does not see would leave options open."""

    @pytest.mark.parametrize("name", HIERARCHICAL)
    @pytest.mark.parametrize("where", ["collector", "behind the agent's transforms"])
    def test_a_time_limit_behind_the_option_book_is_refused(self, name, where):
        env = Corridor(4, length=None)
        algorithm = build(name, env)
        seen, limit = algorithm.transform(env), {}
        if where == "collector":
            limit = {"max_frames_per_traj": 5}
        else:
            seen = TransformedEnv(seen, StepCounter(max_steps=5))
        collector = make_collector_of(seen, algorithm, **limit)
        with pytest.raises(ValueError, match=r"each end of an episode must end its option, .*StepCounter\(max_steps="):
            for batch, _ in zip(collector, range(4), strict=False):
                algorithm.observe(batch)

    @pytest.mark.parametrize("name", EVERY)
    def test_a_time_limit_before_the_option_book_is_accepted(self, name):
        env = TransformedEnv(Corridor(4, length=None), StepCounter(max_steps=5))
        algorithm = build(name, env)
        assert algorithm.task.max_steps == 5
        for batch in collect(algorithm, env, 8, 3):
            algorithm.observe(batch)
            after = batch["next"]
            if name in HIERARCHICAL:
                assert after["option_done"][after["done"]].all() and after["done"].any()
        for learner in algorithm.learners.values():
            assert torch.isfinite(learner.learn()["loss"])

    @pytest.mark.parametrize("name", ["dqn", "drqn"])
    def test_flat_agents_accept_a_time_limit_anywhere(self, name):
        env = Corridor(4, length=None)
        algorithm = build(name, env)
        collector = make_collector_of(algorithm.transform(env), algorithm, max_frames_per_traj=5)
        for batch, _ in zip(collector, range(4), strict=False):
            algorithm.observe(batch)


def seen_by(make_transforms):
    return TransformedEnv(small_env(2), make_transforms())


def make_collector_of(env, algorithm, **settings):
    return Collector(env, algorithm.policy, frames_per_batch=32, auto_register_policy_transforms=False, **settings)


@pytest.mark.parametrize("name", ["drqn", "v1", "v2", "v3"])
def test_steps_that_the_policy_did_not_take_are_refused(name):
    """Its memory, and what it did, would be stored as if nothing had happened."""
    env = small_env(4)
    algorithm = build(name, env)
    sizes = {"frames_per_batch": 32, "total_frames": 64, "init_random_frames": 32}
    collector = Collector(algorithm.transform(env), algorithm.policy, **sizes, auto_register_policy_transforms=False)
    with pytest.raises(ValueError, match=r"policy must act in every step.* without init_random_frames"):
        algorithm.observe(next(iter(collector)))
    collector.shutdown()


def test_a_memory_that_has_come_to_rest_in_mid_episode_is_accepted():
    """Where all inputs are the same, it does; and a resumed training begins there."""
    no, memory = torch.zeros(2, 3, 1, dtype=torch.bool), torch.ones(2, 3, 4)
    batch = {"collector": {"traj_ids": torch.zeros(2, 3, dtype=torch.int64)}, "is_init": no, "next": {"done": no}}
    Continuity(memory_key="memory").check(TensorDict(batch | {"memory": memory}, [2, 3]))
