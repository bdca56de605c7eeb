"""Where options lead and where the agent was, as pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from hdrqn_torchrl.analysis.figure_files import save_figure
from hdrqn_torchrl.analysis.results import Run


def plot_legs(
    options: NDArray[np.integer[Any]], reached: NDArray[np.integer[Any]], names: Sequence[str], path: Path
) -> None:
    """Share of the options that reached their subgoal, by where they began (rows) and what they pursued (columns).

    Args:
        options, reached: counts ``[G + 1, G]`` of a :class:`~hdrqn_torchrl.learning.legs.LegCounter`.
        names: of the subgoals.
        path: picture to write.
    """
    rates = np.where(options > 0, reached / np.maximum(options, 1), np.nan)
    figure = Figure(figsize=(1.6 + 0.75 * len(names), 1.3 + 0.5 * len(names)), layout="constrained")
    axis = figure.subplots()
    image = _draw_legs(axis, rates, [f"\n({number})" for number in options.flat], names)
    axis.set(xlabel="to", ylabel="from")
    figure.colorbar(image, label="reached")
    save_figure(figure, path, dpi=150)


def plot_legs_over_time(run: Run, names: Sequence[str], path: Path, *, windows: int = 6) -> None:
    """The same while training: one matrix for each part of a run, of what it logged as ``legs/FROM_to_TO``.

    Args:
        run: of an agent with options.
        names: of the subgoals.
        path: picture to write.
        windows: number of parts, of as many log points each.

    Raises:
        ValueError: if the run has no such columns.
    """
    places = [*map(str, range(len(names))), "start"]
    columns = [f"legs/{place}_to_{subgoal}" for place in places for subgoal in range(len(names))]
    if missing := [name for name in columns if name not in run.metrics]:
        raise ValueError(f"run must have logged its legs, but {run.folder} has no {missing[0]}.")
    rates, frames = np.stack([run.metrics[name] for name in columns], 1), run.metrics["frames"]
    parts = [part for part in np.array_split(np.arange(len(frames)), windows) if len(part)]
    across = -(-len(parts) // 2)
    figure = Figure(figsize=(1.2 + 3.1 * across, 5.6), layout="constrained")
    axes = figure.subplots(2, across, sharex=True, sharey=True, squeeze=False)
    for axis, part in zip(axes.flat, parts, strict=False):
        share = np.ma.masked_invalid(rates[part]).mean(0).filled(np.nan).reshape(len(places), len(names))
        image = _draw_legs(axis, share, [""] * share.size, names)
        axis.set_title(f"{frames[part[0]] / 1e6:.2f}M to {frames[part[-1]] / 1e6:.2f}M frames", fontsize=9)
    for axis in axes.flat[len(parts) :]:
        axis.set_axis_off()
    figure.supxlabel("to", fontsize=9)
    figure.supylabel("from", fontsize=9)
    figure.colorbar(image, ax=axes, label="reached, mean over log points")
    save_figure(figure, path, dpi=150)


def _draw_legs(axis: Axes, rates: NDArray[np.floating[Any]], notes: Sequence[str], names: Sequence[str]) -> AxesImage:
    """A matrix ``[G + 1, G]`` of shares, NaN where there were no options; ``notes`` stand below the numbers."""
    image = axis.imshow(rates, vmin=0.0, vmax=1.0, cmap="viridis", aspect="auto")
    names = [name.replace("_", " ") for name in names]
    axis.set_xticks(range(len(names)), names, rotation=35, ha="right", rotation_mode="anchor", fontsize=8)
    axis.set_yticks(range(len(names) + 1), [*names, "start"], fontsize=8)
    for ((row, column), rate), note in zip(np.ndenumerate(rates), notes, strict=True):
        if np.isfinite(rate):
            ink = "black" if rate > 0.6 else "white"
            axis.text(column, row, f"{rate:.0%}{note}", ha="center", va="center", fontsize=7, color=ink)
    return image


def plot_places(counts: NDArray[np.integer[Any]], screen: NDArray[np.uint8], path: Path) -> None:
    """Where the agent was, over the screen.

    Args:
        counts: of a :class:`~hdrqn_torchrl.runs.evaluation.PlaceCounter`.
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
    save_figure(figure, path, dpi=150)
