"""Draws learning curves or final results of many runs, with confidence intervals, against their tasks' ceilings."""

from hdrqn_torchrl.cli.plot import main

if __name__ == "__main__":
    main()
