"""When subgoals were found, in figures."""

from pathlib import Path

import numpy as np
import pytest
from test_comparison import legend_of, one_task, run_of

from hdrqn_torchrl.analysis.comparison import DISCOVERY, plot_curves
from hdrqn_torchrl.analysis.discoveries import found_at
from hdrqn_torchrl.analysis.estimates import Group, estimate_curves
from hdrqn_torchrl.analysis.results import Run

NAN = float("nan")


def finds(**columns):
    """A run of three log points, at frames 0, 100 and 200."""
    return run_of(discovery__subgoals=[0, 1, 2], **columns)


def marks(axis):
    return [line.get_xdata().tolist() for line in axis.get_lines() if line.get_marker() == "^"]


def group(label, runs):
    return Group(label, runs, estimate_curves(runs, [name for panel in DISCOVERY for name in panel.columns]))


def test_a_subgoal_is_found_once_however_often_it_is_logged():
    run = finds(discovery__found_1=[0, 80, 80], discovery__found_2=[NAN, 0, 180])
    assert found_at(run).tolist() == [80, 180]
    assert found_at(run, axis="wall_seconds").tolist() == [80 * 60, 180 * 60]


def test_a_slot_that_was_given_away_counts_for_both():
    assert found_at(finds(discovery__found_1=[50, 50, 150])).tolist() == [50, 150]


@pytest.mark.parametrize("metrics", [{}, {"frames": np.array([0.0, 1.0])}])
def test_nothing_is_found_where_subgoals_are_given(metrics):
    assert len(found_at(Run(Path("run"), metrics))) == 0


def test_curves_mark_where_subgoals_were_found(tmp_path, figures):
    found = group("discovered", [finds(discovery__found_1=[0, 80, 80]), finds(discovery__found_1=[0, 0, 160])])
    plot_curves(one_task(found, group("given", [run_of()])), [tmp_path / "a.png"], panels=DISCOVERY)
    assert all(marks(axis) == [[80, 160]] for axis in figures[0].axes)
    assert "a subgoal was found" in legend_of(figures[0])
    numbers = figures[0].axes[0]
    assert numbers.get_ylabel() == "subgoals found" and all(tick == int(tick) for tick in numbers.get_yticks())


def test_other_runs_have_no_marks(tmp_path, figures):
    plot_curves(one_task(group("given", [run_of()])), [tmp_path / "a.png"], panels=DISCOVERY)
    assert len(figures[0].axes) == 2 and "a subgoal was found" not in legend_of(figures[0])
