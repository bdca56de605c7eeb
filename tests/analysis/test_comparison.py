import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import same_color

from hdrqn_torchrl.analysis.comparison import GREEDY, PAPER, Panel, plot_bars, plot_curves
from hdrqn_torchrl.analysis.estimates import Estimate, Group, TaskResults, estimate_curves, estimate_finals
from hdrqn_torchrl.analysis.results import Run

COLUMNS = [name for panel in (*PAPER, *GREEDY) for name in panel if name]
MEMORY = {"memory": {"return_mean": 2.0, "success_rate": 1.0, "steps_mean": 15.5}}
RANDOM = {"random": {"return_mean": -0.9, "success_rate": 0.03, "steps_mean": 48.8}}


def run_of(offset=0.0, points=3, finished=True, **columns):
    frames = np.arange(points) * 100.0
    values = dict.fromkeys(("behaviour/return", "greedy/return", "greedy/success"), offset + frames / 100)
    values |= {name.replace("__", "/"): np.array(column, float) for name, column in columns.items()}
    summary = {"return_mean": 10 + offset} if finished else {}
    return Run(Path("run"), {"frames": frames, "wall_seconds": frames * 60, **values}, summary)


def group(label, runs, references=None, axis="frames"):
    return Group(label, runs, estimate_curves(runs, COLUMNS, axis=axis), references or {})


def finals(label, runs):
    return Group(label, runs, estimate_finals(runs, COLUMNS))


def one_task(*groups):
    return [TaskResults("gridworld", list(groups))]


def solid(axis):
    return {
        line.get_label(): [point for point in line.get_xydata().tolist() if point == point and point[1] == point[1]]
        for line in axis.get_lines()
        if not line.get_label().startswith("_")
    }


def horizontal(axis):
    """Height and colour of the reference lines."""
    return [(line.get_ydata()[0], line.get_color()) for line in axis.get_lines() if list(line.get_xdata()) == [0, 1]]


def legend_of(figure):
    return [text.get_text() for text in figure.legends[0].get_texts() if text.get_text()]


def test_estimates_are_lines_with_bands(tmp_path, figures):
    plot_curves(one_task(group("v2", [run_of(0), run_of(2)])), [tmp_path / "a.png"], panels=GREEDY, title="heading")
    returns, success = figures[0].axes
    assert solid(returns) == {"v2": [[0, 1], [100, 2], [200, 3]]}
    (band,) = [each for each in returns.collections if isinstance(each, PolyCollection)]
    box = band.get_datalim(returns.transData)
    assert (box.ymin, box.ymax) == pytest.approx((1 - 12.706, 3 + 12.706), abs=1e-3)
    assert returns.get_ylabel() == "reward per episode" and returns.get_xlabel() == "environment frames"
    assert success.get_ylabel() == "success (all goals in order)"
    assert returns.get_title(loc="left") == "gridworld" and figures[0].get_suptitle() == "heading"
    assert "v2 (2 seeds)" in legend_of(figures[0])
    assert figures[0].legends[0].get_title().get_text() == "mean over seeds with 95 % t interval"


@pytest.mark.parametrize("starts", [(0.0, 0.1), (0.0, 8.0)])
def test_wide_intervals_do_not_flatten_the_curves(tmp_path, figures, starts):
    """Those of two seeds reach 6 times as far as the seeds are apart."""
    runs = [run_of(start) for start in starts]
    plot_curves(one_task(group("v2", runs)), [tmp_path / "a.png"], panels=GREEDY[:1])
    (axis,) = figures[0].axes
    low, high = axis.get_ylim()
    shown = 2 * 1.1  # from the first point to the last, with margins
    assert high - low <= 2 * shown + 1e-6
    if starts[1] < 1:
        assert low < 0.05 - 6.3 * 0.1 and high > 2.05 + 6.3 * 0.1  # seen whole


def test_a_curve_is_solid_as_far_as_all_runs_reach_and_dotted_beyond(tmp_path, figures):
    runs = [run_of(0, points=4), run_of(2, points=4), run_of(4, points=2)]
    plot_curves(one_task(group("v2", runs)), [tmp_path / "a.png"], panels=GREEDY[:1])
    (axis,) = figures[0].axes
    assert solid(axis) == {"v2": [[0, 2], [100, 3]]}
    dotted = [line.get_xydata().tolist() for line in axis.get_lines() if line.get_linestyle() == ":"]
    assert dotted == [[[0, 2], [100, 3], [200, 3], [300, 4]]]
    assert "dotted where not all seeds reach" in figures[0].legends[0].get_title().get_text()


def test_the_papers_curves_have_greedy_evaluations_as_points(tmp_path, figures):
    runs = [run_of(0, greedy__return=[np.nan, 5, 6]), run_of(2, greedy__return=[np.nan, 7, 8])]
    plot_curves(one_task(group("v2", runs)), [tmp_path / "a.png"])
    (axis,) = figures[0].axes  # there are no data for the three others
    assert solid(axis) == {"v2": [[0, 1], [100, 2], [200, 3]]}
    (points,) = [line for line in axis.get_lines() if line.get_marker() == "o"]
    assert points.get_xydata().tolist() == [[100, 6], [200, 7]]
    ((_, _, (bars,)),) = axis.containers
    ends = [segment[:, 1].tolist() for segment in bars.get_segments()]
    assert ends == [pytest.approx([height - 12.706, height + 12.706], abs=1e-3) for height in (6, 7)]
    assert {"greedy evaluation", "while training, with exploration"} <= set(legend_of(figures[0]))


