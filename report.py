"""Writes the results of the paper's studies: figures, tables and what agrees with its claims, from run folders."""

from hdrqn_torchrl.cli.report import main

if __name__ == "__main__":
    main()
