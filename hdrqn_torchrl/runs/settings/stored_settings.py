"""``config.yaml`` of a run folder as plain data: dicts, lists, strings, numbers. Nothing is looked up or executed.

A small file can stand for endless work: aliases that multiply, nesting that no stack holds, numbers
of a million digits. All of that is refused before the data is made.
"""

from __future__ import annotations

import math
import re
from collections.abc import Hashable
from copy import deepcopy
from pathlib import Path
from typing import Any

import yaml

from hdrqn_torchrl.runs.persistence.files import RunFileError, read_text

INTERPOLATION = "${"
LARGEST_DEPTH, LONGEST_TEXT = 30, 10_000
_MISSING = object()
_EARLIER: dict[str, tuple[str, Any]] = {
    "${total_frames}": ("total_frames", _MISSING),
    "${precision}": ("precision", _MISSING),
    "${capture}": ("capture", _MISSING),
    "${batch_scale}": ("batch_scale", _MISSING),
    "${seed}": ("seed", _MISSING),
    "${steps_per_batch}": ("steps_per_batch", _MISSING),
    "${env.practice_steps}": ("env.practice_steps", _MISSING),
    "${algo.sub.learning_rate}": ("algo.sub.learning_rate", _MISSING),
    "${algo.sub.tau}": ("algo.sub.tau", _MISSING),
    "${oc.select:env.num_goals,null}": ("env.num_goals", None),
    "${oc.select:env.max_steps,50}": ("env.max_steps", 50),
}
"""What conf/ has left in ``config.yaml``: exact strings, the setting meant, and its value if that is not there."""
_MOVED = {
    "hdrqn_torchrl.learner.LearnerSettings": "hdrqn_torchrl.learning.LearnerSettings",
    "hdrqn_torchrl.phases.PhaseOne": "hdrqn_torchrl.learning.PhaseOne",
    **{
        f"hdrqn_torchrl.logging.make_{name}_logger": f"hdrqn_torchrl.runs.logging.make_{name}_logger"
        for name in ("tensorboard", "wandb", "mlflow")
    },
}
"""What builders are called that earlier versions named otherwise."""
_COPIES = ("env", "algo", "network")  # the same for loggers, which were given whole sections to show
_DATABASE = "sqlite:///${output_root}/mlflow.db"


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # in C: seven times as fast
    """Reads numbers as OmegaConf writes them, and no dates."""

    yaml_implicit_resolvers = {
        first: [(tag, rule) for tag, rule in rules if not tag.endswith((":timestamp", ":float"))]
        for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Refuses keys that are not names, and duplicates."""
        keys = [key.value if key.tag.endswith(":str") else None for key, _ in node.value]
        if None in keys or len(set(keys)) < len(keys):
            raise yaml.YAMLError(f"every key must be a name and occur only once, {node.start_mark}")
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(?:[0-9][0-9_]*\.[0-9_]*(?:[eE][-+]?[0-9]+)?|[0-9][0-9_]*[eE][-+]?[0-9]+"
               r"|\.[0-9_]+(?:[eE][-+][0-9]+)?|\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"),
    list("-+0123456789."),
)  # fmt: skip


def read_settings(path: Path, *, keep_unknown: bool = False) -> dict[str, Any]:
    """Reads ``config.yaml`` of a run folder.

    Args:
        path: the file.
        keep_unknown: leave strings that refer to something else unchanged, to be shown; without it they are refused,
            apart from those that earlier versions wrote, which are replaced by what they meant in any case.

    Raises:
        RunFileError: naming the file and what is wrong with it.
        OSError: if it is not there or can't be read.
    """
    try:
        found = _parse(read_text(path))
        if not isinstance(found, dict):
            raise ValueError(f"it must hold settings by name, got {type(found).__name__}")
        return _without_references(found, keep_unknown)
    except RunFileError:
        raise
    except (ValueError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RunFileError(f"{path} can't be read as the settings of a run: {reason}.") from error


def _parse(text: str) -> Any:
    depth = 0
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise ValueError("it must not contain anchors and aliases (& and *)")
        if getattr(event, "tag", None) is not None and event.tag != "!":
            raise ValueError(f"it must not contain tags (!...), got {event.tag[:80]}")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > LARGEST_DEPTH:
            raise ValueError(f"settings must not be nested more than {LARGEST_DEPTH} deep")
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > LONGEST_TEXT:
            raise ValueError(f"a value must not be longer than {LONGEST_TEXT:,} characters, got {len(event.value):,}")
    return yaml.load(text, _Loader)


def _without_references(found: dict[str, Any], keep_unknown: bool) -> dict[str, Any]:
    """The settings with what earlier versions of conf/ left open filled in from the same file."""

    def fill(value: Any, path: str) -> Any:
        if isinstance(value, dict):
            return {key: fill(item, f"{path}.{key}") for key, item in value.items()}
        if path.endswith("._target_") and value in _MOVED:
            return _MOVED[value]
        if isinstance(value, list):
            return [fill(item, f"{path}[{index}]") for index, item in enumerate(value)]
        if not isinstance(value, str) or INTERPOLATION not in value:
            return value
        meant = _meant(value, found) if value in _EARLIER else _shown(value, path, found, plain)
        if meant is _MISSING or (isinstance(meant, str) and INTERPOLATION in meant):
            if keep_unknown:
                return value
            raise ValueError(
                f"{path} must be a value, got {value[:200]!r}, which refers to others; write the value itself"
            )
        return meant

    plain: dict[str, Any] = {}
    for key in sorted(found, key=lambda key: key == "logger"):  # last: it may show the others
        plain[key] = fill(found[key], key)
    return {key: plain[key] for key in found}


def _meant(reference: str, found: dict[str, Any]) -> Any:
    path, value = _EARLIER[reference]
    node: Any = found
    for part in path.split("."):
        if not isinstance(node, dict) or part not in node:
            return value
        node = node[part]
    return _MISSING if isinstance(node, (dict, list)) else node


def _shown(reference: str, path: str, found: dict[str, Any], plain: dict[str, Any]) -> Any:
    """What a logger was to show, or where it writes."""
    if not path.startswith("logger."):
        return _MISSING
    root = found.get("output_root")
    if reference == _DATABASE and isinstance(root, str):
        return f"sqlite:///{root}/mlflow.db"
    copies = {f"${{{name}}}": plain[name] for name in _COPIES if name in plain}
    return deepcopy(copies.get(reference, _MISSING)) if reference in copies else _MISSING


def check_plain(settings: Any, path: str = "") -> None:
    """Refuses NaN, and values that refer to other settings: those would become something else when used.

    Raises:
        ValueError: naming the setting.
    """
    if isinstance(settings, dict):
        for key, item in settings.items():
            check_plain(item, f"{path}.{key}" if path else str(key))
    elif isinstance(settings, list):
        for index, item in enumerate(settings):
            check_plain(item, f"{path}[{index}]")
    elif isinstance(settings, str) and INTERPOLATION in settings:
        raise ValueError(
            f"{path} must be a value, got {settings[:200]!r}, which refers to others; write the value itself."
        )
    elif isinstance(settings, float) and math.isnan(settings):
        raise ValueError(f"{path} must be a number, got nan; leave it out for the default.")
