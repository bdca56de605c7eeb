import numpy as np
import pytest

from hdrqn_torchrl.analysis.figures import plot_legs, plot_legs_over_time, plot_places
from hdrqn_torchrl.analysis.results import Run


def test_legs_are_drawn_as_shares_and_counts(tmp_path, figures):
    options, reached = np.array([[0, 4], [1, 0], [2, 0]]), np.array([[0, 3], [0, 0], [2, 0]])
    plot_legs(options, reached, ["key", "door"], tmp_path / "legs.png")
    axis, _ = figures[0].axes
    assert [text.get_text() for text in axis.texts] == ["75%\n(4)", "0%\n(1)", "100%\n(2)"]  # none where none was tried
    assert [label.get_text() for label in axis.get_yticklabels()] == ["key", "door", "start"]
    shown = axis.images[0].get_array()
    assert shown[0, 1] == 0.75 and np.ma.getmaskarray(np.ma.masked_invalid(shown))[0, 0]
    assert (tmp_path / "legs.png").stat().st_size > 1000


def test_legs_over_time_are_means_over_log_points(tmp_path, figures):
    """Each part of a run has the mean over its log points, without those that had no such option."""
    nan = float("nan")
    metrics = {f"legs/{place}_to_{goal}": np.full(4, nan) for place in (0, 1, "start") for goal in (0, 1)}
    metrics["legs/start_to_1"], metrics["frames"] = np.array([0.0, 0.5, nan, 1.0]), np.array([1e5, 2e5, 3e5, 4e5])
    plot_legs_over_time(Run(tmp_path, metrics), ["key", "door"], tmp_path / "legs.png", windows=2)
    early, late, _ = figures[0].axes
    assert [text.get_text() for text in early.texts] == ["25%"] and [text.get_text() for text in late.texts] == ["100%"]
    assert early.get_title() == "0.10M to 0.20M frames"
    assert early.images[0].get_array()[2, 1] == 0.25
    with pytest.raises(ValueError, match=r"run must have logged its legs, but .* has no legs/start_to_0"):
        plot_legs_over_time(
            Run(tmp_path, {"frames": np.ones(1), **dict.fromkeys(list(metrics)[:4], nan)}), ["a", "b"], tmp_path
        )


def test_places_are_drawn_over_the_screen(tmp_path, figures):
    counts = np.zeros((105, 80), np.int64)
    counts[3, 4] = 7
    plot_places(counts, np.zeros((210, 160, 3), np.uint8), tmp_path / "places.png")
    _, heat = figures[0].axes[0].images
    assert heat.get_array().count() == 1 and heat.get_array()[3, 4] == 7
    assert heat.get_extent() == [0, 160, 210, 0]
