import math
from pathlib import Path

import numpy as np
import pytest

from hdrqn_torchrl.analysis.estimates import (
    Group,
    TaskResults,
    align,
    center_of,
    estimate,
    estimate_curves,
    estimate_finals,
    write_table,
)
from hdrqn_torchrl.analysis.results import Run, final_value

NAN = math.nan


def run_of(summary=None, **columns):
    named = {name.replace("__", "/"): np.array(column, float) for name, column in columns.items()}
    return Run(Path("run"), named, summary or {})


class TestAlign:
    def test_curves_logged_at_the_same_positions_stay_as_they_are(self):
        x = np.array([0.0, 7.0, 10.0])
        grid, values = align([(x, np.array([1.0, 2.0, 3.0])), (x[:2], np.array([5.0, 6.0]))])
        assert grid.tolist() == x.tolist()
        assert values == pytest.approx(np.array([[1, 2, 3], [5, 6, NAN]]), nan_ok=True)

    def test_other_positions_are_interpolated_but_never_extrapolated(self):
        fine = np.array([0.0, 10.0, 20.0, 30.0]), np.array([0.0, 1.0, 2.0, 3.0])
        coarse = np.array([5.0, 25.0]), np.array([10.0, 20.0])
        grid, values = align([fine, coarse])
        assert grid.tolist() == [0, 5, 10, 20, 25, 30]
        assert values[0] == pytest.approx([0, 0.5, 1, 2, 2.5, 3])
        assert values[1] == pytest.approx([NAN, 10, 12.5, 17.5, 20, NAN], nan_ok=True)

    def test_positions_that_never_agree_become_evenly_spaced(self):
        clocks = [(np.array([0.0, 1.0, 2.0]) * (1 + shift), np.array([0.0, 1.0, 2.0])) for shift in (0, 0.1, 0.2, 0.3)]
        grid, values = align(clocks)
        assert grid.tolist() == pytest.approx([0, 1.1, 2, 2.2, 2.4, 2.6])  # half of them reach 2.2; and all ends
        assert values[0] == pytest.approx([0, 1.1, 2, NAN, NAN, NAN], nan_ok=True)
        assert values[3] == pytest.approx(np.array([0, 1.1, 2, 2.2, 2.4, 2.6]) / 1.3)

    def test_the_last_points_of_clocks_that_never_agree_are_shown(self):
        clocks = [(np.linspace(0, end, 4), np.linspace(0, 1, 4)) for end in (90.0, 93.0, 97.0, 101.0, 110.0)]
        x, values = align(clocks)
        shown = estimate(x, values).value
        assert x[~np.isnan(shown)][-1] == 97 and np.nanmax(shown) > 0.9

    def test_a_short_run_between_the_common_positions_is_not_lost(self):
        clocks = [(np.array([0.1, 100.0]), np.array([0.0, 1.0]) + run) for run in range(3)]
        clocks = [(x + run * np.array([0.1, 10.0]), y) for run, (x, y) in enumerate(clocks)]
        x, values = align(clocks)
        assert not np.isnan(values).all(1).any()
        assert estimate(x, values).value[x == 110].item() > 0

    def test_a_run_without_values_has_a_row_of_nan(self):
        _, values = align([(np.array([0.0]), np.array([1.0])), (np.empty(0), np.empty(0))])
        assert values == pytest.approx(np.array([[1], [NAN]]), nan_ok=True)


