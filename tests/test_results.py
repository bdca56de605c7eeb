import json
import math
from pathlib import Path

import numpy as np
import pytest

from hdrqn_torchrl.results import (
    Group,
    Run,
    TaskResults,
    align,
    center_of,
    curve,
    estimate,
    estimate_curves,
    estimate_finals,
    final_value,
    find_runs,
    read_metrics,
    read_run,
    smoothed,
    write_table,
)

NAN = math.nan


def run_of(summary=None, **columns):
    named = {name.replace("__", "/"): np.array(column, float) for name, column in columns.items()}
    return Run(Path("run"), named, summary or {})


def write(folder, text, **files):
    folder.mkdir(parents=True)
    (folder / "metrics.csv").write_text(text)
    for name, content in files.items():
        (folder / name.replace("_", ".")).write_text(content)
    return folder


class TestReading:
    def test_columns_and_nan_for_empty_cells(self, tmp_path):
        (tmp_path / "metrics.csv").write_text("frames,loss\n0,\n10,0.5\n")
        metrics = read_metrics(tmp_path / "metrics.csv")
        assert metrics["frames"] == [0.0, 10.0]
        assert math.isnan(metrics["loss"][0]) and metrics["loss"][1] == 0.5

    @pytest.mark.parametrize("half", ["2", "20", "20,", "20,0.", "20,0.25"], ids=repr)
    def test_a_last_line_without_its_end_is_left_out(self, tmp_path, half):
        (tmp_path / "metrics.csv").write_text(f"frames,loss\n10,0.5\n{half}")
        assert read_metrics(tmp_path / "metrics.csv") == {"frames": [10.0], "loss": [0.5]}

    @pytest.mark.parametrize(
        ("text", "columns"),
        [("", {}), ("frames,lo", {}), ("frames,loss\n", {"frames": [], "loss": []})],
        ids=["empty", "half a header", "header only"],
    )
    def test_a_file_without_rows(self, tmp_path, text, columns):
        (tmp_path / "metrics.csv").write_text(text)
        assert read_metrics(tmp_path / "metrics.csv") == columns

    @pytest.mark.parametrize(
        ("text", "reason"),
        [
            ("frames,loss\n10,0.5\n20\n30,1\n", "line 3 has 1 cells, the header has 2"),
            ("frames,loss\n10,0.520,1\n30,1\n", "line 2 has 3 cells"),
            ("frames,loss\n10,what\n", "what"),
            ("frames,loss\n10,\0\0\0\n", "metrics.csv must be a table"),
        ],
    )
    def test_a_broken_file_is_named_with_the_reason(self, tmp_path, text, reason):
        (tmp_path / "metrics.csv").write_text(text)
        with pytest.raises(ValueError, match=reason) as caught:
            read_metrics(tmp_path / "metrics.csv")
        assert str(tmp_path / "metrics.csv") in str(caught.value)

    def test_rows_that_a_resumed_run_logged_again_replace_the_earlier_ones(self, tmp_path):
        text = "frames,loss\n0,1\n10,2\n20,3\n30,4\n20,5\n30,6\n40,7\n"
        run = read_run(write(tmp_path / "run", text))
        assert run.metrics["frames"].tolist() == [0, 10, 20, 20, 30, 40]
        assert [column.tolist() for column in curve(run, "loss")] == [[0, 10, 20, 30, 40], [1, 2, 5, 6, 7]]

    def test_summary_and_error_are_read(self, tmp_path):
        summary = json.dumps({"return_mean": 1.5, "frames": 10, "ceiling": None})
        done = read_run(write(tmp_path / "done", "frames\n10\n", summary_json=summary))
        failed = read_run(write(tmp_path / "failed", "frames\n10\n", error_txt="Traceback"))
        assert (done.summary, done.failed) == ({"return_mean": 1.5, "frames": 10}, False)
        assert (failed.summary, failed.failed) == ({}, True)

    def test_the_summary_of_a_run_that_went_on_since_does_not_count(self, tmp_path):
        run = read_run(write(tmp_path / "run", "frames\n10\n20\n", summary_json='{"return_mean": 1, "frames": 10}'))
        assert run.summary == {}

    @pytest.mark.parametrize(
        ("text", "summary", "reason"),
        [
            ("frames\n", None, "no complete log point"),
            ("loss\n1\n", None, "no complete log point"),
            ("frames\n1\n", "[1", "summary.json must hold"),
            ("frames\n1\n", "[1]", "summary.json must hold"),
        ],
    )
    def test_a_run_that_cannot_be_read_says_why(self, tmp_path, text, summary, reason):
        files = {} if summary is None else {"summary_json": summary}
        with pytest.raises(ValueError, match=reason):
            read_run(write(tmp_path / "run", text, **files))


