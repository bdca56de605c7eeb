import math

import pytest
from matplotlib import pyplot

from hdrqn_torchrl.analysis.plotting import plot_run

METRICS = {
    "frames": [0.0, 100.0, 200.0],
    "behaviour/return": [math.nan, 0.5, 0.75],
    "greedy/return": [0.25, math.nan, 1.0],
    "greedy/steps": [50.0, math.nan, 20.0],
}
REFERENCES = {"memory": {"return_mean": 2.0, "steps_mean": 16.5}, "random": {"return_mean": -0.35, "steps_mean": 48.8}}


def lines(axis):
    return {line.get_label(): line.get_xydata().tolist() for line in axis.get_lines() if line.get_linestyle() == "-"}


def test_curves_skip_the_gaps_and_references_are_dashed(tmp_path, figures):
    plot_run(METRICS, tmp_path / "curves.png", title="a run", references=REFERENCES)
    returns, steps = figures[0].axes
    assert lines(returns) == {"behaviour": [[100.0, 0.5], [200.0, 0.75]], "greedy": [[0.0, 0.25], [200.0, 1.0]]}
    assert lines(steps) == {"greedy": [[0.0, 50.0], [200.0, 20.0]]}
    dashed = [line.get_ydata()[0] for line in returns.get_lines() if line.get_linestyle() == "--"]
    assert dashed == [2.0, -0.35]
    assert {text.get_text() for text in returns.texts} == {"memory", "random"}
    assert figures[0].get_suptitle() == "a run"


def test_a_quantity_without_values_has_no_panel(tmp_path, figures):
    plot_run(METRICS | {"greedy/intrinsic": [math.nan] * 3}, tmp_path / "curves.png")
    assert [axis.get_title() for axis in figures[0].axes] == ["total reward of an episode", "steps of an episode"]


def test_the_picture_is_written_without_pyplots_global_state(tmp_path):
    plot_run(METRICS, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert not pyplot.get_fignums()


@pytest.mark.parametrize("metrics", [{}, {"frames": [0.0]}, {"frames": [0.0], "greedy/return": [math.nan]}], ids=str)
@pytest.mark.filterwarnings("error")
def test_a_run_without_results_has_an_empty_picture(tmp_path, metrics):
    plot_run(metrics, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").exists()
