"""The programs as their user types them: ``hdrqn train`` or, in a checkout, ``python train.py``."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import hdrqn_torchrl

PROGRAMS = ("train", "evaluate", "watch", "export", "plot", "report", "check", "zoo")
_SCRIPT = re.compile(rf"python ({'|'.join(PROGRAMS)})\.py")
_TOP = Path(hdrqn_torchrl.__file__).parent.parent


def command_of(program: str) -> str:
    """The command that starts a program, in the form in which the running one was started.

    Args:
        program: one of :data:`PROGRAMS`.

    Returns:
        ``hdrqn train``, ``python train.py``, ``python ../train.py``, ...
    """
    called = Path(sys.argv[0])
    if called.suffix == ".py" and called.stem in PROGRAMS:
        return f"python {shlex.quote(str(called.with_name(f'{program}.py')))}"
    of_hdrqn = called.name.startswith("hdrqn")
    return f"hdrqn {program}" if of_hdrqn or not (_TOP / "train.py").exists() else f"python {program}.py"


def as_called(text: str) -> str:
    """A text with every ``python PROGRAM.py`` in it replaced by :func:`command_of`."""
    return _SCRIPT.sub(lambda found: command_of(found[1]), text)
