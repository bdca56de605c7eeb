"""What a user hands to ``make_gym``, checked for its kind before anything is made of it."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import Any

import gymnasium
from gymnasium.vector import VectorEnv


def check_whole_number(name: str, value: Any, *, least: int = 1, remedy: str) -> None:
    """Refuses anything but a whole number.

    Raises:
        ValueError: if it is another kind of value, or smaller than ``least``.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise ValueError(f"{name} must be a whole number >= {least}, got {value!r}; {remedy}.")


def check_list(name: str, value: Any, kind: type, what: str) -> None:
    """Refuses anything but a list of different values of a kind, or ``None``.

    Raises:
        ValueError: if it is something else; a single string counts as that.
    """
    listed = isinstance(value, Sequence) and not isinstance(value, str)
    if value is None or (listed and all(isinstance(each, kind) and not isinstance(each, bool) for each in value)):
        if value is not None and len(set(value)) < len(value):
            raise ValueError(f"{name} must be different {what}, got {list(value)}; name each of them once.")
        return
    raise ValueError(f"{name} must be a list of {what}, got {value!r}; put a single one into [...].")


def check_id(id: Any) -> None:
    """Refuses what names or makes no worlds.

    Raises:
        ValueError: if it is something else.
    """
    if (
        (isinstance(id, str) and id)
        or isinstance(id, VectorEnv)
        or (callable(id) and not isinstance(id, gymnasium.Env))
    ):
        return
    remedy = "pass the function that makes it" if isinstance(id, gymnasium.Env) else "for instance 'CartPole-v1'"
    raise ValueError(
        f"id must be the id of an environment, a function that makes one world, or a vector of worlds, got {id!r}; "
        f"{remedy}."
    )


def check_given(
    id: Any, num_envs: Any, *, settings: Any, package: Any, wrappers: Any, actions: Any, max_steps: Any, seed: Any
) -> None:
    """Refuses arguments of the wrong kind.

    Raises:
        ValueError: naming the argument.
    """
    check_id(id)
    check_whole_number("num_envs", num_envs, remedy="use 16 for training on one core")
    if max_steps is not None:
        check_whole_number("max_steps", max_steps, remedy="None: the environment's own limit")
    if settings is not None and not isinstance(settings, Mapping):
        raise ValueError(f"settings must be arguments of the environment by name, got {settings!r}; use {{'size': 5}}.")
    if package is not None and not (isinstance(package, str) and package):
        raise ValueError(f"package must be the name of a package, got {package!r}; None: Gymnasium's own environments.")
    if seed is not None:
        check_whole_number("seed", seed, least=0, remedy="None: one is drawn")
    check_list("actions", actions, Integral, "numbers of actions")
    if not isinstance(wrappers, Sequence) or isinstance(wrappers, str):
        raise ValueError(f"wrappers must be a list, got {wrappers!r}; put a single one into [...].")


def check_rule(name: str, rule: Any) -> None:
    """Refuses what is neither an entry's name nor a function of (reward, info).

    Raises:
        ValueError: if it is something else.
    """
    if rule is None or (isinstance(rule, str) and rule):
        return
    try:
        inspect.signature(rule).bind(0.0, {})
    except TypeError as error:
        raise ValueError(
            f"{name} must name an entry of info, or be a function of (reward, info), got {rule!r} ({error})."
        ) from error
    except ValueError:  # some that are written in C tell no signature
        return


def wrapped(env: gymnasium.Env, wrapper: Any) -> gymnasium.Env:
    """An environment in a wrapper.

    Raises:
        ValueError: if it is none, or takes more than an environment.
    """
    name = getattr(wrapper, "__name__", repr(wrapper))
    try:
        inspect.signature(wrapper).bind(env)
    except TypeError as error:
        raise ValueError(
            f"wrappers must take an environment and nothing else, got {name} ({error}); write a function that gives it "
            "the rest."
        ) from error
    return checked_world(wrapper(env), "wrappers", f"{name}, which")


def checked_world(made: Any, argument: str, what: str) -> gymnasium.Env:
    """What was made, if it is an environment.

    Raises:
        ValueError: if it is none.
    """
    if not isinstance(made, gymnasium.Env):
        raise ValueError(f"{argument} must return an environment of Gymnasium, got {what} returned {made!r}.")
    return made