class TestFindRuns:
    @pytest.fixture
    def outputs(self, tmp_path, monkeypatch):
        for name in ("sweep/0-v1", "sweep/1-v2", "gridworld-v2/a[1]"):
            write(tmp_path / "outputs" / name, "frames\n0\n")
        (tmp_path / "outputs" / "sweep" / "0-v1" / "checkpoints").mkdir()
        monkeypatch.chdir(tmp_path)
        return tmp_path / "outputs"

    @pytest.mark.parametrize(
        ("patterns", "found"),
        [
            (["outputs/**"], ["gridworld-v2/a[1]", "sweep/0-v1", "sweep/1-v2"]),
            (["outputs"], ["gridworld-v2/a[1]", "sweep/0-v1", "sweep/1-v2"]),
            (["**"], ["gridworld-v2/a[1]", "sweep/0-v1", "sweep/1-v2"]),
            (["outputs/sweep/"], ["sweep/0-v1", "sweep/1-v2"]),
            (["outputs/s*"], ["sweep/0-v1", "sweep/1-v2"]),
            (["outputs/**/*v2"], ["gridworld-v2/a[1]", "sweep/1-v2"]),
            (["outputs/sweep/*/metrics.csv"], ["sweep/0-v1", "sweep/1-v2"]),
            (["outputs/sweep/1-v2", "outputs/sweep/*"], ["sweep/0-v1", "sweep/1-v2"]),
            (["outputs/gridworld-v2/a[1]"], ["gridworld-v2/a[1]"]),
            (["outputs/sweep/0-v1/checkpoints", "nowhere/**"], []),
        ],
        ids=str,
    )
    def test_folders_with_metrics_at_or_below_a_pattern(self, outputs, patterns, found):
        assert find_runs(patterns) == [Path("outputs") / name for name in found]

    def test_absolute_patterns(self, outputs):
        assert find_runs([f"{outputs}/sweep/**"]) == [outputs / "sweep/0-v1", outputs / "sweep/1-v2"]


class TestCurve:
    def test_gaps_are_left_out(self):
        run = run_of(frames=[0, 10, 20], greedy__return=[0.5, NAN, 1])
        assert [part.tolist() for part in curve(run, "greedy/return")] == [[0, 20], [0.5, 1]]

    def test_positions_rise_strictly_and_the_last_value_counts(self):
        run = run_of(frames=[0, 1, 2, 3], episodes=[0, 5, 5, 9], loss=[1, 2, 3, 4])
        assert [part.tolist() for part in curve(run, "loss", axis="episodes")] == [[0, 5, 9], [1, 3, 4]]

    def test_values_that_are_not_finite_are_left_out(self):
        assert curve(run_of(frames=[0, 1], loss=[math.inf, 2]), "loss")[1].tolist() == [2]

    @pytest.mark.parametrize("column", ["nothing", "loss"])
    def test_a_column_without_values_is_empty(self, column):
        assert [len(part) for part in curve(run_of(frames=[0, 1], loss=[NAN, NAN]), column)] == [0, 0]

    @pytest.mark.parametrize(("intrinsic", "points"), [([NAN, 0.5], 2), ([NAN, NAN], 0), (None, 0)])
    def test_flat_agents_have_no_intrinsic_reward(self, intrinsic, points):
        columns = {"greedy__intrinsic": [0, 0], "behaviour__return": [NAN, 1]}
        columns |= {} if intrinsic is None else {"behaviour__intrinsic": intrinsic}
        assert len(curve(run_of(frames=[0, 1], **columns), "greedy/intrinsic")[0]) == points

    @pytest.mark.parametrize(
        ("window", "expected"),
        [
            (0, [1, 2, 6, 3]),
            (1, [1, 2, 6, 3]),
            (3, [1.5, 3, 11 / 3, 4.5]),
            (0.5, [1.5, 3, 11 / 3, 4.5]),
            (99, [1.5, 3, 11 / 3, 4.5]),
        ],
    )
    def test_smoothing_is_a_centred_average_of_what_there_is(self, window, expected):
        assert smoothed(np.array([1.0, 2.0, 6.0, 3.0]), window) == pytest.approx(expected)

    def test_smoothing_keeps_short_curves_as_they_are(self):
        assert smoothed(np.array([1.0, 5.0]), 5).tolist() == [1, 5]


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
        assert grid.tolist() == pytest.approx([0, 1.3, 2.6])
        assert values[0] == pytest.approx([0, 1.3, NAN], nan_ok=True)
        assert values[3] == pytest.approx([0, 1, 2])

    def test_a_run_without_values_has_a_row_of_nan(self):
        _, values = align([(np.array([0.0]), np.array([1.0])), (np.empty(0), np.empty(0))])
        assert values == pytest.approx(np.array([[1], [NAN]]), nan_ok=True)


