from functools import partial

import pytest
import torch
from helpers import AGENT, CORRIDOR, LEFT, OBJECTS, RIGHT, small_env, subgoal_env
from torchrl.data import Binary
from torchrl.envs import Compose, ParallelEnv, SerialEnv, StepCounter, Transform, TransformedEnv
from torchrl.envs.transforms import RenameTransform
from torchrl.envs.utils import check_env_specs, step_mdp

from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.transforms import SubgoalTransform

CARRIED = ["option_init", "active_subgoal", "subgoal_mask", "option_steps", "option_return"]
WRITTEN = [*CARRIED, "subgoal_reached", "option_done", "option_terminated", "intrinsic_reward"]


def play(proposals, actions=None, *, max_steps=50, before=(), **settings):
    """Walks right along the corridor (obstacle, goal 0, goal 1); returns what each step reported."""
    base = MultiGoalGridEnv(1, layout=CORRIDOR, num_obstacles=1, max_steps=max_steps, seed=0)
    env = TransformedEnv(base, Compose(*before, SubgoalTransform(num_subgoals=2, **settings)))
    td = env.reset()
    base.set_world(AGENT, OBJECTS)
    steps = []
    for proposal, action in zip(proposals, actions or [RIGHT] * len(proposals), strict=True):
        td["subgoal"], td["action"] = torch.tensor([proposal]), torch.tensor([action])
        td = env.step(td)
        steps.append(td["next"])
        td = step_mdp(td)
    return steps


def column(steps, key):
    return [round(step[key].float().item(), 6) for step in steps]


class TestNumbers:
    def test_the_book_of_an_option_that_reaches_its_subgoal(self):
        steps = play([0, 0, 1], gamma=0.5)
        assert column(steps, "intrinsic_reward") == [-1.0, 1.0, 1.0]
        assert column(steps, "option_steps") == [1, 2, 1]
        assert column(steps, "option_return") == [0.0, 0.5, 1.0]
        assert column(steps, "subgoal_reached") == [0, 1, 1]
        assert column(steps, "option_done") == column(steps, "option_init") == [0, 1, 1]
        assert column(steps, "option_terminated") == [0, 1, 1]
        assert [step["subgoal_mask"].tolist() for step in steps] == [[[True, True]], [[False, True]], [[False, False]]]

    def test_the_book_of_an_option_that_passes_over_another_goal(self):
        steps = play([1, 1, 1], gamma=0.5)
        assert column(steps, "intrinsic_reward") == [-1.0, 0.0, 1.0]
        assert column(steps, "option_steps") == [1, 2, 3]
        assert column(steps, "option_return") == [0.0, 0.5, 0.75]  # 0, + 0.5 * 1, + 0.25 * 1
        assert column(steps, "option_done") == [0, 0, 1]

    def test_a_proposal_counts_only_where_an_option_starts(self):
        steps = play([1, 0, 0])
        assert column(steps, "active_subgoal") == [1, 1, 1]

    def test_an_option_whose_subgoal_is_gone_ends_after_one_step(self):
        steps = play([0, 0, 0, 1], actions=[RIGHT, RIGHT, LEFT, RIGHT])
        assert column(steps, "option_done") == [0, 1, 1, 0]
        assert column(steps, "option_steps") == [1, 2, 1, 1]
        assert column(steps, "option_terminated") == [0, 1, 0, 0]
        assert column(steps, "subgoal_reached") == [0, 1, 0, 0]


class TestEndOfEpisode:
    def test_termination_closes_and_terminates_an_option_that_missed_its_subgoal(self):
        steps = play([0, 0, 0], repeatable=True)
        assert column(steps, "done") == [0, 0, 1]
        assert column(steps, "subgoal_reached") == [0, 1, 0]
        assert column(steps, "option_done") == [0, 1, 1]
        assert column(steps, "option_terminated") == [0, 1, 1]

    def test_the_environments_step_limit_closes_the_option_without_terminating_it(self):
        steps = play([1, 1], max_steps=2)
        assert column(steps, "truncated") == [0, 1]
        assert column(steps, "option_done") == [0, 1]
        assert column(steps, "option_terminated") == [0, 0]

    def test_a_step_counter_before_the_transform_closes_the_option(self):
        steps = play([1, 1], before=[StepCounter(max_steps=2)])
        assert column(steps, "truncated") == [0, 1]
        assert column(steps, "option_done") == [0, 1]
        assert column(steps, "option_terminated") == [0, 0]

    def test_every_end_of_an_episode_closes_its_option(self):
        rollout = subgoal_env(16, env_settings={"max_steps": 4}).rollout(60, break_when_any_done=False)["next"]
        assert rollout["terminated"].any() and rollout["truncated"].any()
        assert rollout["option_done"][rollout["done"]].all()
        assert rollout["option_terminated"][rollout["terminated"]].all()
        only_truncated = rollout["truncated"] & ~rollout["subgoal_reached"]
        assert only_truncated.any() and not rollout["option_terminated"][only_truncated].any()


