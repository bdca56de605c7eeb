"""Checks whether an environment fulfils the contract for tasks, and says what each fault or gap costs."""

from hdrqn_torchrl.cli.check import main

if __name__ == "__main__":
    main()
