import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hdrqn_torchrl.modules import EpsilonGreedy
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
