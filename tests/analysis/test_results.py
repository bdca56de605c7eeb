import json
import math
from pathlib import Path

import numpy as np
import pytest

from hdrqn_torchrl.analysis.results import (
    Run,
    curve,
    final_value,
    find_runs,
    read_metrics,
    read_run,
    smoothed,
    source_of,
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
    def test_metrics_are_read_as_columns_with_nan_for_empty_cells(self, tmp_path):
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
    def test_a_metrics_file_without_rows_is_empty(self, tmp_path, text, columns):
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
        assert run.metrics["frames"].tolist() == [0, 10, 20, 30, 40]
        assert run.metrics["loss"].tolist() == [1, 2, 5, 6, 7]
        assert [column.tolist() for column in curve(run, "loss")] == [[0, 10, 20, 30, 40], [1, 2, 5, 6, 7]]

    def test_summary_and_error_are_read(self, tmp_path):
        summary = json.dumps({"return_mean": 1.5, "frames": 10, "ceiling": None})
        done = read_run(write(tmp_path / "done", "frames\n10\n", summary_json=summary))
        failed = read_run(write(tmp_path / "failed", "frames\n10\n", error_txt="Traceback"))
        assert (done.summary, done.failed) == ({"return_mean": 1.5, "frames": 10}, False)
        assert (failed.summary, failed.failed) == ({}, True)

    def test_the_summary_of_a_run_that_was_resumed_since_is_ignored(self, tmp_path):
        run = read_run(write(tmp_path / "run", "frames\n10\n20\n", summary_json='{"return_mean": 1, "frames": 10}'))
        assert run.summary == {}

    @pytest.mark.parametrize(
        ("text", "summary", "reason"),
        [
            ("frames\n", None, "no complete log point"),
            ("loss\n1\n", None, "no complete log point"),
            ("frames\n1\n", "[1", "summary.json must be a JSON file"),
            ("frames\nnan\n", None, "must hold the frames of every row"),
            ("frames\n1\n", "[1]", "summary.json must hold"),
        ],
    )
    def test_a_run_that_can_not_be_read_is_reported_with_the_reason(self, tmp_path, text, summary, reason):
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

    def test_a_run_and_links_to_it_are_one(self, outputs):
        (outputs / "sweep" / "latest").symlink_to(outputs / "sweep" / "1-v2")
        assert find_runs([f"{outputs}/sweep"]) == [outputs / "sweep/0-v1", outputs / "sweep/1-v2"]
        assert find_runs(["outputs/sweep/0-v1", f"{outputs}/sweep/0-v1"]) == [outputs / "sweep/0-v1"]
        assert find_runs([f"{outputs}/sweep/latest"]) == [outputs / "sweep/latest"]

    def test_runs_are_found_by_absolute_patterns(self, outputs):
        assert find_runs([f"{outputs}/sweep/**"]) == [outputs / "sweep/0-v1", outputs / "sweep/1-v2"]


class TestCurve:
    def test_gaps_are_left_out_of_a_curve(self):
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
        run = run_of({"intrinsic_mean": 0.0}, frames=[0, 1], **columns)
        assert len(curve(run, "greedy/intrinsic")[0]) == points
        assert np.isnan(final_value(run, "greedy/intrinsic")) == (points == 0)

    def test_evaluations_are_not_smoothed(self):
        values = {"greedy__return": [0, NAN, 1, NAN, 5], "behaviour__return": [0, 1, 2, 0, 2]}
        run = run_of(frames=[0, 1, 2, 3, 4], **values)
        assert curve(run, "greedy/return", smooth=3)[1].tolist() == [0, 1, 5]
        assert curve(run, "behaviour/return", smooth=3)[1].tolist() == [0.5, 1, 1, 4 / 3, 1]

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
    def test_smoothing_is_a_centred_average_of_the_available_points(self, window, expected):
        assert smoothed(np.array([1.0, 2.0, 6.0, 3.0]), window) == pytest.approx(expected)

    def test_smoothing_keeps_short_curves_as_they_are(self):
        assert smoothed(np.array([1.0, 5.0]), 5).tolist() == [1, 5]


class TestFinalValue:
    @pytest.mark.parametrize(
        ("asked", "expected"),
        [
            ("frames until behaviour/return>=1", 20),
            ("wall_seconds until behaviour/return >= 0.5", 3),
            ("frames until behaviour/return>=-1", 10),
            ("frames until behaviour/return>=1.51", None),
            ("frames until nothing>=1", None),
        ],
    )
    def test_a_final_value_can_be_the_time_to_reach_a_level(self, asked, expected):
        run = run_of(frames=[0, 10, 20, 30], wall_seconds=[0, 3, 6, 9], behaviour__return=[NAN, 0.5, 1, 1.5])
        assert final_value(run, asked) == pytest.approx(NAN if expected is None else expected, nan_ok=True)

    def test_a_time_to_a_level_has_the_source_of_its_column(self):
        assert source_of("frames until behaviour/return>=1") == "behaviour/return"
        assert source_of("greedy/return") == "greedy/return"