class TestArguments:
    """Every argument changes something; the corridor gives -1, goal 0, goal 1."""

    @pytest.mark.parametrize(
        ("settings", "key", "expected"),
        [
            ({}, "intrinsic_reward", [-1.0, 0.0, 1.0]),
            ({"reached_reward": 5.0}, "intrinsic_reward", [-1.0, 0.0, 5.0]),
            ({"hazard_reward": -0.25}, "intrinsic_reward", [-0.25, 0.0, 1.0]),
            ({"hazard_reward": 0.0}, "intrinsic_reward", [0.0, 0.0, 1.0]),
            ({"hazard_key": None}, "intrinsic_reward", [0.0, 0.0, 1.0]),
            ({"wrong_subgoal_reward": -0.5}, "intrinsic_reward", [-1.0, -0.5, 1.0]),
            ({}, "option_return", [0.0, 0.99, 0.99 + 0.99**2]),
            ({"gamma": 1.0}, "option_return", [0.0, 1.0, 2.0]),
            ({"gamma": 0.0}, "option_return", [0.0, 0.0, 0.0]),
            ({}, "option_done", [0, 0, 1]),
            ({"max_option_steps": 2}, "option_done", [0, 1, 1]),
            ({"max_option_steps": 2}, "option_terminated", [0, 0, 1]),
            ({"max_option_steps": 2}, "option_steps", [1, 2, 1]),
            ({"critic": lambda after: after["attained"].flip(-1)}, "subgoal_reached", [0, 1, 0]),
        ],
    )
    def test_every_argument_of_the_book_changes_its_numbers(self, settings, key, expected):
        assert column(play([1, 1, 1], **settings), key) == pytest.approx(expected)

    @pytest.mark.parametrize(("repeatable", "done"), [(False, 1), (True, 0)])
    def test_a_subgoal_that_is_not_repeatable_is_masked_and_ends_its_option(self, repeatable, done):
        steps = play([0, 0, 0], actions=[RIGHT, RIGHT, LEFT], repeatable=repeatable)
        assert steps[-1]["option_done"].item() == done
        assert steps[-1]["subgoal_mask"].tolist() == [[repeatable, True]]

    def test_an_option_ends_with_the_step_after_which_its_subgoal_is_not_available(self):
        class Availability(Transform):
            """Of goal 1 before the corridor's second step; nothing is attained."""

            def _step(self, _, after):
                self.time += 1
                return after.set("available", torch.tensor([[True, self.time < 2]]))

            def _reset(self, _, after):
                self.time = 0
                return after.set("available", torch.ones(1, 2, dtype=torch.bool))

            def transform_observation_spec(self, spec):
                spec["available"] = Binary(shape=(1, 2), dtype=torch.bool)
                return spec

        steps = play([1, 1, 1, 0], [LEFT] * 4, before=[Availability()], available_key="available")
        assert column(steps, "option_done") == [0, 1, 1, 0]  # who chooses it all the same has it for one step
        assert column(steps, "option_steps") == [1, 2, 1, 1]
        assert column(steps, "option_terminated") == [0, 1, 0, 0]  # who loses it has failed

    def test_reaching_the_subgoal_is_not_penalised_as_a_wrong_one(self):
        assert column(play([0, 0], wrong_subgoal_reward=-0.5), "intrinsic_reward") == [-1.0, 1.0]

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"num_subgoals": 0}, "num_subgoals must be >= 1, got 0; "),
            ({"num_subgoals": 2, "gamma": 1.5}, r"gamma must lie in \[0, 1\], got 1.5; "),
            ({"num_subgoals": 2, "max_option_steps": 0}, "max_option_steps must be >= 1 or None, got 0; "),
        ],
    )
    def test_values_out_of_range_are_refused(self, settings, message):
        with pytest.raises(ValueError, match=message):
            SubgoalTransform(**settings)


