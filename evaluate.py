"""Evaluates a trained agent and prints one JSON object."""

from hdrqn_torchrl.cli.evaluate import main

if __name__ == "__main__":
    main()