class TestEstimate:
    def at_one_position(self, values, **options):
        return estimate(np.zeros(1), np.array(values, float)[:, None], **options)

    def test_center(self):
        values = np.array([-100.0, 1, 2, 3, 4, 5, 6, 1000])
        assert center_of(values, "iqm") == 3.5  # a quarter of 8 is cut off at either end
        assert center_of(values, "mean") == values.mean()
        assert center_of(np.array([1.0, 2.0, 9.0]), "iqm") == 4.0  # a quarter of 3 is none

    @pytest.mark.parametrize(("center", "value"), [("mean", 32.0), ("iqm", 20.0)])
    def test_estimates_use_the_center(self, center, value):
        assert self.at_one_position([0, 10, 20, 30, 100], center=center).value == [value]

    def test_an_interval_of_two_runs_is_their_range(self):
        """A resample of two repeats one of them in half of the cases."""
        each = self.at_one_position([1, 4])
        assert (each.low[0], each.value[0], each.high[0]) == (1.0, 2.5, 4.0)

    def test_one_run_has_no_interval(self):
        each = self.at_one_position([3])
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

    @pytest.mark.parametrize("center", ["mean", "iqm"])
    def test_intervals_cover_the_truth_about_as_often_as_they_say(self, center):
        each = estimate(np.arange(400.0), np.random.default_rng(2).normal(5, 2, size=(20, 400)), center=center)
        covered = ((each.low <= 5) & (each.high >= 5)).mean()
        assert 0.88 < covered < 0.98

    def test_the_level_of_the_interval_counts(self):
        values = np.random.default_rng(3).normal(size=10)
        narrow, wide = (self.at_one_position(values, confidence=level) for level in (0.5, 0.95))
        assert wide.low < narrow.low < narrow.high < wide.high

    def test_the_same_runs_give_the_same_interval(self):
        values = np.random.default_rng(4).normal(size=7)
        first, second = self.at_one_position(values), self.at_one_position(values)
        assert (first.low, first.high) == (second.low, second.high)

    @pytest.mark.parametrize("center", ["mean", "iqm"])
    def test_runs_are_resampled_within_their_stratum(self, center):
        values, strata = [0, 0, 0, 10, 10, 10], ["a", "a", "a", "b", "b", "b"]
        within = self.at_one_position(values, strata=strata, center=center)
        assert (within.low, within.value, within.high) == (5, 5, 5)
        assert self.at_one_position(values, center=center).low < 5

    def test_a_stratum_of_one_run_leaves_no_interval(self):
        each = self.at_one_position([1, 2, 6], strata=["a", "a", "b"])
        assert each.value == [3] and np.isnan(each.low).all()

    def test_positions_that_less_than_half_of_the_runs_reach_are_left_out(self):
        values = np.array([[0, 1, 2, 3], [2, 3, 4, NAN], [4, 5, NAN, NAN]])
        each = estimate(np.arange(4.0), values)
        assert each.value == pytest.approx([2, 3, 3, NAN], nan_ok=True)
        assert each.runs.tolist() == [3, 3, 2, 1]
        assert np.isfinite(each.low).tolist() == [True, True, True, False]

    def test_half_of_every_stratum_must_reach(self):
        values = np.array([[0, 1], [0, 1], [0, 1], [5, NAN]])
        together = estimate(np.arange(2.0), values)
        apart = estimate(np.arange(2.0), values, strata=["a", "a", "a", "b"])
        assert together.value[1] == 1 and np.isnan(apart.value[1])

    def test_runs_without_any_value_do_not_count(self):
        each = estimate(np.arange(2.0), np.array([[1, 2], [NAN, NAN], [NAN, NAN]]))
        assert each.value.tolist() == [1, 2]

    def test_groups_of_positions_are_kept_apart(self):
        """Positions with the same runs are resampled together; each must get its own result."""
        values = np.array([[1, 10, NAN, 100], [3, NAN, 20, 300], [5, 30, NAN, 500]])
        each = estimate(np.arange(4.0), values)
        assert each.value == pytest.approx([3, 20, NAN, 300], nan_ok=True)
        assert each.low == pytest.approx([1, 10, NAN, 100], nan_ok=True)
        assert each.high == pytest.approx([5, 30, NAN, 500], nan_ok=True)


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
    assert (each.low[0], each.value[0], each.high[0]) == (1, 1.375, 1.75)


def test_the_table_has_a_row_for_each_estimate(tmp_path):
    runs = [run_of(frames=[0, 10, 20], loss=[0.5, 1, 2]), run_of(frames=[0, 10], loss=[1.5, 1])]
    group = Group("v2, view=3", runs, estimate_curves([*runs, run_of(frames=[0], loss=[1])], ["loss"]))
    write_table(tmp_path / "table.csv", [TaskResults("gridworld", [group])], axis="frames")
    assert (tmp_path / "table.csv").read_text().splitlines() == [
        "task,group,metric,axis,x,estimate,low,high,seeds",
        'gridworld,"v2, view=3",loss,frames,0,1,0.5,1.5,3',
        'gridworld,"v2, view=3",loss,frames,10,1,1,1,2',
    ]
