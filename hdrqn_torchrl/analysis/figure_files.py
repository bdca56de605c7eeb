"""Figures as files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from hdrqn_torchrl.runs.persistence.files import replaced


def save_figure(figure: Figure, path: Path, **options: Any) -> None:
    """Writes a figure to a file that is either whole or the one before, even if the disk is full.

    Args:
        figure: what to write.
        path: the file; its ending chooses the format.
        options: of :meth:`matplotlib.figure.Figure.savefig`.

    Raises:
        OSError: if it can't be written.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp(), "empty.png")
        >>> save_figure(Figure(), path, dpi=50)
        >>> path.stat().st_size > 0
        True
    """
    with replaced(path) as partial:
        figure.savefig(partial, **options)
