"""Where options lead and where the agent was, as pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray


def plot_legs(
    options: NDArray[np.integer[Any]], reached: NDArray[np.integer[Any]], names: Sequence[str], path: Path
) -> None:
    """Share of the options that reached their subgoal, by where they began (rows) and what they pursued (columns).

    Args:
        options, reached: counts ``[G + 1, G]`` of a :class:`~hdrqn_torchrl.legs.LegCounter`.
        names: of the subgoals.
        path: picture to write.
    """
    rates = np.where(options > 0, reached / np.maximum(options, 1), np.nan)
    figure = Figure(figsize=(1.6 + 0.75 * len(names), 1.3 + 0.5 * len(names)), layout="constrained")
    axis = figure.subplots()
    image = axis.imshow(rates, vmin=0.0, vmax=1.0, cmap="viridis", aspect="auto")
    axis.set_xticks(range(len(names)), names, rotation=35, ha="right", rotation_mode="anchor", fontsize=8)
    axis.set_yticks(range(len(names) + 1), [*names, "start"], fontsize=8)
    axis.set(xlabel="to", ylabel="from")
    for (row, column), rate in np.ndenumerate(rates):
        if options[row, column]:
            ink = "black" if rate > 0.6 else "white"
            text = f"{rate:.0%}\n({options[row, column]})"
            axis.text(column, row, text, ha="center", va="center", fontsize=7, color=ink)
    figure.colorbar(image, label="reached")
    figure.savefig(path, dpi=150)


def plot_places(counts: NDArray[np.integer[Any]], screen: NDArray[np.uint8], path: Path) -> None:
    """Where the agent was, over the screen.

    Args:
        counts: of a :class:`~hdrqn_torchrl.evaluation.PlaceCounter`.
        screen: ``[height, width, 3]``.
        path: picture to write.
    """
    height, width, _ = screen.shape
    figure = Figure(figsize=(6.0, 4.5), layout="constrained")
    axis = figure.subplots()
    extent = (0, width, height, 0)
    axis.imshow(screen // 2, extent=extent, aspect=0.75 * width / height)
    seen = np.ma.masked_equal(counts, 0)
    image = axis.imshow(seen, extent=extent, aspect=0.75 * width / height, cmap="inferno", norm=LogNorm(), alpha=0.85)
    axis.set_axis_off()
    figure.colorbar(image, label="steps")
    figure.savefig(path, dpi=150)
