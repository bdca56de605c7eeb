"""Agents of one, two and three levels on the same task: when each level chooses, and what it learns."""

import pytest
import torch
from helpers import collect, house, tiny_settings
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from hdrqn_torchrl.algorithms import Level, make_hdrqn, make_v3
from hdrqn_torchrl.algorithms.levels import make_levels
from hdrqn_torchrl.envs import MultiGoalGridEnv, SubgoalSet
from hdrqn_torchrl.learning import PhaseOne
from hdrqn_torchrl.modules import EpsilonGreedy, RepeatingEpsilonGreedy, compact_network


def agent(env, levels, **options):
    torch.manual_seed(0)
    learner = tiny_settings(sampling="episode_starts", slice_len=14, batch_size=16, learning_rate=1e-2)
    half = {"sub_exploration": RepeatingEpsilonGreedy(0.5, 0.5)}
    half |= {"meta_exploration": EpsilonGreedy(0.5, 0.5)} if levels > 1 else {}
    sizes = {"memory_size": 8, "head_size": 8, "learner": learner}
    return make_v3(env, compact_network(8, (8,)), levels=levels, **(half | sizes | options))


def test_levels_are_named_after_what_they_choose_among():
    rooms, goals = SubgoalSet(names=("a", "b", "c"), prefix="rooms"), SubgoalSet(names=("x", "y"))
    assert make_levels(4, []) == (Level(name="sub", num_choices=4, choices=None, pursues=None),)
    assert make_levels(4, [goals]) == (
        Level(name="sub", num_choices=4, choices=None, pursues=goals),
        Level(name="meta", num_choices=2, choices=goals, pursues=None),
    )
    assert [level.num_conditions for level in make_levels(4, [rooms, goals])] == [3, 2, 0]


@pytest.mark.parametrize(("levels", "names"), [(1, ["sub"]), (2, ["sub", "meta"]), (3, ["sub", "rooms", "meta"])])
def test_levels_decides_how_many_levels_learn(levels, names):
    env = house(6, max_steps=12)
    algorithm = agent(env, levels)
    assert list(algorithm.explorations) == names
    assert len({id(each) for each in algorithm.explorations.values()}) == levels
    learner = algorithm.learners["joint"]
    before = [parameter.clone() for parameter in algorithm.policy.parameters()]
    for batch in collect(algorithm, env, 16, batches=2):
        algorithm.observe(batch)
    for _ in range(2):
        metrics = learner.update(learner.sample())
    assert {f"{name}_loss" for name in names} <= set(metrics)
    assert all((old != new).any() for old, new in zip(before, algorithm.policy.parameters(), strict=True))


def test_more_levels_than_the_task_has_sets_for_are_refused():
    for env, most in ((house(), 3), (MultiGoalGridEnv(4), 2)):
        with pytest.raises(ValueError, match=f"levels must be <= {most}, got {most + 1}: the task states"):
            agent(env, most + 1)


@pytest.mark.parametrize(("builder", "levels"), [(make_v3, "2"), (make_v3, 0), (make_hdrqn, 2.0), (make_hdrqn, None)])
def test_a_number_of_levels_that_is_no_whole_number_from_1_on_is_refused(builder, levels):
    with pytest.raises(ValueError, match=rf"levels must be .*>= 1, got {levels!r}; use 2\."):
        builder(house(), compact_network(8, (8,)), levels=levels)


def test_bonus_reward_is_refused_for_more_than_one_level():
    with pytest.raises(ValueError, match=r"bonus_reward must be 0 with levels=2, got 0\.5; their critic"):
        agent(house(), 2, bonus_reward=0.5)
    assert agent(house(), 1, bonus_reward=0.5).learners["joint"].loss.rules[0].largest_return == float("inf")


