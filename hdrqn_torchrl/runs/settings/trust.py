"""What settings may build: a ``_target_`` must stand on a list, in a place where such a thing belongs.

And every size must be one that a machine can hold: settings may come from somebody else's run folder.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

from hdrqn_torchrl.runs.settings.arguments import TARGET, Settings, SettingsError
from hdrqn_torchrl.runs.settings.stored_settings import check_plain

BUILDERS = {
    "env": (
        "hdrqn_torchrl.envs.MultiGoalGridEnv",
        "hdrqn_torchrl.envs.make_gym",
        "hdrqn_torchrl.envs.make_minigrid",
        "hdrqn_torchrl.envs.make_montezuma",
    ),
    "algo": (
        "hdrqn_torchrl.algorithms.make_dqn",
        "hdrqn_torchrl.algorithms.make_drqn",
        "hdrqn_torchrl.algorithms.make_hdqn",
        "hdrqn_torchrl.algorithms.make_hdrqn",
        "hdrqn_torchrl.algorithms.make_v3",
    ),
    "algo.*": (
        "hdrqn_torchrl.discovery.DiscoverySettings",
        "hdrqn_torchrl.learning.LearnerSettings",
        "hdrqn_torchrl.modules.EpsilonGreedy",
        "hdrqn_torchrl.modules.RepeatingEpsilonGreedy",
        "hdrqn_torchrl.modules.SuccessEpsilonGreedy",
        "hdrqn_torchrl.learning.PhaseOne",
    ),
    "network": (
        "hdrqn_torchrl.modules.compact_network",
        "hdrqn_torchrl.modules.paper_network",
    ),
    "logger.loggers[*]": (
        "hdrqn_torchrl.runs.logging.make_tensorboard_logger",
        "hdrqn_torchrl.runs.logging.make_wandb_logger",
        "hdrqn_torchrl.runs.logging.make_mlflow_logger",
    ),
}
"""What a ``_target_`` may name, by its place; a user's own are added with ``allowed_targets=[package.builder]``."""

ALLOWED_TARGETS = tuple(target for targets in BUILDERS.values() for target in targets)
KNOWN_PACKAGES = ("ale_py", "minigrid", "popgym", "vizdoom.gymnasium_wrapper", "hdrqn_torchrl.envs.gym")
"""Packages of environments that may be imported: those that ``make_gym`` knows, named again as it loads torch."""
_MAKES_GYM = ("hdrqn_torchrl.envs.make_gym", "hdrqn_torchrl.envs.make_minigrid")
_LOGGER = re.compile(r"logger\.loggers\[\d+\]")
_MARKS = {"_recursive_": (False,), "_convert_": ("all",)}  # of Hydra, as the files of conf/ use them: for loggers

LARGEST = {
    "num_envs": 100_000,
    "num_goals": 50,
    "num_obstacles": 1_000,
    "view": 501,
    "size": 512,
    "max_steps": 1_000_000,
    "max_option_steps": 1_000_000,
    "noops": 1_000_000,
    "frame_skip": 1_000,
    "threads": 1_024,
    "hidden_size": 2_048,
    "memory_size": 2_048,
    "head_size": 2_048,
    "widths": 2_048,
    "prediction_steps": 64,
    "refresh_hidden_steps": 10_000,
    "slice_len": 100_000,
    "batch_size": 100_000,
    "capacity": 20_000_000,
    "window": 100_000,
    "max_subgoals": 256,
}
"""Sizes that something is made of; larger ones are mistakes, or meant to fill the memory of whoever opens a run."""
_LARGEST_NUMBER, _LONGEST_LIST = 10**18, 64  # of whole numbers of any other kind, and of lists of sizes


