"""Trains one agent: ``python train.py env=gridworld algo=v2``. Any setting of conf/ can be overridden; -m sweeps."""

from hdrqn_torchrl.cli.train import main

if __name__ == "__main__":
    main()
