"""The command ``hdrqn``: one word for each program, then what the program itself takes."""

from __future__ import annotations

import sys
from importlib import import_module

from hdrqn_torchrl import __version__
from hdrqn_torchrl.runs.settings.commands import PROGRAMS

USAGE = f"usage: hdrqn {'|'.join(PROGRAMS)} [key=value ...]; `hdrqn PROGRAM --help` explains each"


def main() -> None:
    """Runs the program that the first argument names with the others."""
    program = sys.argv[1] if len(sys.argv) > 1 else ""
    if program in PROGRAMS:
        sys.argv = [f"hdrqn {program}", *sys.argv[2:]]
        import_module(f"hdrqn_torchrl.cli.{program}").main()
    elif program in ("-V", "--version"):
        print(__version__)
    elif program in ("-h", "--help"):
        print(USAGE)
    else:
        sys.exit(USAGE if not program else f"error: the program must be one of {', '.join(PROGRAMS)}, got {program!r}.")


if __name__ == "__main__":
    main()
