"""Records episodes of a trained agent: the world, what the agent sees, wants and does, and both levels' Q-values."""

from hdrqn_torchrl.cli.watch import main

if __name__ == "__main__":
    main()