def check_targets(settings: Any, allowed: Sequence[str], place: str = "") -> None:
    """Refuses every ``_target_`` that is not on the list for its place, and all that is not plain data.

    Args:
        settings: plain data that will be built.
        allowed: names allowed besides :data:`BUILDERS`, in any place; never read from the run folder itself.
        place: full name of ``settings``.
    """
    try:
        check_plain(settings, place)
    except ValueError as error:
        raise SettingsError(str(error)) from error
    for path, node in _nodes(settings, place):
        target = node.get(TARGET)
        unknown = [name for name in imports_of(node) if name not in allowed]
        needed = ",".join([*allowed, str(target)])
        if TARGET in node and target not in (*_builders_at(path), *allowed):
            raise SettingsError(
                f"{path}._target_ must be one of the builders that this program trusts there, got {target!r}. If you "
                f"wrote this setting and trust it, add 'allowed_targets=[{needed}]' to the command."
            )
        if unknown:
            raise SettingsError(
                f"{path} must import nothing that this program does not trust, got {', '.join(map(repr, unknown))}. If "
                "you wrote these settings and trust them, add "
                f"'allowed_targets=[{','.join([*allowed, *unknown])}]' to the command."
            )
        for key in node:
            may = (target in allowed or _LOGGER.fullmatch(path)) and node[key] in _MARKS.get(key, ())
            if key.startswith("_") and key != TARGET and not may:
                raise SettingsError(f"{path}.{key} must be left out, got {node[key]!r}; name settings one by one.")


def imports_of(settings: Settings) -> list[str]:
    """Names of a user's own that an environment of Gymnasium imports: subgoals, rules, wrappers, packages.

    Args:
        settings: of one environment, with their ``_target_``.

    Examples:
        >>> gym = {"_target_": "hdrqn_torchrl.envs.make_gym", "id": "mine:Maze-v0", "subgoals": "mine.Doors"}
        >>> imports_of(gym)
        ['mine.Doors', 'mine']
    """
    if settings.get(TARGET) not in _MAKES_GYM:
        return []
    found: list[str] = []
    for key in ("subgoals", "wrappers", "reward", "success", "hazard"):
        value = settings.get(key)
        found += [
            each for each in (value if isinstance(value, list) else [value]) if isinstance(each, str) and "." in each
        ]
    package, module = settings.get("package"), str(settings.get("id", "")).rpartition(":")[0]
    return found + [each for each in (package, module) if each and each not in KNOWN_PACKAGES]


def _nodes(settings: Any, path: str) -> Iterator[tuple[str, Settings]]:
    """Every dict in settings, with its full name; what loggers only show is left out."""
    if isinstance(settings, dict):
        yield path, settings
        shows = _LOGGER.fullmatch(path) and settings.get("_recursive_") is False
        for key, item in settings.items():
            if not (shows and key == "settings"):
                yield from _nodes(item, f"{path}.{key}" if path else str(key))
    elif isinstance(settings, list):
        for index, item in enumerate(settings):
            yield from _nodes(item, f"{path}[{index}]")


def _builders_at(path: str) -> tuple[str, ...]:
    parent, _, last = path.rpartition(".")
    general = {f"{parent}.*", f"{parent}.{last.partition('[')[0]}[*]" if last.endswith("]") else path}
    return tuple(target for place in general for target in BUILDERS.get(place, ()))


def check_sizes(settings: Settings, place: str) -> None:
    """Refuses unreasonably large sizes (:data:`LARGEST`).

    Raises:
        SettingsError: naming setting, rule and value.
    """
    for path, node in _nodes(settings, place):
        for key, value in node.items():
            values = value if isinstance(value, list) else [value]
            largest = LARGEST.get(key, _LARGEST_NUMBER)
            for each in values:
                if isinstance(each, int) and abs(each) > largest:
                    raise SettingsError(f"{path}.{key} must be <= {largest:,}, got {str(each)[:25]}; use less.")
            if key in LARGEST and len(values) > _LONGEST_LIST:
                raise SettingsError(f"{path}.{key} must have at most {_LONGEST_LIST} values, got {len(values)}.")
