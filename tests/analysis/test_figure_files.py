"""Figures and tables are whole, or what they were before."""

import errno

import numpy as np
import pytest
from matplotlib.figure import Figure

from hdrqn_torchrl.analysis.estimates import write_table
from hdrqn_torchrl.analysis.figure_files import save_figure
from hdrqn_torchrl.analysis.figures import plot_places
from hdrqn_torchrl.analysis.plotting import plot_run


@pytest.fixture
def full_disk(monkeypatch):
    def write_a_part(figure, path, **options):
        path.write_bytes(b"part")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", write_a_part)


@pytest.mark.usefixtures("full_disk")
@pytest.mark.parametrize(
    "draw",
    [
        lambda path: save_figure(Figure(), path),
        lambda path: plot_places(np.ones((4, 4), dtype=int), np.zeros((4, 4, 3), dtype=np.uint8), path),
        lambda path: plot_run({"frames": [1.0]}, path),
    ],
)
def test_a_full_disk_leaves_the_picture_before(tmp_path, draw):
    path = tmp_path / "figure.png"
    path.write_bytes(b"before")
    with pytest.raises(OSError, match="No space left"):
        draw(path)
    assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]


def test_a_table_that_fails_midway_leaves_the_one_before(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("before")

    def tasks():
        raise OSError(errno.ENOSPC, "No space left on device")
        yield

    with pytest.raises(OSError, match="No space left"):
        write_table(path, tasks(), axis="frames")
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]
