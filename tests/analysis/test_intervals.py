"""How often intervals cover the true value, by simulation.

Seeds are fixed, and with 10,000 repetitions a frequency is exact to 0.005.
"""

import numpy as np
import pytest
from scipy.stats import ttest_ind

from hdrqn_torchrl.analysis.claims import Alike, Near, Ordered
from hdrqn_torchrl.analysis.intervals import center_interval, difference_interval, mean_interval, share_interval

REPETITIONS = 10_000
SEEDS = (2, 3, 5, 10)


def normal(size, generator):
    return generator.normal(size=size)


def near_a_ceiling(size, generator):
    """Returns of at most 2, most of them just below (mean 1.82, deviation 0.12, skewness -1.2), around their mean."""
    return 2 * (generator.beta(20, 2, size=size) - 20 / 22)


def holding(interval, truth):
    low, high = interval
    return ((low <= truth) & (truth <= high)).mean()


class TestMean:
    @pytest.mark.parametrize("seeds", SEEDS)
    def test_the_interval_of_a_mean_covers_normal_values_in_95_percent(self, seeds):
        values = normal((REPETITIONS, seeds), np.random.default_rng(seeds))
        assert 0.94 < holding(mean_interval(values), 0.0) < 0.96

    @pytest.mark.parametrize("seeds", SEEDS)
    def test_the_interval_of_a_mean_nearly_covers_skewed_bounded_values(self, seeds):
        values = near_a_ceiling((REPETITIONS, seeds), np.random.default_rng(seeds))
        assert 0.915 < holding(mean_interval(values), 0.0) < 0.95

    def test_the_interval_of_a_mean_is_students(self):
        low, high = mean_interval(np.array([1.0, 2.0, 3.0]))
        assert (low, high) == pytest.approx((2 - 4.3026527 / 3**0.5, 2 + 4.3026527 / 3**0.5))

    def test_a_higher_level_widens_the_interval_of_a_mean(self):
        values = np.array([1.0, 2.0, 4.0])
        (wide, _), (narrow, _) = mean_interval(values), mean_interval(values, confidence=0.5)
        assert wide < narrow < values.mean()

    @pytest.mark.parametrize("values", [[3.0], [3.0, 3.0, 3.0], [0.1 + 0.2, 0.3], [0.0, 0.0]])
    def test_one_value_or_equal_ones_have_no_interval(self, values):
        assert np.isnan(mean_interval(np.array(values))).all()

    def test_many_intervals_are_computed_at_once(self):
        values = np.array([[1.0, 2.0, 3.0], [5.0, 5.0, 5.0], [0.0, 0.0, 6.0]])
        low, _ = mean_interval(values)
        assert low == pytest.approx([mean_interval(row)[0] for row in values], nan_ok=True)
        assert np.isnan(low).tolist() == [False, True, False]


class TestTrimmedMean:
    @pytest.mark.parametrize(("seeds", "least"), [(4, 0.925), (5, 0.93), (10, 0.935), (20, 0.935)])
    def test_the_interval_of_the_iqm_covers_nearly_as_often(self, seeds, least):
        values = normal((REPETITIONS, seeds), np.random.default_rng(seeds))
        assert least < holding(center_interval([values], cut=0.25), 0.0) < 0.955

    def test_the_iqm_of_fewer_than_four_has_the_interval_of_the_mean(self):
        values = np.array([1.0, 2.0, 9.0])
        assert center_interval([values], cut=0.25) == mean_interval(values)

    def test_the_interval_of_the_iqm_is_tukeys_and_mclaughlins(self):
        """Of 8 values 2 are cut off at either end; with these moved inwards the sum of squares is 14."""
        values = np.array([-100.0, -50.0, 0.0, 1.0, 2.0, 3.0, 70.0, 80.0])
        error = (14 / (4 * 3)) ** 0.5
        low, high = center_interval([values], cut=0.25)
        assert (low, high) == pytest.approx((1.5 - 3.1824463 * error, 1.5 + 3.1824463 * error))

    def test_outliers_that_are_cut_off_do_not_change_the_interval(self):
        values = np.arange(8.0)
        wild = np.array([-1e6, *values[1:-1], 1e6])
        assert center_interval([wild], cut=0.25) == pytest.approx(center_interval([values], cut=0.25))


class TestStrata:
    """Several tasks whose means differ, and as many seeds of each."""

    @pytest.mark.parametrize("seeds", SEEDS)
    @pytest.mark.parametrize("cut", [0.0, 0.25])
    @pytest.mark.parametrize("apart", [0.0, 1.0, 10.0])
    def test_the_interval_over_strata_covers_the_center(self, seeds, cut, apart):
        generator = np.random.default_rng(seeds)
        strata = [task * apart + normal((REPETITIONS, seeds), generator) for task in (-1, 0, 1)]
        assert holding(center_interval(strata, cut=cut), 0.0) > 0.93

    @pytest.mark.parametrize("seeds", [2, 3, 5])
    @pytest.mark.parametrize("spreads", [(0.5, 0.1, 2.0), (0.1, 0.02, 0.1)], ids=str)
    def test_a_trimmed_mean_over_strata_that_spread_unequally_is_covered(self, seeds, spreads):
        """However much is cut off: a stratum of which one value is left does not count as one without spread."""
        generator = np.random.default_rng(seeds)
        means, shape = (0.0, 1.0, 10.0), (REPETITIONS, seeds)
        strata = [mean + each * normal(shape, generator) for mean, each in zip(means, spreads, strict=True)]
        center = np.sort(np.concatenate(strata, -1), -1)
        cut = int(0.25 * center.shape[-1])
        assert holding(center_interval(strata, cut=0.25), center[:, cut:-cut].mean()) > 0.9

    def test_strata_with_different_means_do_not_widen_the_interval(self):
        low, high = center_interval([np.array([0.0, 0.1]), np.array([10.0, 10.1])])
        assert high - low < 1

    def test_a_stratum_of_one_value_leaves_no_interval(self):
        assert np.isnan(center_interval([np.array([1.0, 2.0]), np.array([6.0])])).all()


