"""Figures that compare groups of runs: curves and final results with intervals, against the ceilings of their tasks."""

from hdrqn_torchrl.analysis.comparison.bars import plot_bars
from hdrqn_torchrl.analysis.comparison.curves import plot_curves
from hdrqn_torchrl.analysis.comparison.panels import DISCOVERY, FINALS, GREEDY, PAPER, Panel

__all__ = ["DISCOVERY", "FINALS", "GREEDY", "PAPER", "Panel", "plot_bars", "plot_curves"]
