"""What tasks state about themselves."""

import math
import pickle
from dataclasses import replace
from functools import partial

import gymnasium
import pytest
import torch
from helpers import small_env
from torchrl.envs import GymWrapper, ParallelEnv, RewardScaling, RewardSum, SerialEnv, StepCounter, TransformedEnv

from hdrqn_torchrl.envs import MultiGoalGridEnv, Task, task_of


def cart_pole(max_steps: int | None = 37) -> GymWrapper:
    return GymWrapper(gymnasium.make("CartPole-v1", max_episode_steps=max_steps), categorical_action_encoding=True)


class Counting(gymnasium.Env):
    """A stock environment with an unrelated attribute ``task``."""

    observation_space, action_space = gymnasium.spaces.Discrete(3), gymnasium.spaces.Discrete(2)
    task = "count"

    def reset(self, *, seed=None, options=None):
        return 0, {}

    def step(self, action):
        return 0, 0.0, False, False, {}


class Stating(Counting):
    task = Task(largest_return=7.0)


class TestWhatIsFound:
    def test_the_grid_states_its_length_its_returns_and_its_order(self):
        task = task_of(small_env(2, num_goals=3, max_steps=9))
        assert (task.max_steps, task.largest_return) == (9, 3.0)
        assert (task.smallest_extrinsic_return, task.largest_extrinsic_return) == (0.0, 3.0)
        assert task.ordered and task.ceiling == "memory" and task.actions == ("up", "down", "left", "right")

    def test_an_environment_without_a_statement_has_an_unknown_task(self):
        assert task_of(GymWrapper(Counting(), categorical_action_encoding=True)) == Task()

    @pytest.mark.parametrize("limit, expected", [(5, 5), (50, 9)])
    def test_a_step_counter_shortens_episodes_and_never_lengthens_them(self, limit, expected):
        env = TransformedEnv(TransformedEnv(small_env(2, max_steps=9)), StepCounter(max_steps=limit))
        assert task_of(env).max_steps == expected

    def test_a_step_counter_without_a_limit_changes_nothing(self):
        assert task_of(TransformedEnv(cart_pole(None), StepCounter())).max_steps == 500  # CartPole's own

    def test_rewards_that_a_transform_changes_are_unknown(self):
        grid = task_of(small_env(2))
        task = task_of(TransformedEnv(small_env(2), RewardScaling(0.0, 5.0)))
        assert task == replace(grid.without_references(), largest_return=math.inf)
        task = task_of(TransformedEnv(small_env(2), RewardScaling(0.0, 5.0, in_keys=["extrinsic_reward"])))
        assert task == replace(grid, largest_extrinsic_return=math.inf, smallest_extrinsic_return=-math.inf)
        assert task_of(TransformedEnv(small_env(2), RewardSum(["reward"], ["episode_reward"]))) == grid

    def test_gymnasium_s_time_limit_is_known(self):
        assert task_of(cart_pole(37)) == Task(max_steps=37)

    def test_a_gymnasium_environment_can_state_a_task(self):
        env = GymWrapper(gymnasium.wrappers.TimeLimit(Stating(), 11), categorical_action_encoding=True)
        assert task_of(env) == Task(largest_return=7.0, max_steps=11)

    @pytest.mark.parametrize("batch", [SerialEnv, ParallelEnv])
    def test_batches_of_environments_state_the_task_of_the_first(self, batch):
        env = batch(2, partial(MultiGoalGridEnv, 1, num_goals=3))
        generator = torch.get_rng_state()
        task = task_of(env)
        assert (task.max_steps, task.largest_return) == (50, 3.0)
        assert torch.equal(torch.get_rng_state(), generator)

    def test_a_task_can_be_pickled(self):
        task = task_of(small_env(2))
        assert pickle.loads(pickle.dumps(task)) == task


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"max_steps": 0}, "max_steps must be a whole number >= 1 or None, got 0"),
        ({"max_steps": "400"}, "max_steps must be a whole number >= 1 or None, got '400'"),
        ({"max_steps": 2.5}, "max_steps must be a whole number >= 1 or None, got 2.5"),
        ({"largest_return": math.nan}, "largest_return must be a number, got nan; leave out what is not known."),
        ({"largest_return": None}, "largest_return must be a number, got None; leave out what is not known."),
        ({"smallest_extrinsic_return": "0"}, "smallest_extrinsic_return must be a number, got '0'"),
        ({"ordered": "yes"}, "ordered must be True or False, got 'yes'"),
        ({"success": 3}, "success must be the name of an entry, got 3"),
        ({"actions": "up"}, "actions must be distinct, non-empty strings, got 'up'"),
        ({"scene": "picture"}, "scene must be a function or None, got 'picture'"),
        ({"references": {"hero": 2.0}}, "references must be {.*}, got {'hero': 2.0}"),
        ({"ceiling": "hero"}, r"ceiling must be one of the references \[\], got 'hero'"),
        (
            {"largest_extrinsic_return": -1.0, "smallest_extrinsic_return": 0.0},
            "smallest_extrinsic_return must be <= largest_extrinsic_return=-1.0, got 0.0",
        ),
    ],
)
def test_what_can_not_be_so_is_refused_where_it_is_stated(settings, message):
    with pytest.raises(ValueError, match=message):
        Task(**settings)
