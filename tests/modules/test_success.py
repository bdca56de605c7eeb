import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

from hdrqn_torchrl.keys import OptionKeys
from hdrqn_torchrl.modules import SubgoalSuccess, SuccessEpsilonGreedy


def batch(*options, num_subgoals=1):
    """A batch ``[1, T]`` of steps, each (subgoal, done, reached); all subgoals can be chosen."""
    subgoal, done, reached = (torch.tensor(column)[None] for column in zip(*options, strict=True))
    step = {"active_subgoal": subgoal, "option_done": done[..., None], "subgoal_reached": reached[..., None]}
    mask = torch.ones(1, len(options), 3, dtype=torch.bool)
    return TensorDict({"subgoal_mask": mask[..., :num_subgoals], "next": step}, [1, len(options)])


WON, LOST, GOES_ON = (0, True, True), (0, True, False), (0, False, False)


class TestSubgoalSuccess:
    def test_the_share_of_options_that_reached_their_subgoal(self):
        success = SubgoalSuccess(3)
        success.observe(batch(WON, LOST, GOES_ON, WON, (2, True, False), LOST, num_subgoals=3))
        assert success.rates.tolist() == [0.5, 0.0, 0.0]
        assert success.options.tolist() == [4, 0, 1]

    def test_few_options_count_alike_in_however_many_batches_they_come(self):
        success = SubgoalSuccess(1, window=10)
        for each in (WON, LOST, LOST, WON, LOST):
            success.observe(batch(each))
        assert success.rates.item() == pytest.approx(0.4)

    def test_only_the_last_options_count_once_the_window_is_full(self):
        success = SubgoalSuccess(1, window=4)
        for _ in range(20):
            success.observe(batch(LOST))
        success.observe(batch(WON))
        assert success.rates.item() == pytest.approx(0.25)
        success.observe(batch(*[WON] * 8))
        assert success.rates.item() == 1.0

    def test_options_that_could_not_succeed_do_not_count(self):
        success, steps = SubgoalSuccess(2), batch(WON, LOST, (1, True, True), num_subgoals=2)
        steps["subgoal_mask"][0, 1, 0] = False  # attained before: the option ended at once
        success.observe(steps)
        assert success.rates.tolist() == [1.0, 1.0] and success.options.tolist() == [1, 1]

    def test_options_that_only_the_end_of_a_farther_one_cut_off_do_not_count(self):
        success, steps = SubgoalSuccess(1, upper_names=OptionKeys("far")), batch(WON, LOST, LOST, GOES_ON)
        steps["next", "far_option_done"] = torch.tensor([True, True, False, True]).view(1, 4, 1)
        steps["next", "done"] = torch.zeros(1, 4, 1, dtype=torch.bool)
        success.observe(steps)
        assert success.rates.tolist() == [0.5] and success.options.tolist() == [2]
        steps["next", "done"][0, 1] = True  # the end of an episode is a failure
        success.observe(steps)
        assert success.options.tolist() == [5]

    def test_a_subgoal_that_means_something_else_begins_again(self):
        success = SubgoalSuccess(2, window=10)
        success.observe(batch(WON, WON, (1, True, True), num_subgoals=2))
        success.forget(torch.tensor([False, True]))
        assert success.rates.tolist() == [1.0, 0.0] and success.options.tolist() == [2, 0]
        success.observe(batch((1, True, False), (1, True, True), num_subgoals=2))
        assert success.rates.tolist() == [1.0, 0.5]

    def test_steps_that_end_no_option_change_nothing(self):
        success = SubgoalSuccess(1)
        success.observe(batch(WON))
        success.observe(batch(GOES_ON, GOES_ON))
        assert success.rates.item() == 1.0

    @pytest.mark.parametrize(("name", "settings"), [("num_subgoals", (0,)), ("window", (2,))])
    def test_sizes_below_one_are_refused(self, name, settings):
        with pytest.raises(ValueError, match=f"{name} must be >= 1, got 0; "):
            SubgoalSuccess(*settings, **({"window": 0} if name == "window" else {}))


class TestSuccessEpsilonGreedy:
    def explored(self, exploration, subgoal):
        """How often a random action was taken."""
        values = torch.zeros(2000, 50)
        values[:, 0] = 1.0
        subgoal = torch.full((2000,), subgoal)
        with set_exploration_type(ExplorationType.RANDOM):
            action, _ = exploration(values, condition=subgoal)
        return (action != 0).float().mean().item() * 50 / 49

    def test_epsilon_of_each_subgoal(self):
        exploration = SuccessEpsilonGreedy(1.0, 0.1)
        exploration.set_num_subgoals(3, names=OptionKeys())
        exploration.success.rates.copy_(torch.tensor([0.0, 0.6, 1.0]))
        for subgoal, epsilon in enumerate((1.0, 0.4, 0.1)):
            assert self.explored(exploration, subgoal) == pytest.approx(epsilon, abs=0.05)

    def test_with_a_fixed_epsilon_neither_success_nor_environment_make_a_difference(self):
        exploration = SuccessEpsilonGreedy(0.7, 0.05, ladder=7.0)
        exploration.set_num_subgoals(2, names=OptionKeys())
        exploration.success.rates.copy_(torch.tensor([0.3, 1.0]))
        exploration.fixed = 0.25
        exploration.step(1000)
        assert torch.allclose(exploration.epsilons(torch.zeros(4), torch.tensor([0, 1, 0, 1])), torch.tensor(0.25))

    def test_it_learns_from_batches_and_its_state_travels_with_the_weights(self):
        exploration, other = SuccessEpsilonGreedy(), SuccessEpsilonGreedy()
        for each in (exploration, other):
            each.set_num_subgoals(1, names=OptionKeys())
        exploration.observe(batch(WON, WON, WON, LOST))
        other.load_state_dict(exploration.state_dict())
        assert other.epsilons(torch.zeros(1), torch.tensor([0])).item() == pytest.approx(0.25)

    def test_it_reads_the_entries_of_the_set_of_subgoals_that_it_is_given(self):
        exploration = SuccessEpsilonGreedy()
        exploration.set_num_subgoals(2, names=OptionKeys("rooms"))
        steps = batch(WON, num_subgoals=2)
        steps.rename_key_("subgoal_mask", "rooms_subgoal_mask")
        for key in ("active_subgoal", "option_done", "subgoal_reached"):
            steps.rename_key_(("next", key), ("next", f"rooms_{key}"))
        exploration.observe(steps)
        assert exploration.success.rates.tolist() == [1.0, 0.0]

    def test_epsilon_falls_with_the_schedule_as_well(self):
        exploration = SuccessEpsilonGreedy(1.0, 0.1, anneal_frames=100)
        exploration.set_num_subgoals(1, names=OptionKeys())
        exploration.step(1000)
        assert exploration.epsilons(torch.zeros(1), torch.tensor([0])).item() == pytest.approx(0.1)
