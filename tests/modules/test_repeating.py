import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hdrqn_torchrl.modules import FullyConnectedFeatures, MetaController, QNetwork, RepeatingEpsilonGreedy

VALUES = torch.tensor([3.0, 9.0, 1.0, 5.0])
NETWORK = QNetwork(FullyConnectedFeatures(3, (4,)), num_actions=2, hidden_size=4)


class TestRepeatingEpsilonGreedy:
    ACTIONS = 64  # enough that a random one is hardly ever the greedy one, action 0

    def play(self, exploration, num_envs=1_000, steps=200):
        """Choices and what was carried before each, ``[T, N]`` and ``[T + 1, N, 2]``."""
        values = torch.zeros(num_envs, self.ACTIONS)
        values[:, 0] = 1.0
        choices, carried = [], [torch.zeros(num_envs, 2, dtype=torch.int64)]
        with set_exploration_type(ExplorationType.RANDOM):
            for _ in range(steps):
                choice, following = exploration(values, carried=carried[-1])
                choices.append(choice)
                carried.append(following)
        return torch.stack(choices), torch.stack(carried)

    @pytest.mark.parametrize(
        ("epsilon", "settings"),
        [
            (0.0, {}),
            (0.1, {}),
            (0.5, {}),
            (1.0, {}),
            (0.5, {"max_repeats": 1}),
            (0.5, {"exponent": 0.5, "max_repeats": 8}),
        ],
    )
    def test_epsilon_is_the_share_of_random_steps(self, epsilon, settings):
        choices, _ = self.play(RepeatingEpsilonGreedy(epsilon, epsilon, **settings))
        share = (choices[40:] != 0).float().mean().item()  # once stretches have had time to overlap with any step
        assert share == pytest.approx(epsilon * (1 - 1 / self.ACTIONS), abs=0.006)

    def test_an_action_is_repeated_while_its_stretch_lasts(self):
        choices, carried = self.play(RepeatingEpsilonGreedy(0.3, 0.3), steps=60)
        before, after = carried[:-1], carried[1:]
        going_on = before[..., 1] > 0
        assert going_on.any() and (choices == before[..., 0])[going_on].all()
        assert (after[..., 1] == before[..., 1] - 1)[going_on].all()
        assert (after[..., 0] == before[..., 0])[going_on].all()
        begun = ~going_on & (after[..., 1] > 0)
        assert begun.any() and (choices == after[..., 0])[begun].all()
        assert ((choices == 0) | (choices == after[..., 0]))[~going_on].all()

    @pytest.mark.parametrize(("exponent", "max_repeats"), [(2.0, 15), (1.0, 4), (2.0, 1)])
    def test_lengths_of_stretches_follow_the_cut_zeta_distribution(self, exponent, max_repeats):
        exploration = RepeatingEpsilonGreedy(1.0, 1.0, exponent=exponent, max_repeats=max_repeats)
        _, carried = self.play(exploration, steps=100)
        lengths = carried[1:, :, 1][carried[:-1, :, 1] == 0] + 1
        counts = lengths.bincount(minlength=max_repeats + 1)[1:].double()
        weights = torch.arange(1, max_repeats + 1).double() ** -exponent
        expected = len(lengths) * weights / weights.sum()
        assert len(counts) == max_repeats and len(lengths) > 20_000
        chi_square = ((counts - expected) ** 2 / expected).sum().item()
        assert chi_square < max_repeats + 6 * (2 * max_repeats) ** 0.5

    def test_random_actions_are_uniform(self):
        choices, _ = self.play(RepeatingEpsilonGreedy(1.0, 1.0, max_repeats=2))
        shares = choices.flatten().bincount(minlength=self.ACTIONS) / choices.numel()
        assert shares.tolist() == pytest.approx([1 / self.ACTIONS] * self.ACTIONS, rel=0.15)

    @pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.MODE, ExplorationType.MEAN])
    def test_any_other_exploration_type_is_greedy_and_drops_the_stretch(self, kind):
        with set_exploration_type(kind):
            choice, carried = RepeatingEpsilonGreedy(1.0, 1.0)(VALUES.expand(5, 4), carried=torch.full((5, 2), 3))
        assert (choice == 1).all() and (carried == 0).all()

    def test_a_single_environment_needs_no_batch_dimension(self):
        with set_exploration_type(ExplorationType.RANDOM):
            choice, carried = RepeatingEpsilonGreedy(0.0, 0.0)(VALUES, carried=torch.tensor([2, 5]))
        assert choice.item() == 2 and carried.tolist() == [2, 4]

    def test_a_mask_holds_for_random_choices_and_ends_a_stretch_that_it_forbids(self):
        mask = torch.tensor([True, True, False, True]).expand(400, 4)
        carried = torch.tensor([[2, 5]] * 200 + [[3, 5]] * 200)
        with set_exploration_type(ExplorationType.RANDOM):
            choice, following = RepeatingEpsilonGreedy(0.5, 0.5)(VALUES.expand(400, 4), mask=mask, carried=carried)
        assert choice[:200].unique().tolist() == [0, 1, 3]
        assert (choice[200:] == 3).all() and (following[200:, 1] == 4).all()

    def test_single_choices_may_be_subgoals_and_stretches_of_them_not(self):
        MetaController(NETWORK, RepeatingEpsilonGreedy(max_repeats=1))
        with pytest.raises(ValueError, match="exploration must be an EpsilonGreedy where subgoals are chosen, got Rep"):
            MetaController(NETWORK, RepeatingEpsilonGreedy(max_repeats=2))

    def test_the_ladder_gives_each_environment_its_share(self):
        choices, _ = self.play(RepeatingEpsilonGreedy(0.5, 0.5, ladder=2.0), num_envs=1_001)
        shares = (choices[40:] != 0).float().mean(0)
        assert shares[:100].mean().item() == pytest.approx(0.47, abs=0.03)
        assert shares[-100:].mean().item() == pytest.approx(0.13, abs=0.03)

    def test_a_stretch_ends_where_an_option_starts(self):
        carried, starts = torch.tensor([[2, 5], [2, 5], [2, 1]]), torch.tensor([False, True, False])
        with set_exploration_type(ExplorationType.RANDOM):
            exploration = RepeatingEpsilonGreedy(0.0, 0.0)
            choice, following = exploration(VALUES.expand(3, 4), starts=starts, carried=carried)
        assert choice.tolist() == [2, 1, 2] and following[:, 1].tolist() == [4, 0, 0]

    def test_a_fixed_epsilon_holds_for_stretches_too(self):
        exploration = RepeatingEpsilonGreedy(1.0, 1.0, ladder=3.0)
        exploration.fixed = 0.25
        choices, _ = self.play(exploration)
        assert (choices[40:] != 0).float().mean().item() == pytest.approx(0.25, abs=0.02)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"start": 2.0}, r"start must be an epsilon in \[0, 1\], got 2.0; "),
            ({"exponent": 0.0}, "exponent must be > 0 and finite, got 0.0; "),
            ({"max_repeats": 0}, "max_repeats must be >= 1, got 0; "),
            ({"max_repeats": 10**11}, "max_repeats must be <= 100,000, got 100000000000; use 15"),
        ],
    )
    def test_values_out_of_range_are_refused(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            RepeatingEpsilonGreedy(**arguments)