class TestDifference:
    @pytest.mark.parametrize("seeds", SEEDS)
    @pytest.mark.parametrize("spread", [1.0, 3.0])
    def test_the_interval_of_the_difference_of_equal_means_covers_0(self, seeds, spread):
        generator = np.random.default_rng(seeds)
        first = normal((REPETITIONS, seeds), generator)
        second = spread * normal((REPETITIONS, seeds), generator)
        assert holding(difference_interval(first, second), 0.0) > 0.94

    @pytest.mark.parametrize("seeds", SEEDS)
    @pytest.mark.parametrize(("spread", "least"), [(1.0, 0.945), (3.0, 0.92)])
    def test_the_interval_of_a_difference_nearly_covers_skewed_values_with_unequal_spreads(self, seeds, spread, least):
        generator = np.random.default_rng(seeds)
        first = near_a_ceiling((REPETITIONS, seeds), generator)
        second = spread * near_a_ceiling((REPETITIONS, seeds), generator)
        assert holding(difference_interval(first, second), 0.0) > least

    def test_the_interval_of_a_difference_is_welchs(self):
        first, second = np.array([1.0, 2.0, 4.0]), np.array([0.0, 0.5])
        expected = ttest_ind(first, second, equal_var=False).confidence_interval(0.9)
        assert difference_interval(first, second, confidence=0.9) == pytest.approx((expected.low, expected.high))

    def test_one_group_without_spread_still_gives_an_interval(self):
        low, high = difference_interval(np.array([0.0, 0.0, 0.0]), np.array([1.0, 1.1, 1.2]))
        assert low == pytest.approx(-1.1 - 4.3026527 * 0.1 / 3**0.5) and high < 0

    @pytest.mark.parametrize(("first", "second"), [([1.0], [2.0, 3.0]), ([1.0, 1.0], [2.0, 2.0])])
    def test_two_groups_without_spread_have_no_interval(self, first, second):
        assert np.isnan(difference_interval(np.array(first), np.array(second))).all()


class TestShare:
    @pytest.mark.parametrize("number", [10, 100, 1000])
    @pytest.mark.parametrize("truth", [0.003, 0.05, 0.5, 0.99])
    def test_the_interval_of_a_share_covers_it(self, number, truth):
        counts = np.random.default_rng(number).binomial(number, truth, size=REPETITIONS)
        seen, times = np.unique(counts, return_counts=True)
        held = [low <= truth <= high for low, high in (share_interval(count / number, number) for count in seen)]
        assert (held * times).sum() / REPETITIONS > 0.945

    @pytest.mark.parametrize(("share", "low", "high"), [(0.0, 0.0, 0.30849710), (1.0, 0.69150290, 1.0)])
    def test_a_share_of_0_or_1_has_an_interval(self, share, low, high):
        assert share_interval(share, 10) == pytest.approx((low, high))


def decided(claim, groups, outcomes=("agrees", "disagrees")):
    """Share of the repetitions in which a claim about groups ``[repetitions, seeds]`` has these outcomes."""
    verdicts = [claim.check({"return": dict(zip("abc", each, strict=False))}) for each in zip(*groups, strict=True)]
    return np.mean([verdict.outcome in outcomes for verdict in verdicts])


@pytest.mark.parametrize(("draw", "seeds"), [(normal, 3), (near_a_ceiling, 2), (near_a_ceiling, 10)])
class TestFalseDecisions:
    repetitions = 1000

    def groups(self, draw, seeds, number):
        generator = np.random.default_rng(seeds)
        return [draw((self.repetitions, seeds), generator) for _ in range(number)]

    @pytest.mark.parametrize("claim", [["a", "b"], ["a", ["b", "c"]], ["a", "b", "c"]], ids=str)
    def test_equal_groups_are_rarely_called_ordered_or_reversed(self, draw, seeds, claim):
        number = sum(len(names) for names in claim)
        assert decided(Ordered("return", claim), self.groups(draw, seeds, number)) <= 0.06

    @pytest.mark.parametrize(("difference", "false"), [(0.0999, "disagrees"), (0.1001, "agrees")])
    def test_groups_at_the_margin_are_rarely_misjudged(self, draw, seeds, difference, false):
        first, second = self.groups(draw, seeds, 2)
        assert decided(Alike("return", ["a", "b"], within=0.1), [first + difference, second], (false,)) <= 0.06

    @pytest.mark.parametrize(("value", "false"), [(0.4999, "disagrees"), (-0.5001, "agrees")])
    def test_a_mean_at_the_tolerance_is_rarely_misjudged(self, draw, seeds, value, false):
        (values,) = self.groups(draw, seeds, 1)
        bar = 0.06 if draw is normal else 0.08  # skewed values have no second group that makes up for them
        assert decided(Near("return", "a", 0.0, within=0.5), [values + value], (false,)) <= bar


def test_large_differences_are_detected_with_three_seeds():
    """Three deviations apart Welch's test sees most pairs, if not all."""
    generator = np.random.default_rng(0)
    first, second = 5 + normal((500, 3), generator), normal((500, 3), generator)
    assert decided(Ordered("return", ["a", "b"]), [first, second]) > 0.9
