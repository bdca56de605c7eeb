import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hdrqn_torchrl.modules import EpsilonGreedy, RepeatingEpsilonGreedy
from hdrqn_torchrl.modules.exploration import mask_values

VALUES = torch.tensor([3.0, 9.0, 1.0, 5.0])


@pytest.mark.parametrize(
    ("frames", "epsilon"), [(0, 1.0), (1, 0.991), (50, 0.55), (99, 0.109), (100, 0.1), (101, 0.1), (10**9, 0.1)]
)
def test_epsilon_falls_linearly_and_then_stays(frames, epsilon):
    exploration = EpsilonGreedy(1.0, 0.1, anneal_frames=100)
    exploration.step(frames)
    assert exploration.epsilon.item() == pytest.approx(epsilon)


def test_the_schedule_adds_up_over_batches():
    exploration = EpsilonGreedy(0.8, 0.2, anneal_frames=60)
    for _ in range(3):
        exploration.step(10)
    assert exploration.epsilon.item() == pytest.approx(0.5)


def test_the_share_of_random_choices_is_epsilon():
    torch.manual_seed(0)
    exploration = EpsilonGreedy(0.4, 0.4)
    with set_exploration_type(ExplorationType.RANDOM):
        choices = exploration(VALUES.expand(40_000, 4))
    shares = choices.bincount(minlength=4) / len(choices)
    assert shares.tolist() == pytest.approx([0.1, 0.7, 0.1, 0.1], abs=0.01)


def test_every_row_draws_for_itself():
    torch.manual_seed(0)
    with set_exploration_type(ExplorationType.RANDOM):
        choices = EpsilonGreedy(1.0, 1.0)(VALUES.expand(5, 200, 4))
    assert choices.shape == (5, 200)
    assert all(row.unique().tolist() == [0, 1, 2, 3] for row in choices)


@pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.MODE, ExplorationType.MEAN])
def test_any_other_exploration_type_is_greedy(kind):
    with set_exploration_type(kind):
        assert (EpsilonGreedy(1.0, 1.0)(VALUES.expand(500, 4)) == 1).all()


class TestMask:
    MASK = torch.tensor([True, False, True, False])

    def test_greedy_takes_the_best_that_is_allowed(self):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            assert EpsilonGreedy()(VALUES, self.MASK).item() == 0

    def test_exploring_takes_all_that_are_allowed_and_only_those(self):
        torch.manual_seed(0)
        with set_exploration_type(ExplorationType.RANDOM):
            choices = EpsilonGreedy(1.0, 1.0)(VALUES.expand(2_000, 4), self.MASK.expand(2_000, 4))
        shares = choices.bincount(minlength=4) / len(choices)
        assert shares.tolist() == pytest.approx([0.5, 0.0, 0.5, 0.0], abs=0.05)

    @pytest.mark.parametrize("kind", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
    def test_a_row_that_allows_nothing_allows_everything(self, kind):
        torch.manual_seed(0)
        mask = torch.tensor([[False] * 4, [False, False, True, False]]).repeat(500, 1)
        with set_exploration_type(kind):
            choices = EpsilonGreedy(1.0, 1.0)(VALUES.expand(1_000, 4), mask)
        assert choices[::2].unique().tolist() == ([0, 1, 2, 3] if kind == ExplorationType.RANDOM else [1])
        assert (choices[1::2] == 2).all()

    def test_mask_values(self):
        inf = float("inf")
        masked = mask_values(torch.tensor([[1.0, 2.0], [1.0, 2.0]]), torch.tensor([[True, False], [False, False]]))
        assert masked.tolist() == [[1.0, -inf], [1.0, 2.0]]


def test_the_schedule_travels_in_the_state_dict():
    source, copy = EpsilonGreedy(1.0, 0.0, anneal_frames=100), EpsilonGreedy(1.0, 0.0, anneal_frames=100)
    source.step(30)
    copy.load_state_dict(source.state_dict())
    assert copy.epsilon.item() == pytest.approx(0.7)
    copy.step(10)
    assert copy.epsilon.item() == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": 1.5}, r"start must be an epsilon in \[0, 1\], got 1.5; "),
        ({"end": -0.1}, r"end must be an epsilon in \[0, 1\], got -0.1; "),
        ({"anneal_frames": 0}, "anneal_frames must be >= 1, got 0; "),
    ],
)
def test_wrong_values(arguments, message):
    with pytest.raises(ValueError, match=message):
        EpsilonGreedy(**arguments)


