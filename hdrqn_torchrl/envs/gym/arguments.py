"""What a user hands to ``make_gym``, checked and looked up: actions, subgoals, rules, wrappers, packages."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping, Sequence, Sized
from enum import IntEnum
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from hdrqn_torchrl.envs.gym.given import check_rule
from hdrqn_torchrl.envs.gym.subgoals import Subgoals
from hdrqn_torchrl.envs.gym.worlds import Rule
from hdrqn_torchrl.envs.subgoals import check_names
from hdrqn_torchrl.envs.task import Task

PACKAGES = {
    "ALE/": "ale_py",
    "MiniGrid-": "minigrid",
    "BabyAI-": "minigrid",
    "popgym-": "popgym",
    "Vizdoom": "vizdoom.gymnasium_wrapper",
    "hdrqn/": "hdrqn_torchrl.envs.gym",
}
"""Packages that register environments, by how the ids begin. They are imported for these ids."""

_EXTRAS = {"ale_py": "atari", "minigrid": "minigrid"}
_ON_THE_PATH = "name the folder that holds it: export PYTHONPATH=$PWD"

SomeSubgoals = Subgoals | str | Sequence[Subgoals | str] | None


def actions_of(space: spaces.Space, chosen: Sequence[int] | None) -> tuple[int, ...]:
    """The environment's numbers of the agent's actions."""
    if not isinstance(space, spaces.Discrete):
        raise ValueError(
            f"id must be an environment with one discrete action, got {space}; number the combinations of its parts, "
            "or choose some, with a wrapper (gymnasium.wrappers.TransformAction)."
        )
    all_of_them = range(int(space.start), int(space.start + space.n))
    if chosen is None:
        return tuple(all_of_them)
    if not chosen or len(set(chosen)) < len(chosen) or not set(chosen) <= set(all_of_them):
        raise ValueError(f"actions must be different numbers in {list(all_of_them)}, got {list(chosen)}.")
    return tuple(chosen)


def stated_by(env: gymnasium.Env) -> Task:
    """The attribute ``task`` of an environment, if it is a :class:`Task`; else one that states nothing."""
    stated = getattr(env.unwrapped, "task", None)
    return stated if isinstance(stated, Task) else Task()


def action_names_of(env: gymnasium.Env, actions: Sequence[int]) -> tuple[str, ...]:
    """As its :class:`Task`, ALE's environments and MiniGrid's tell them; empty if the environment does not."""
    space = env.action_space
    if (stated := stated_by(env).actions) and isinstance(space, spaces.Discrete):
        if len(stated) != space.n:
            raise ValueError(f"task.actions must name the {space.n} actions of the environment, got {list(stated)}.")
        return tuple(stated[action - int(space.start)] for action in actions)
    meanings = getattr(env.unwrapped, "get_action_meanings", None)
    if callable(meanings):
        return tuple(str(meanings()[action]).lower() for action in actions)
    named = getattr(env.unwrapped, "actions", None)
    if isinstance(named, type) and issubclass(named, IntEnum):
        return tuple(named(action).name for action in actions)
    return ()


def subgoals_of(given: SomeSubgoals) -> tuple[Subgoals, ...]:
    """All sets, from near to far; names are looked up, classes are made."""
    sets = [] if given is None else list(given) if isinstance(given, list | tuple) else [given]
    found = [_named("subgoals", each) for each in sets]
    made = tuple(each() if isinstance(each, type) else each for each in found)
    for each in made:
        if not isinstance(each, Subgoals) or not each.names:
            raise ValueError(
                f"subgoals must derive from hdrqn_torchrl.envs.Subgoals and have names, got {each!r}; its methods are "
                "those of that class."
            )
        _check_set(each)
    prefixes = [each.prefix for each in made]
    if made and (len(set(prefixes)) < len(made) or prefixes[-1]):
        raise ValueError(f"subgoals must have different prefixes, and the last, farthest set none, got {prefixes}.")
    return made


def _check_set(subgoals: Subgoals) -> None:
    """Refuses names, and answers about repetition, that are not one for each subgoal."""
    names = check_names("subgoals.names", subgoals.names)
    answers = np.asarray(subgoals.repeatable)
    if answers.dtype != np.bool_ or answers.shape not in ((), (len(names),)):
        raise ValueError(
            f"subgoals.repeatable must be True or False, or a list of them for the names {list(names)}, got "
            f"{subgoals.repeatable!r}."
        )


def rule_of(name: str, rule: str | Rule | None) -> str | Rule | None:
    """A function, or the name of an entry of ``info``; names with dots are those of functions."""
    found = _named(name, rule) if isinstance(rule, str) and "." in rule else rule
    check_rule(name, found)
    return found


def wrappers_of(given: Sequence[Callable[[gymnasium.Env], gymnasium.Env] | str]) -> list[Callable]:
    """Wrappers, with names looked up."""
    found = [_named("wrappers", each) for each in given]
    for each in found:
        if not callable(each):
            raise ValueError(
                f"wrappers must be functions or classes that take a world, got {each!r}; name one as 'module.Wrapper'."
            )
    return found


def refuse_ignored(what: str, arguments: Mapping[str, Any], *, remedy: str) -> None:
    """Refuses arguments that would change nothing.

    Args:
        what: which they don't go with.
        arguments: they, by name; ``None``, ``False`` and what is empty count as left out.
        remedy: what to do instead.

    Raises:
        ValueError: naming the first.

    Examples:
        >>> refuse_ignored("a vector", {"package": None, "wrappers": [], "max_steps": 3}, remedy="make it so")
        Traceback (most recent call last):
        ValueError: max_steps must be left out with a vector, got 3; make it so.
    """
    for name, value in arguments.items():
        is_empty = isinstance(value, Sized) and not len(value)
        if value is not None and value is not False and not is_empty:
            raise ValueError(f"{name} must be left out with {what}, got {value!r}; {remedy}.")


def _named(argument: str, value: Any) -> Any:
    """What a string names; anything else as it is."""
    if not isinstance(value, str):
        return value
    try:
        return pkgutil.resolve_name(value)
    except (ImportError, AttributeError, ValueError) as error:
        remedy = f"; {_ON_THE_PATH}" if isinstance(error, ModuleNotFoundError) else ""
        raise ValueError(
            f"{argument} must name something that can be imported, got {value!r} ({error}){remedy}."
        ) from error


def import_package_of(id: str, package: str | None = None) -> None:
    """Imports the package that registers an id.

    Args:
        id: of an environment.
        package: its package; ``None``: as :data:`PACKAGES` says, which is none for environments of Gymnasium itself.

    Raises:
        ImportError: if it is missing.
    """
    module = id.partition(":")[0]  # of "module:Name-v0", which Gymnasium imports, too
    known = [module] if module != id else [each for start, each in PACKAGES.items() if id.startswith(start)]
    for name in [package] if package else known:
        try:
            gymnasium.register_envs(importlib.import_module(name))
        except ImportError as error:
            extra = _EXTRAS.get(name)
            remedy = f": pip install 'hdrqn_torchrl[{extra}]'" if extra else f", or {_ON_THE_PATH}"
            raise ImportError(f"{id} needs {name}, which can't be imported ({error}); install it{remedy}.") from error
        if name == "minigrid":
            _silence_babyai()


def _silence_babyai() -> None:
    """BabyAI prints a line for every world that it draws in vain, and knows no switch for it."""
    level: Any = importlib.import_module("minigrid.envs.babyai.core.roomgrid_level")
    level.print = lambda *_: None


_KNOWN = "an environment that Gymnasium knows"


def make_world(id: str, settings: Mapping[str, Any], *, what: str = _KNOWN) -> gymnasium.Env:
    """One world of a registered environment.

    Args:
        id: of the environment.
        settings: keyword arguments for ``gymnasium.make``.
        what: what the id has to be that of.

    Raises:
        ValueError: if there is no such environment, or it does not take the settings.
    """
    try:
        return gymnasium.make(id, **settings)
    except gymnasium.error.Error as error:
        remedy = "; package=my_package (env.package) names the one that registers it" if what is _KNOWN else ""
        raise ValueError(f"id must be that of {what}, got {id!r} ({error}){remedy}.") from error
    except TypeError as error:
        raise settings_error(id, settings, error) from error


def settings_error(id: str, settings: Mapping[str, Any], error: TypeError) -> ValueError:
    """What to say of settings that an environment does not take."""
    return ValueError(f"settings must be arguments that {id} takes, got {sorted(settings)} ({error}).")