class TestSpecs:
    @pytest.mark.parametrize("num_envs", [1, 4])
    def test_the_specs_of_the_book_are_right(self, num_envs):
        check_env_specs(subgoal_env(num_envs))

    def test_the_specs_of_the_book_are_right_inside_a_serial_env(self):
        check_env_specs(SerialEnv(2, lambda: subgoal_env(3)))

    def test_the_specs_of_the_book_are_right_around_a_serial_env(self):
        env = TransformedEnv(SerialEnv(2, lambda: small_env(3)), SubgoalTransform(num_subgoals=2))
        check_env_specs(env)
        rollout = env.rollout(30, break_when_any_done=False)
        assert rollout.batch_size == (2, 3, 30)
        assert rollout["next", "option_done"][rollout["next", "done"]].all()

    def test_the_specs_of_the_book_are_right_inside_and_around_a_parallel_env(self):
        inside = ParallelEnv(2, partial(subgoal_env, 3), mp_start_method="fork")
        around = TransformedEnv(
            ParallelEnv(2, partial(small_env, 3), mp_start_method="fork"), SubgoalTransform(num_subgoals=2)
        )
        for env in (inside, around):
            try:
                rollout = env.rollout(20, break_when_any_done=False)
                assert rollout.batch_size == (2, 3, 20)
                assert rollout["next", "option_done"][rollout["next", "done"]].all()
                assert rollout["option_init"][:, :, 0].all()
            finally:
                env.close()

    def test_every_key_can_be_nested(self):
        moved = ["attained", "hazard", "extrinsic_reward"]
        nested = {f"{key}_key": ("book", key) for key in [*WRITTEN, *moved, "subgoal"]}
        rename = RenameTransform(in_keys=moved, out_keys=[("book", key) for key in moved])
        transforms = Compose(rename, SubgoalTransform(num_subgoals=2, **nested))
        env = TransformedEnv(small_env(3), transforms)
        check_env_specs(env)
        rollout = env.rollout(30, break_when_any_done=False)
        assert not {*WRITTEN, *moved, "subgoal"} & set(rollout["next"].keys())
        assert set(WRITTEN) <= set(rollout["next", "book"].keys())
        assert rollout["next", "book", "option_done"][rollout["next", "done"]].all()

    def test_random_actions_propose_every_subgoal(self):
        env = subgoal_env(16)
        proposals = env.rand_action(env.reset())["subgoal"]
        assert proposals.unique().tolist() == [0, 1]

    def test_stored_data_is_refused(self):
        transform = SubgoalTransform(num_subgoals=2)
        with pytest.raises(RuntimeError, match="append it to an environment"):
            transform(subgoal_env(2).rollout(2))


@pytest.fixture(scope="module")
def rollout():
    torch.manual_seed(0)
    return subgoal_env(8, max_option_steps=4).rollout(150, break_when_any_done=False)


class TestAlongEpisodes:
    def test_the_subgoal_is_constant_inside_an_option_and_follows_the_proposal_at_its_start(self, rollout):
        init, active = rollout["option_init"].squeeze(-1), rollout["next", "active_subgoal"]
        assert (active[init] == rollout["subgoal"][init]).all()
        assert (active[:, 1:] == active[:, :-1])[~init[:, 1:]].all()
        assert (rollout["subgoal"] != active)[~init].any()  # there was something to ignore

    def test_an_option_starts_where_one_ended_and_nowhere_else(self, rollout):
        init, done = rollout["option_init"], rollout["next", "option_done"]
        assert init[:, 0].all()
        assert (init[:, 1:] == done[:, :-1]).all()

    def test_steps_of_an_option_count_from_one(self, rollout):
        init, steps = rollout["option_init"], rollout["next", "option_steps"]
        assert (steps[init] == 1).all()
        assert (steps[:, 1:] == steps[:, :-1] + 1)[~init[:, 1:]].all()

    def test_the_book_is_fresh_where_an_episode_starts(self, rollout):
        first = rollout["is_init"].squeeze(-1)
        assert first[:, 1:].any()
        assert rollout["option_init"][first].all() and rollout["subgoal_mask"][first].all()
        for key in ("active_subgoal", "option_steps", "option_return"):
            assert not rollout[key][first].any(), key

    def test_a_partial_reset_leaves_the_neighbours_alone(self):
        env = subgoal_env(3)
        td = env.rollout(3)[:, -1]
        td["next", "done"] = td["next", "terminated"] = torch.zeros(3, 1, dtype=torch.bool)
        before = step_mdp(td)
        before.update({"option_return": torch.full((3, 1), 7.0), "option_steps": torch.full((3, 1), 5)})
        before["active_subgoal"], before["option_init"] = torch.ones(3, dtype=torch.int64), torch.zeros(3, 1).bool()
        before["subgoal_mask"] = torch.zeros(3, 2, dtype=torch.bool)
        request = before.clone()
        request["_reset"] = torch.tensor([[False], [True], [False]])
        after = env.reset(request)
        for key in CARRIED:
            assert (after[key][[0, 2]] == before[key][[0, 2]]).all(), key
            assert (after[key][1] != before[key][1]).all(), key

    def test_an_environment_that_resets_itself_keeps_its_neighbours_book(self):
        """TorchRL merges the rows of an ordinary partial reset; after a native one only the transform does."""
        env = subgoal_env(3)
        played = env.rollout(4, break_when_any_done=False)[:, -1]["next"]
        played["option_steps"] = torch.tensor([[3], [4], [5]])
        played["_reset"] = torch.tensor([[False], [True], [False]])
        fresh = env.transform._reset_on_native_autoreset(played.clone(), played.clone())
        assert fresh["option_steps"].tolist() == [[3], [0], [5]]
        assert torch.equal(fresh["active_subgoal"][[0, 2]], played["active_subgoal"][[0, 2]])
        assert fresh["option_init"][1]