class TestLadder:
    @pytest.mark.parametrize("kind", [EpsilonGreedy, RepeatingEpsilonGreedy])
    def test_epsilon_of_each_environment(self, kind):
        exploration = kind(0.5, 0.5, ladder=3.0)
        assert exploration.epsilons(torch.zeros(4)).tolist() == pytest.approx([0.5, 0.25, 0.125, 0.0625])
        assert exploration.epsilons(torch.zeros(1)).tolist() == [0.5]
        assert exploration.epsilons(torch.zeros(3, 7)).flatten().tolist() == pytest.approx([0.5, 0.5**2.5, 0.0625])
        assert exploration.epsilons(torch.tensor(0.0)).item() == 0.5

    def test_without_it_all_have_the_same(self):
        assert EpsilonGreedy(0.5, 0.5).epsilons(torch.zeros(4)).item() == 0.5

    def test_the_rungs_move_with_the_schedule(self):
        exploration = EpsilonGreedy(1.0, 0.0, anneal_frames=100, ladder=1.0)
        assert exploration.epsilons(torch.zeros(2)).tolist() == [1.0, 1.0]
        exploration.step(50)
        assert exploration.epsilons(torch.zeros(2)).tolist() == pytest.approx([0.5, 0.25])

    def test_the_share_of_random_choices_of_each_environment(self):
        values = torch.cat([torch.ones(1), torch.zeros(99)])
        with set_exploration_type(ExplorationType.RANDOM):
            choices = EpsilonGreedy(0.5, 0.5, ladder=1.0)(values.expand(2, 20_000, 100))
        assert (choices != 0).float().mean(1).tolist() == pytest.approx([0.495, 0.2475], abs=0.02)

    def test_a_negative_one(self):
        with pytest.raises(ValueError, match=r"ladder must be >= 0 and finite, got -1\.0; "):
            EpsilonGreedy(ladder=-1.0)


class TestRepeatingEpsilonGreedy:
    ACTIONS = 64  # so many that a random one is hardly ever the greedy one, action 0

    def play(self, exploration, num_envs=1_000, steps=200):
        """Choices and what was carried before each, ``[T, N]`` and ``[T + 1, N, 2]``."""
        values = torch.zeros(num_envs, self.ACTIONS)
        values[:, 0] = 1.0
        choices, carried = [], [torch.zeros(num_envs, 2, dtype=torch.int64)]
        with set_exploration_type(ExplorationType.RANDOM):
            for _ in range(steps):
                choice, following = exploration.extend(values, carried[-1])
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
    def test_lengths_of_stretches(self, exponent, max_repeats):
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
            choice, carried = RepeatingEpsilonGreedy(1.0, 1.0).extend(VALUES.expand(5, 4), torch.full((5, 2), 3))
        assert (choice == 1).all() and (carried == 0).all()

    def test_a_single_environment_without_batch(self):
        with set_exploration_type(ExplorationType.RANDOM):
            choice, carried = RepeatingEpsilonGreedy(0.0, 0.0).extend(VALUES, torch.tensor([2, 5]))
        assert choice.item() == 2 and carried.tolist() == [2, 4]

    def test_the_ladder_gives_each_environment_its_share(self):
        choices, _ = self.play(RepeatingEpsilonGreedy(0.5, 0.5, ladder=2.0), num_envs=1_001)
        shares = (choices[40:] != 0).float().mean(0)
        assert shares[:100].mean().item() == pytest.approx(0.47, abs=0.03)
        assert shares[-100:].mean().item() == pytest.approx(0.13, abs=0.03)

    def test_a_stretch_ends_where_an_option_starts(self):
        carried, starts = torch.tensor([[2, 5], [2, 5], [2, 1]]), torch.tensor([False, True, False])
        with set_exploration_type(ExplorationType.RANDOM):
            choice, following = RepeatingEpsilonGreedy(0.0, 0.0).extend(VALUES.expand(3, 4), carried, None, starts)
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
        ],
    )
    def test_wrong_values(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            RepeatingEpsilonGreedy(**arguments)
