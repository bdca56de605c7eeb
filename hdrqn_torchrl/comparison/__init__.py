"""Figures that compare groups of runs: curves and final results with intervals, against the ceilings of their tasks."""

from hdrqn_torchrl.comparison.bars import plot_bars
from hdrqn_torchrl.comparison.curves import plot_curves
from hdrqn_torchrl.comparison.panels import FINALS, GREEDY, PAPER, Panel

__all__ = ["FINALS", "GREEDY", "PAPER", "Panel", "plot_bars", "plot_curves"]
