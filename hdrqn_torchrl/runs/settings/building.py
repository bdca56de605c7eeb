"""From plain settings to built objects: :func:`build` checks and builds, in one step, the same data.

What may be built is decided in trust.py, what type each setting must have in arguments.py. No Hydra is needed.
"""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from typing import TYPE_CHECKING, Any

from hdrqn_torchrl.runs.settings.arguments import TARGET, Settings, SettingsError, check_arguments, remedy
from hdrqn_torchrl.runs.settings.run_settings import RunSettings
from hdrqn_torchrl.runs.settings.trust import check_sizes, check_targets

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from hdrqn_torchrl.algorithms import Algorithm


def build(settings: Any, *args: Any, place: str, allowed: Sequence[str] = ()) -> Any:
    """Checks settings and builds from them.

    Args:
        settings: plain data with a ``_target_``.
        args: objects that the builder takes before its settings.
        place: where the settings stand: ``"env"``, ``"algo"``, ``"network"``, ``"logger.loggers[0]"``.
        allowed: builders allowed besides those of trust.py; never read from the run folder itself.

    Raises:
        SettingsError: if something may not be built, a value is of the wrong kind, or the builder refuses it; with the
            full name of the setting in front.

    Examples:
        >>> network = {"_target_": "hdrqn_torchrl.modules.compact_network", "hidden_size": 8}
        >>> build(network, place="network").hidden_size
        8
    """
    check_all(settings, place, allowed)
    return _construct(settings, args, place)


def _construct(node: Settings, args: tuple[Any, ...], path: str) -> Any:
    """Calls a builder with its settings; those below it first."""
    deep = node.get("_recursive_", True)
    keywords = {
        name: _built(value, f"{path}.{name}") if deep else deepcopy(value)
        for name, value in node.items()
        if not name.startswith("_")
    }
    builder = locate(node[TARGET])
    try:
        return builder(*args, **keywords)
    except (ImportError, OSError) as error:  # of the machine, not of a setting
        raise SettingsError(str(error)) from error
    except ValueError as error:
        raise SettingsError(f"{path}.{error}") from error
    except Exception as error:
        raise SettingsError(f"{path}: {error}; {remedy()}.") from error


def _built(value: Any, path: str) -> Any:
    """A setting's value, with everything built that has a target in it."""
    if isinstance(value, dict):
        if TARGET in value:
            return _construct(value, (), path)
        return {key: _built(item, f"{path}.{key}") for key, item in value.items()}
    if isinstance(value, list):
        return [_built(item, f"{path}[{index}]") for index, item in enumerate(value)]
    return value


def locate(target: str) -> Callable[..., Any]:
    """The builder that a ``_target_`` names.

    Raises:
        SettingsError: if there is none.
    """
    try:
        found = pkgutil.resolve_name(target)
    except (ImportError, AttributeError, ValueError) as error:
        raise SettingsError(
            f"_target_ must name a function or class, got {target!r} ({error}); install its package, or name the "
            "folder that holds it: PYTHONPATH=FOLDER before the command."
        ) from error
    if not callable(found):
        raise SettingsError(f"_target_ must name a function or class, got {target!r}, which is neither.")
    return found


def default_of(settings: Settings, name: str, otherwise: Any = None) -> Any:
    """What a setting is where it is left out: its builder's default.

    Args:
        settings: all of a run, with builders that may be loaded.
        name: full name of the setting.
        otherwise: returned if no builder takes it, or it has no default.

    Examples:
        >>> default_of({"algo": {"_target_": "hdrqn_torchrl.algorithms.make_hdrqn"}}, "algo.levels")
        2
    """
    *path, last = name.split(".")
    node: Any = settings
    for part in path:
        node = node.get(part) if isinstance(node, dict) else None
    if not isinstance(node, dict) or TARGET not in node:
        return otherwise
    found = inspect.signature(locate(node[TARGET])).parameters.get(last)
    return otherwise if found is None or found.default is inspect.Parameter.empty else found.default


def build_env(settings: RunSettings, changes: Mapping[str, Any], allowed: Sequence[str] = ()) -> EnvBase:
    """The bare environment of a run's settings, with some of them changed."""
    return build(settings.env | dict(changes), place="env", allowed=allowed)


def build_evaluation_env(settings: RunSettings, changes: Mapping[str, Any], allowed: Sequence[str] = ()) -> EnvBase:
    """The bare environment of a run's evaluations; ``evaluation.env`` wins over other changes.

    Args:
        settings: all of them.
        changes: settings of the environment that are to differ from the run's.
        allowed: see :func:`build`.

    Raises:
        SettingsError: as :func:`build`; what ``evaluation.env`` says is named so.
    """
    with _changes_named(settings):
        return build_env(settings, {**changes, **settings.evaluation.env}, allowed)


@contextmanager
def _changes_named(settings: RunSettings) -> Iterator[None]:
    """Inside, errors about what ``evaluation.env`` changes name it."""
    try:
        yield
    except SettingsError as error:
        place, _, name = str(error).partition(" ")[0].partition(".")
        if place == "env" and name in settings.evaluation.env:
            raise SettingsError(f"evaluation.{error}") from error
        raise


def build_algorithm(
    settings: RunSettings, changes: Mapping[str, Any] | None = None, allowed: Sequence[str] = ()
) -> tuple[EnvBase, Algorithm]:
    """The bare environment and the algorithm of a run's settings.

    Args:
        settings: all of them.
        changes: settings of the environment that are to differ.
        allowed: see :func:`build`.
    """
    for place, part in _parts(settings):  # all of them, before the first is built
        check_all(part, place, allowed)
    with _changes_named(settings):
        check_all({**settings.env, **settings.evaluation.env}, "env", allowed)
    env = build_env(settings, changes or {}, allowed)
    network = build(settings.network, place="network", allowed=allowed)
    return env, build(settings.algo, env, network, place="algo", allowed=allowed)


def _parts(settings: RunSettings) -> Iterator[tuple[str, Settings]]:
    """All settings that something is built from, by their places."""
    yield from (("env", settings.env), ("algo", settings.algo), ("network", settings.network))
    yield from ((f"logger.loggers[{index}]", each) for index, each in enumerate(settings.logger["loggers"]))


def check_all(settings: Settings, place: str, allowed: Sequence[str]) -> None:
    """Names, types and sizes, in this order: types are those of what is named, which is loaded for it.

    Raises:
        SettingsError: naming the setting.
    """
    if not isinstance(settings, dict) or TARGET not in settings:
        raise SettingsError(f"{place} must be settings with a _target_, got {settings!r}.")
    check_targets(settings, allowed, place)
    check_arguments(settings, place, locate)
    check_sizes(settings, place)