def test_an_estimate_outside_its_interval_can_be_drawn(tmp_path, figures):
    """An interquartile mean may be, and matplotlib refuses error bars of negative length."""
    x = np.zeros(1)
    skewed = Estimate(x, value=x + 5, low=x + 1, high=x + 4, runs=np.array([4]), samples=np.full((4, 1), 5.0))
    estimates = {"behaviour/return": skewed, "greedy/return": skewed}
    plot_curves(one_task(Group("v2", [run_of()], estimates)), [tmp_path / "a.png"], panels=PAPER[:1])
    ((low, high),) = (segment[:, 1] for segment in figures[0].axes[0].containers[0][2][0].get_segments())
    assert (low, high) == (1, 5)


def test_a_single_log_point_is_visible(tmp_path, figures):
    run = run_of(behaviour__return=[np.nan, 1, np.nan])
    plot_curves(one_task(group("v2", [run])), [tmp_path / "a.png"], panels=[Panel("behaviour/return")])
    assert [line.get_marker() for line in figures[0].axes[0].get_lines()] == ["_", "None"]


def test_references_that_groups_share_are_grey_and_others_have_their_colours(tmp_path, figures):
    better = {"memory": {"return_mean": 3.0, "success_rate": 1.0, "steps_mean": 12.0}}
    groups = [group("view=3", [run_of()], MEMORY | RANDOM), group("view=5", [run_of(1)], better | RANDOM)]
    plot_curves(one_task(*groups), [tmp_path / "a.png"], panels=GREEDY[:2])
    returns, success = figures[0].axes
    colors = {line.get_label(): line.get_color() for line in returns.get_lines() if line.get_label() in solid(returns)}
    memory_3, memory_5, random = horizontal(returns)
    assert memory_3 == (2.0, colors["view=3"]) and memory_5 == (3.0, colors["view=5"])
    assert random[0] == -0.9 and random[1] not in colors.values()
    assert [height for height, _ in horizontal(success)] == [1.0, 0.03]
    assert legend_of(figures[0])[-2:] == ["ceiling: perfect memory", "floor: random"]


def test_tasks_are_rows_and_groups_keep_their_colour(tmp_path, figures):
    tasks = [
        TaskResults("four_rooms", [group("v2", [run_of()])]),
        TaskResults("gridworld", [group("dqn", [run_of()]), group("v2", [run_of(1), run_of(2)])]),
    ]
    plot_curves(tasks, [tmp_path / "a.png"], panels=GREEDY[:1])
    first, second = figures[0].axes
    color = {line.get_label(): line.get_color() for line in (*second.get_lines(), *first.get_lines())}
    assert color["dqn"] != color["v2"]
    assert {line.get_color() for line in first.get_lines()} == {color["v2"]}
    assert [axis.get_title(loc="left") for axis in (first, second)] == ["four_rooms", "gridworld"]
    assert legend_of(figures[0])[:2] == ["dqn (1 seed)", "v2 (1 to 2 seeds)"]


def test_a_panel_without_values_has_no_scale(tmp_path, figures):
    tasks = [
        TaskResults("gridworld", [group("v2", [run_of(greedy__steps=[3.0, 2.0, 1.0])])]),
        TaskResults("maze", [group("dqn", [run_of()])]),
    ]
    plot_curves(tasks, [tmp_path / "a.png"], panels=[GREEDY[0], GREEDY[3]])
    assert [len(axis.get_xticks()) > 0 for axis in figures[0].axes] == [True, True, True, False]


def test_many_groups_never_look_the_same(tmp_path, figures):
    plot_curves(
        one_task(*(group(str(index), [run_of(index)]) for index in range(20))), [tmp_path / "a.png"], panels=GREEDY[:1]
    )
    handles = figures[0].legends[0].legend_handles[:20]
    assert len({(handle.get_color(), handle.get_marker()) for handle in handles}) == 20


@pytest.mark.parametrize(
    ("points", "last", "label"),
    [(2, 6000 / 60, "wall time (minutes)"), (3, 12000 / 3600, "wall time (hours)")],
)
def test_wall_time_has_a_readable_unit(tmp_path, figures, points, last, label):
    plot_curves(
        one_task(group("v2", [run_of(points=points)], axis="wall_seconds")),
        [tmp_path / "a.png"],
        panels=GREEDY[:1],
        axis="wall_seconds",
    )
    (axis,) = figures[0].axes
    assert axis.get_xlabel() == label
    assert axis.get_lines()[0].get_xdata()[-1] == pytest.approx(last)