class TestEstimate:
    def at_one_position(self, values, **options):
        return estimate(np.zeros(1), np.array(values, float)[:, None], **options)

    def test_the_center_is_the_mean_or_the_interquartile_mean(self):
        values = np.array([-100.0, 1, 2, 3, 4, 5, 6, 1000])
        assert center_of(values, "iqm") == 3.5  # a quarter of 8 is cut off at either end
        assert center_of(values, "mean") == values.mean()
        assert center_of(np.array([1.0, 2.0, 9.0]), "iqm") == 4.0  # a quarter of 3 is none

    @pytest.mark.parametrize(("center", "value"), [("mean", 32.0), ("iqm", 20.0)])
    def test_estimates_use_the_center(self, center, value):
        assert self.at_one_position([0, 10, 20, 30, 100], center=center).value == [value]

    def test_an_interval_of_two_runs_is_much_wider_than_their_range(self):
        each = self.at_one_position([1, 4])
        assert (each.low[0], each.value[0], each.high[0]) == pytest.approx(
            (2.5 - 12.706 * 1.5, 2.5, 2.5 + 12.706 * 1.5), abs=1e-3
        )

    @pytest.mark.parametrize("values", [[3], [3, 3, 3]])
    def test_one_run_or_equal_ones_have_no_interval(self, values):
        each = self.at_one_position(values)
        assert each.value == [3] and np.isnan([each.low, each.high]).all()

    @pytest.mark.parametrize("center", ["mean", "iqm"])
    def test_intervals_shrink_with_more_runs(self, center):
        values = np.random.default_rng(1).normal(size=(64, 40))
        widths = []
        for runs in (4, 16, 64):
            each = estimate(np.arange(40.0), values[:runs], center=center)
            assert (each.low <= each.value).all() and (each.value <= each.high).all()
            widths.append((each.high - each.low).mean())
        assert widths[0] > 1.3 * widths[1] and widths[1] > 1.6 * widths[2]

    def test_the_level_of_the_interval_counts(self):
        values = np.random.default_rng(3).normal(size=10)
        narrow, wide = (self.at_one_position(values, confidence=level) for level in (0.5, 0.95))
        assert wide.low < narrow.low < narrow.high < wide.high

    @pytest.mark.parametrize("center", ["mean", "iqm"])
    def test_only_differences_within_a_stratum_widen_the_interval(self, center):
        values, strata = [0, 0.1, 0.2, 10, 10.1, 10.2], ["a", "a", "a", "b", "b", "b"]
        within, mixed = (
            self.at_one_position(values, strata=strata, center=center),
            self.at_one_position(values, center=center),
        )
        assert within.value == mixed.value == pytest.approx([5.1])
        assert 4.5 < within.low < 5.1 < within.high < 5.7 and mixed.low < 0

    def test_a_stratum_of_one_run_leaves_no_interval(self):
        each = self.at_one_position([1, 2, 6], strata=["a", "a", "b"])
        assert each.value == [3] and np.isnan(each.low).all()

    def test_positions_that_less_than_half_of_the_runs_reach_are_left_out(self):
        values = np.array([[0, 1, 2, 3], [2, 3, 4, NAN], [4, 5, NAN, NAN]])
        each = estimate(np.arange(4.0), values)
        assert each.value == pytest.approx([2, 3, 3, NAN], nan_ok=True)
        assert each.runs.tolist() == [3, 3, 2, 1]
        assert np.isfinite(each.low).tolist() == [True, True, True, False]

    def test_a_position_needs_half_of_every_stratum(self):
        values = np.array([[0, 1], [0, 1], [0, 1], [5, NAN]])
        together = estimate(np.arange(2.0), values)
        apart = estimate(np.arange(2.0), values, strata=["a", "a", "a", "b"])
        assert together.value[1] == 1 and np.isnan(apart.value[1])

    def test_runs_without_any_value_are_ignored(self):
        each = estimate(np.arange(2.0), np.array([[1, 2], [NAN, NAN], [NAN, NAN]]))
        assert each.value.tolist() == [1, 2]

    def test_positions_with_different_runs_are_estimated_separately(self):
        """Positions with the same runs are computed together; each must get its own result."""
        values = np.array([[1, 10, NAN, 100], [3, NAN, 20, 300], [5, 30, NAN, 500]])
        each = estimate(np.arange(4.0), values)
        assert each.value == pytest.approx([3, 20, NAN, 300], nan_ok=True)
        reach = [4.3027 * 2 / 3**0.5, 12.706 * 10, NAN, 4.3027 * 200 / 3**0.5]
        assert each.low == pytest.approx(each.value - reach, nan_ok=True, rel=1e-4)
        assert each.high == pytest.approx(each.value + reach, nan_ok=True, rel=1e-4)


