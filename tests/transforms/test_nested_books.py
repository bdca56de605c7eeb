"""Two option books at once, on random streams, against plain loops over Python numbers."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical, Composite
from torchrl.envs import Compose, EnvBase, InitTracker, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from hdrqn_torchrl.envs.specs import episode_ends, flags, rewards
from hdrqn_torchrl.transforms import SubgoalTransform

FAR, NEAR = 2, 3
SIZES = {"attained": FAR, "rooms_attained": NEAR, "rooms_available": NEAR, "hazard": 1}
CARRIED = ["option_init", "active_subgoal", "subgoal_mask", "option_steps", "option_return"]
OUTCOMES = [*CARRIED, "subgoal_reached", "option_done", "option_terminated", "intrinsic_reward"]


class Stream(EnvBase):
    """Chance alone decides what is attained, paid and ended."""

    def __init__(self, num_envs, seed=0):
        super().__init__(batch_size=[num_envs])
        self.observation_spec = Composite(
            {name: flags(num_envs, size) for name, size in SIZES.items()}, shape=(num_envs,)
        )
        self.action_spec = Categorical(2, shape=(num_envs,), dtype=torch.int64)
        self.reward_spec, self.done_spec = rewards(num_envs), episode_ends(num_envs)
        self._generator = torch.Generator().manual_seed(seed)

    def _flags(self, size, share):
        return torch.rand(*self.batch_size, size, generator=self._generator) < share

    def _reset(self, tensordict=None, **kwargs):
        start = {name: torch.zeros(*self.batch_size, size, dtype=torch.bool) for name, size in SIZES.items()}
        start["rooms_available"] = ~start["rooms_available"]
        return TensorDict({**start, **self.done_spec.zero()}, self.batch_size)

    def _step(self, tensordict):
        outcome = {name: self._flags(size, 0.15) for name, size in SIZES.items()}
        outcome["rooms_available"] = self._flags(NEAR, 0.9)
        terminated, truncated = self._flags(1, 0.04), self._flags(1, 0.04)
        outcome |= {"terminated": terminated, "truncated": truncated & ~terminated, "done": terminated | truncated}
        pay = torch.randint(-2, 3, (*self.batch_size, 1), generator=self._generator) / 4
        return TensorDict({**outcome, "reward": pay, "extrinsic_reward": pay.clone()}, self.batch_size)

    def _set_seed(self, seed):
        self._generator.manual_seed(seed)


def books(**near):
    far = SubgoalTransform(FAR, gamma=0.5, max_option_steps=9, wrong_subgoal_reward=-0.5)
    settings = {"max_option_steps": 4, "hazard_reward": -0.25, "gamma": 0.75} | near
    return far, SubgoalTransform(
        NEAR,
        prefix="rooms",
        upper_done_key="option_done",
        upper_terminated_key="option_terminated",
        extrinsic_reward_key="intrinsic_reward",
        **settings,
    )


def make_env(num_envs=4, **near):
    return TransformedEnv(Stream(num_envs), Compose(InitTracker(), *books(**near)))


class Book:
    """One option book of one environment, in Python numbers."""

    def __init__(self, prefix, size, book):
        self.prefix, self.size, self.book = prefix, size, book
        self.mask, self.subgoal, self.steps, self.collected, self.init = [True] * size, 0, 0, 0.0, True

    def step(self, root, after, upper_done, upper_terminated, pay):
        """Takes one step; returns what should have been written."""
        if self.init:
            self.subgoal, self.steps, self.collected = root[self.prefix + "subgoal"].item(), 0, 0.0
        self.collected += self.book.gamma**self.steps * pay
        self.steps += 1
        attained = after[self.prefix + "attained"].tolist()
        reached, terminated = attained[self.subgoal], after["terminated"].item()
        was, reward = self.mask[self.subgoal], self.book.reward
        intrinsic = reward.reached * reached + reward.hazard * after["hazard"].item()
        intrinsic += reward.wrong_subgoal * (sum(attained) > reached)
        if self.book.available_key:
            self.mask = after[self.book.available_key].tolist()
        elif not self.book.repeatable:
            self.mask = [left and not now for left, now in zip(self.mask, attained, strict=True)]
        gone = not was or not self.mask[self.subgoal]
        terminated = terminated or (was and gone and not reached and not after["done"].item()) or upper_terminated
        done = reached or gone or upper_done or after["done"].item() or self.steps >= self.book.max_option_steps
        self.init = done
        values = (done, self.subgoal, self.mask, self.steps, self.collected, reached, done, reached or terminated)
        return {self.prefix + key: value for key, value in zip(OUTCOMES, (*values, intrinsic), strict=True)}


@pytest.mark.parametrize(
    "near", [{}, {"repeatable": True}, {"available_key": "rooms_available"}, {"max_option_steps": 50}], ids=str
)
def test_two_books_agree_with_plain_loops(near):
    torch.manual_seed(0)
    steps = make_env(8, **near).rollout(300, break_when_any_done=False)
    seen = set()
    for row in steps:
        far, nearer = (
            Book(prefix, size, book)
            for prefix, size, book in zip(("", "rooms_"), (FAR, NEAR), books(**near), strict=True)
        )
        for step in row:
            if step["is_init"]:
                far, nearer = Book("", FAR, far.book), Book("rooms_", NEAR, nearer.book)
            assert (step["option_init"].item(), step["rooms_option_init"].item()) == (far.init, nearer.init)
            assert nearer.init or not far.init  # who starts above starts below
            expected = far.step(step, step["next"], False, False, step["next", "extrinsic_reward"].item())
            expected |= nearer.step(
                step, step["next"], *(expected[key] for key in ("option_done", "option_terminated", "intrinsic_reward"))
            )
            for key, value in expected.items():
                found = step["next", key]
                torch.testing.assert_close(found.float().view(-1), torch.tensor(value).float().view(-1), msg=key)
            seen.add((far.init, nearer.init, step["next", "rooms_option_terminated"].item()))
    assert seen >= {(True, True, False), (True, True, True), (False, True, True), (False, False, False)}


class TestSpecs:
    def test_the_specs_of_two_books_are_right(self):
        check_env_specs(make_env())

    def test_the_specs_of_two_books_are_right_inside_a_serial_env(self):
        check_env_specs(SerialEnv(2, make_env))

    def test_the_specs_of_two_books_are_right_around_a_serial_env(self):
        check_env_specs(TransformedEnv(SerialEnv(2, partial(Stream, 3)), Compose(InitTracker(), *books())))

    def test_the_specs_of_two_books_are_right_inside_a_parallel_env(self):
        env = ParallelEnv(2, make_env, mp_start_method="fork")
        try:
            steps = env.rollout(20, break_when_any_done=False)
            assert (steps["rooms_option_init"][..., 1:, :] == steps["next", "rooms_option_done"][..., :-1, :]).all()
            assert steps["next", "rooms_option_done"][steps["next", "option_done"]].all()
        finally:
            env.close()

    def test_a_partial_reset_leaves_the_neighbours_books_alone(self):
        env = make_env(3)
        before = step_mdp(env.rollout(5, break_when_any_done=False)[:, -1])
        request = before.clone().set("_reset", torch.tensor([[False], [True], [False]]))
        after = env.reset(request)
        for prefix in ("", "rooms_"):
            for key in CARRIED:
                assert (after[prefix + key][[0, 2]] == before[prefix + key][[0, 2]]).all(), key
            assert after[prefix + "option_init"][1] and after[prefix + "subgoal_mask"][1].all()
            assert after[prefix + "option_steps"][1] == after[prefix + "option_return"][1] == 0

    def test_the_upper_book_must_come_first(self):
        with pytest.raises(ValueError, match=r"'option_done' must be \[2, 1\] bool, it is missing"):
            TransformedEnv(Stream(2), Compose(*reversed(books()))).rollout(2)
