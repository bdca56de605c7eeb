"""The command ``hdrqn``: one word for each program."""

from __future__ import annotations

import sys
from importlib import import_module

PROGRAMS = ("train", "evaluate", "watch", "plot", "report")
USAGE = f"usage: hdrqn {'|'.join(PROGRAMS)} [key=value ...]; `hdrqn PROGRAM --help` explains each."


def main() -> None:
    """Runs the program that the first argument names with the others."""
    program = sys.argv[1] if len(sys.argv) > 1 else ""
    if program in ("--version", "-V"):
        from hdrqn_torchrl import __version__

        print(__version__)
        return
    if program not in PROGRAMS:
        helped = program in ("-h", "--help")
        print(USAGE, file=sys.stdout if helped else sys.stderr)
        sys.exit(0 if helped else 2)
    sys.argv = [f"hdrqn {program}", *sys.argv[2:]]
    import_module(f"hdrqn_torchrl.cli.{program}").main()


if __name__ == "__main__":
    main()
