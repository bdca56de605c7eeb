"""The seeds of several trainings in one process, as a setting."""

from __future__ import annotations

import re
from typing import Any

from hdrqn_torchrl.runs.settings.arguments import TARGET, SettingsError, shown

LARGEST_SEED = 10**18
_MOST = 10_000
_ONE_AT_A_TIME = ("make_wandb_logger", "make_mlflow_logger")
"""Their services keep one run for a process."""


def read_seeds(seeds: Any) -> list[int]:
    """The seeds that a setting names.

    Args:
        seeds: ``"A..B"``, both included, or a list.

    Raises:
        SettingsError: if it names none, one twice, or too many.

    Examples:
        >>> read_seeds("8..11"), read_seeds([3, 1])
        ([8, 9, 10, 11], [3, 1])
    """
    found = seeds
    if isinstance(seeds, str) and (ends := re.fullmatch(r"(\d{1,18})\.\.(\d{1,18})", seeds)):
        first, last = map(int, ends.groups())
        found = range(first, min(last, first + _MOST) + 1)
    is_list = isinstance(found, list | range) and all(type(each) is int and each >= 0 for each in found)
    if not is_list or not 0 < len(set(found)) == len(found) <= _MOST:
        raise SettingsError(
            f"seeds must be A..B with A <= B, or a list of different numbers, got {shown(seeds)}; use 0..9."
        )
    return list(found)


def check_together(seeds: Any, logger: dict[str, Any], resume: str | None) -> None:
    """Refuses what several trainings in one process can't have.

    Args:
        seeds: the setting.
        logger, resume: those of the same run.

    Raises:
        SettingsError: naming setting, rule and value.
    """
    read_seeds(seeds)
    if resume not in (None, "auto"):
        raise SettingsError(
            f"resume must be auto or null with seeds, got {shown(resume)}; auto goes on with each training that was "
            "begun, resume=FOLDER without seeds goes on with one."
        )
    loggers = logger.get("loggers")
    for each in loggers if isinstance(loggers, list) else []:
        target = str(each.get(TARGET)) if isinstance(each, dict) else ""
        if target.endswith(_ONE_AT_A_TIME):
            raise SettingsError(
                f"logger must be csv or tensorboard with seeds, got {target}, which follows one training of a process; "
                "use -m seed=0,1,2 sweep=parallel."
            )