def test_shares_are_percentages_and_frames_have_prefixes(tmp_path, figures):
    plot_curves(one_task(group("v2", [run_of()])), [tmp_path / "a.png"], panels=GREEDY[1:2])
    (axis,) = figures[0].axes
    assert axis.yaxis.get_major_formatter()(0.25) == "25%"
    assert axis.xaxis.get_major_formatter()(200_000) == "200k"


def test_the_axis_can_be_logarithmic(tmp_path, figures):
    plot_curves(one_task(group("v2", [run_of()])), [tmp_path / "a.png"], log_x=True)
    assert {axis.get_xscale() for axis in figures[0].axes} == {"log"}


def test_bars_have_intervals_and_a_dot_for_each_run(tmp_path, figures):
    groups = [finals("v1", [run_of(0), run_of(4)]), finals("v2", [run_of(1), run_of(3, finished=False)])]
    plot_bars(one_task(*groups), [tmp_path / "a.png"], panels=GREEDY[:1])
    (axis,) = figures[0].axes
    bars = [container.patches[0] for container in axis.containers if hasattr(container, "patches")]
    assert [bar.get_height() for bar in bars] == [12, (11 + 5) / 2]
    assert [bool(bar.get_hatch()) for bar in bars] == [False, True]
    intervals = [container[2][0].get_segments()[0][:, 1].tolist() for container in axis.containers[2:]]
    assert intervals == [
        pytest.approx([12 - 25.41, 12 + 25.41], abs=1e-2),
        pytest.approx([8 - 38.12, 8 + 38.12], abs=1e-2),
    ]
    dots = [line for line in axis.get_lines() if line.get_marker() == "o"]
    assert [dot.get_ydata()[0] for dot in dots] == [10, 14, 11, 5]
    assert [same_color(dot.get_markerfacecolor(), "white") for dot in dots] == [False, False, False, True]
    assert [tick.get_text() for tick in axis.get_xticklabels()] == ["v1", "v2"]
    assert {"v1 (2 seeds)", "unfinished run", "some runs unfinished"} <= set(legend_of(figures[0]))


def test_finished_runs_need_no_explanation(tmp_path, figures):
    plot_bars(one_task(finals("v1", [run_of(0)])), [tmp_path / "a.png"])
    assert legend_of(figures[0]) == ["v1 (1 seed)", "finished run"]


def test_many_bars_are_horizontal_with_their_names_once(tmp_path, figures):
    groups = [Group(f"g{i}", [run_of(i), run_of(i + 1)], finals("", [run_of(i), run_of(i + 1)]).estimates, MEMORY)
              for i in range(9)]  # fmt: skip
    plot_bars(one_task(*groups), [tmp_path / "a.png"], panels=GREEDY[:2])
    first, second = figures[0].axes
    assert [bar.get_width() for bar in first.patches] == [10.5 + i for i in range(9)]
    assert [label.get_text() for label in first.get_yticklabels()] == [f"g{i}" for i in range(9)]
    assert {label.get_text() for label in second.get_yticklabels()} == {""}
    assert first.get_ylim()[0] > first.get_ylim()[1]  # the first on top
    assert first.get_xlabel() == "reward per episode" and second.get_xlim() == (-0.03, 1.05)
    assert [line.get_xdata()[0] for line in first.get_lines() if list(line.get_ydata()) == [0, 1]] == [2.0]
    assert legend_of(figures[0])[0] == "finished run"


@pytest.mark.parametrize("plot", [plot_curves, plot_bars])
def test_no_data_at_all_is_an_error(tmp_path, plot):
    with pytest.raises(ValueError, match="panels must name columns that a group has estimates for, got sub/loss"):
        plot(one_task(group("v2", [run_of()])), [tmp_path / "a.png"], panels=[Panel("sub/loss")])


@pytest.mark.parametrize(("plot", "make"), [(plot_curves, group), (plot_bars, finals)])
@pytest.mark.filterwarnings("error")
def test_every_format_is_written_and_repeats_byte_for_byte(tmp_path, plot, make):
    starts = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}
    for attempt in ("first", "second"):
        (tmp_path / attempt).mkdir()
        plot(
            one_task(make("v2", [run_of(0), run_of(2)])),
            [tmp_path / attempt / f"a.{end}" for end in starts],
            panels=GREEDY[:1],
        )
    for end, start in starts.items():
        first, second = ((tmp_path / attempt / f"a.{end}").read_bytes() for attempt in ("first", "second"))
        assert first.startswith(start) and first == second
    assert not pyplot.get_fignums()


def test_labels_do_not_touch_each_other(tmp_path, figures):
    """Panels keep their distance, and neither legend nor title lies on them."""
    tasks = [
        TaskResults(json.dumps(name), [group(f"algorithm {index}", [run_of(index)], MEMORY) for index in range(7)])
        for name in ("gridworld", "four_rooms")
    ]
    plot_curves(tasks, [tmp_path / "a.png"], panels=GREEDY[:2], title="heading")
    figure = figures[0]
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    boxes = [axis.get_tightbbox(renderer) for axis in figure.axes]
    boxes += [figure.legends[0].get_window_extent(renderer), figure._suptitle.get_window_extent(renderer)]
    for index, box in enumerate(boxes):
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1
        assert not any(box.overlaps(other) for other in boxes[index + 1 :])