def test_curves_of_a_group_are_aligned_and_summed_up_by_column():
    first = run_of(frames=[0, 10, 20], episodes=[0, 1, 2], behaviour__return=[NAN, 1, 3])
    second = run_of(frames=[0, 20], episodes=[0, 4], behaviour__return=[0, 4], greedy__return=[1, NAN])
    estimates = estimate_curves([first, second], ["behaviour/return", "greedy/return", "sub/loss"])
    assert set(estimates) == {"behaviour/return", "greedy/return"}
    returns = estimates["behaviour/return"]
    assert returns.x.tolist() == [0, 10, 20]
    assert returns.value.tolist() == [0, 1.5, 3.5]
    assert estimates["greedy/return"].runs.tolist() == [1]
    by_episodes = estimate_curves([first, second], ["behaviour/return"], axis="episodes")["behaviour/return"]
    assert by_episodes.x.tolist() == [0, 1, 2, 4]
    assert by_episodes.value.tolist() == [0, 1, 2.5, 4]


def test_curves_are_smoothed_before_they_are_summed_up():
    run = run_of(frames=[0, 1, 2, 3], loss=[1, 2, 6, 3])
    assert estimate_curves([run], ["loss"], smooth=3)["loss"].value.tolist() == pytest.approx([1.5, 3, 11 / 3, 4.5])


def test_final_values_come_from_the_summary_or_the_last_evaluation():
    columns = {"frames": [0, 1, 2], "greedy__return": [0, 1, NAN], "greedy__success": [0, 0.5, NAN]}
    finished = run_of({"return_mean": 1.75, "success_rate": 0.75}, **columns)
    unfinished = run_of(**columns)
    assert [final_value(finished, f"greedy/{name}") for name in ("return", "success")] == [1.75, 0.75]
    assert [final_value(unfinished, f"greedy/{name}") for name in ("return", "success")] == [1, 0.5]
    assert math.isnan(final_value(unfinished, "greedy/steps"))
    estimates = estimate_finals([finished, unfinished], ["greedy/return", "greedy/steps"])
    assert set(estimates) == {"greedy/return"}
    each = estimates["greedy/return"]
    assert each.value[0] == 1.375 and each.samples.tolist() == [[1.75], [1]]


def test_a_time_is_estimated_only_if_every_run_got_there():
    quick, slow = run_of(frames=[0, 10, 20], loss=[0, 5, 5]), run_of(frames=[0, 10, 20], loss=[0, 0, 5])
    never = run_of(frames=[0, 10, 20], loss=[0, 1, 1])
    column = "frames until loss>=5"
    assert estimate_finals([quick, slow], [column])[column].value.tolist() == [15]
    with_one_missing = estimate_finals([quick, slow, never], [column])[column]
    assert np.isnan([with_one_missing.value, with_one_missing.low]).all() and with_one_missing.runs.tolist() == [2]
    assert with_one_missing.samples.ravel() == pytest.approx([10, 20, NAN], nan_ok=True)


def test_intervals_of_shares_end_at_0_and_1():
    values = [[0, 0.8], [0.2, 1]]
    runs = [run_of(frames=[0, 1], greedy__success=each, loss=each) for each in values]
    columns = ["greedy/success", "loss"]
    for estimates in (estimate_curves(runs, columns), estimate_finals(runs, columns)):
        share, loss = (estimates[name] for name in columns)
        assert share.low.min() >= 0 and share.high.max() == 1
        assert loss.low.min() < 0 and loss.high.max() > 1 and (share.value == loss.value).all()


def test_the_table_has_a_row_for_each_estimate(tmp_path):
    runs = [run_of(frames=[0, 10, 20], loss=[0.5, 1, 2]), run_of(frames=[0, 10], loss=[1.5, 1])]
    group = Group("v2, view=3", runs, estimate_curves([*runs, run_of(frames=[0], loss=[1])], ["loss"]))
    write_table(tmp_path / "table.csv", [TaskResults("gridworld", [group])], axis="frames")
    assert (tmp_path / "table.csv").read_text().splitlines() == [
        "task,group,metric,axis,x,estimate,low,high,seeds",
        'gridworld,"v2, view=3",loss,frames,0,1,-0.242068856,2.24206886,3',
        'gridworld,"v2, view=3",loss,frames,10,1,,,2',
    ]
