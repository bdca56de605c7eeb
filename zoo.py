"""Agents that come trained: shows them, copies one, plays one, adds one."""

from hdrqn_torchrl.cli.zoo import main

if __name__ == "__main__":
    main()
