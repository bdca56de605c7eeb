import numpy as np

from hdrqn_torchrl.figures import plot_legs, plot_places


def test_legs(tmp_path, figures):
    options, reached = np.array([[0, 4], [1, 0], [2, 0]]), np.array([[0, 3], [0, 0], [2, 0]])
    plot_legs(options, reached, ["key", "door"], tmp_path / "legs.png")
    axis, _ = figures[0].axes
    assert [text.get_text() for text in axis.texts] == ["75%\n(4)", "0%\n(1)", "100%\n(2)"]  # none where none was tried
    assert [label.get_text() for label in axis.get_yticklabels()] == ["key", "door", "start"]
    shown = axis.images[0].get_array()
    assert shown[0, 1] == 0.75 and np.ma.getmaskarray(np.ma.masked_invalid(shown))[0, 0]
    assert (tmp_path / "legs.png").stat().st_size > 1000


def test_places(tmp_path, figures):
    counts = np.zeros((105, 80), np.int64)
    counts[3, 4] = 7
    plot_places(counts, np.zeros((210, 160, 3), np.uint8), tmp_path / "places.png")
    _, heat = figures[0].axes[0].images
    assert heat.get_array().count() == 1 and heat.get_array()[3, 4] == 7
    assert heat.get_extent() == [0, 160, 210, 0]