class TestThreeLevels:
    """Compared with an option book written out by hand, on half-random play."""

    @pytest.fixture
    def played(self):
        env = house(6, max_steps=12, seed=3)
        self.algorithm = agent(env, 3, max_option_steps=4)
        policy, self.acted_by = self.algorithm.policy, []
        decide = policy.network.step
        policy.network.step = lambda *inputs: self.acted_by.append(decide(*inputs)) or self.acted_by[-1]
        with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
            batch = self.algorithm.transform(env).rollout(60, policy, break_when_any_done=False)
        del policy.network.step
        return batch

    def test_a_level_chooses_when_its_option_or_the_one_above_ends(self, played):
        """The far level chooses where its option ended; the near one also where its own ended."""
        for env in range(len(played)):
            far_due = near_due = True
            far = near = near_steps = None
            for step in played[env]:
                after = step["next"]
                assert bool(step["option_init"]) == far_due and bool(step["rooms_option_init"]) == near_due
                far = int(step["subgoal"]) if far_due else far
                near, near_steps = (int(step["rooms_subgoal"]), 0) if near_due else (near, near_steps)
                assert int(after["active_subgoal"]) == far and int(after["rooms_active_subgoal"]) == near
                near_steps += 1
                over = bool(after["done"])
                far_left = bool(after["subgoal_mask"][far]) or bool(after["attained"][far])
                far_due = bool(after["attained"][far]) or over or not far_left
                near_left = bool(after["rooms_subgoal_mask"][near]) or bool(after["rooms_attained"][near])
                near_due = bool(after["rooms_attained"][near]) or near_steps >= 4 or far_due or not near_left
                assert bool(after["option_done"]) == far_due and bool(after["rooms_option_done"]) == near_due
                if over:
                    far_due = near_due = True
        far_ends, near_ends = played["next", "option_done"], played["next", "rooms_option_done"]
        assert (near_ends & ~far_ends).sum() > 20 and far_ends.sum() > 10
        assert (far_ends & ~played["next", "rooms_attained"].any(-1, keepdim=True)).any()

    def test_each_level_chooses_by_its_values_for_the_subgoal_above(self, played):
        values = [torch.stack(level, 1) for level in zip(*(values for values, _ in self.acted_by), strict=True)]
        assert [value.shape[2:] for value in values] == [(5, 4), (2, 5), (1, 2)]
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            greedy = self.algorithm.policy(played.select(*self.algorithm.policy.in_keys)[:, 0].clone())
        assert played["rooms_option_init"][:, 0].all()
        far = greedy["subgoal"]
        allowed = values[1][:, 0].gather(1, far.view(-1, 1, 1).expand(-1, 1, values[1].shape[-1])).squeeze(1)
        allowed = allowed.masked_fill(~played["rooms_subgoal_mask"][:, 0], -torch.inf)
        near = greedy["rooms_subgoal"]
        assert (near == allowed.argmax(-1)).all()
        for_near = values[0][:, 0].gather(1, near.view(-1, 1, 1).expand(-1, 1, 4)).squeeze(1)
        assert (greedy["action"] == for_near.argmax(-1)).all()

    def test_acting_and_learning_compute_the_same_values(self, played):
        with set_recurrent_mode(True), torch.no_grad():
            learned = self.algorithm.policy(played.clone())
        acted = [torch.stack(level, 1) for level in zip(*(values for values, _ in self.acted_by), strict=True)]
        for key, value in zip(("action_value", "rooms_subgoal_value", "subgoal_value"), acted, strict=True):
            torch.testing.assert_close(learned[key], value, rtol=0, atol=1e-6)

    def test_a_near_option_collects_the_intrinsic_reward_of_the_far_one(self, played):
        paid, collected = played["next", "intrinsic_reward"], played["next", "rooms_option_return"]
        for env in range(len(played)):
            total, steps = 0.0, 0
            for time in range(played.shape[1]):
                if played["rooms_option_init"][env, time]:
                    total, steps = 0.0, 0
                total += 0.95**steps * paid[env, time].item()
                steps += 1
                assert collected[env, time].item() == pytest.approx(total, abs=1e-5)
        assert (paid != 0).any()


def test_a_flat_agent_has_no_first_phase():
    with pytest.raises(ValueError, match=r"phase_one must be None with levels=1"):
        agent(house(), 1, phase_one=PhaseOne())


def test_all_levels_above_the_sub_level_wait_in_the_first_phase():
    random = EpsilonGreedy(1.0, 0.1)
    waiting = agent(house(), 3, phase_one=PhaseOne(), meta_exploration=random)
    assert [each.held for each in waiting.explorations.values()] == [False, True, True]
    assert list(waiting.monitors) == ["phases", "rooms_legs", "legs", "visits"]
    near, far = (len(each) for each in waiting.task.subgoals)
    assert sum(name.startswith("phase/success_") for name in waiting.monitors["phases"].metrics()) == near
    for name, size in (("rooms_legs", near), ("legs", far)):
        columns = waiting.monitors[name].metrics()
        assert len(columns) == (size + 1) * size and f"{name}/start_to_0" in columns


def test_their_learners_wait_as_well():
    waiting = make_hdrqn(house(), compact_network(8, (8,)), levels=3, phase_one=PhaseOne(max_frames=1))
    assert [each.held for each in waiting.learners.values()] == [False, True, True]
