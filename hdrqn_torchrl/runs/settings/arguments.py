"""Types of settings: what a builder's annotations ask for, checked before it is called.

So every builder and settings class, a user's own included, refuses ``algo.sub.batch_size=1.5`` in the same words.
"""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from hdrqn_torchrl.runs.settings.commands import command_of

TARGET = "_target_"
Settings = dict[str, Any]
_IN_WORDS: dict[Any, str] = {
    type(None): "null", bool: "true or false", int: "an integer", float: "a finite number", str: "a string",
}  # fmt: skip


class SettingsError(ValueError):
    """A setting that breaks its rule, found before any work is done."""


def check_arguments(node: Any, path: str, locate: Callable[[str], Any]) -> None:
    """Checks the names and types of all settings below ``path``.

    Args:
        node: settings with a ``_target_``, plain data; those below it may have targets, too.
        path: their full name, for the message.
        locate: finds what a ``_target_`` names.

    Raises:
        SettingsError: with the full name of the first setting that its builder does not take, or of another type than
            its annotations ask for.

    Examples:
        >>> from hdrqn_torchrl.modules import EpsilonGreedy
        >>> check_arguments({"_target_": "epsilon", "start": 1}, "exploration", lambda _: EpsilonGreedy)
        >>> check_arguments({"_target_": "epsilon", "start": "high"}, "exploration", lambda _: EpsilonGreedy)
        Traceback (most recent call last):
        ...
        hdrqn_torchrl.runs.settings.arguments.SettingsError: exploration.start must be a finite number, got 'high'; ...
    """
    if not isinstance(node, Mapping) or not isinstance(node.get(TARGET), str):
        raise SettingsError(f"{path} must be settings with a {TARGET}, got {shown(node)}; {remedy()}.")
    try:
        builder = locate(node[TARGET])
    except SettingsError as error:
        raise SettingsError(f"{path}.{error}") from error
    hints, taken = annotations_of(builder), _taken_by(builder)
    for name, value in _settings(node):
        full = f"{path}.{name}"
        if taken is not None and name not in taken:
            raise SettingsError(
                f"{full} must be left out, got {shown(value)}: {node[TARGET]} takes {', '.join(taken)}; "
                f"'~{full}' in the command of a training leaves it out."
            )
        if isinstance(value, Mapping) and TARGET in value:
            check_arguments(value, full, locate)
        elif name in hints and not fits(value, hints[name]):
            raise SettingsError(f"{full} must be {in_words(hints[name])}, got {shown(value)}; {remedy()}.")


def remedy() -> str:
    """The remedy for a wrong setting, for messages."""
    return f"`{command_of('train')} --cfg job` shows every setting and its default"


def _settings(node: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Without Hydra's own (``_target_``, ``_recursive_``, ...)."""
    return ((str(name), value) for name, value in node.items() if not str(name).startswith("_"))


def annotations_of(builder: Callable) -> dict[str, Any]:
    """What the arguments of a function or class may be; none if its annotations can't be read."""
    try:
        return get_type_hints(builder.__init__ if inspect.isclass(builder) else builder)
    except NameError:  # of someone else's builder, with names that only type checkers import
        return {}


def _taken_by(builder: Callable) -> list[str] | None:
    """Names of the arguments of a function or class; ``None`` if it takes any, or can't be asked."""
    is_class = inspect.isclass(builder)  # whose own signature a metaclass, such as TorchRL's, may hide
    try:
        parameters = list(inspect.signature(builder.__init__ if is_class else builder).parameters.values())[is_class:]
    except (ValueError, TypeError):
        return None
    anything = any(each.kind is inspect.Parameter.VAR_KEYWORD for each in parameters)
    positional = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.VAR_POSITIONAL
    return None if anything else [each.name for each in parameters if each.kind not in positional]


def fits(value: Any, hint: Any) -> bool:
    """Whether a plain value (a number, a string, a list, ...) is what an annotation allows.

    Examples:
        >>> fits(3, float), fits(3.0, int), fits(True, int), fits([1, 2], Sequence[int]), fits(None, int | None)
        (True, False, False, True, True)
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return any(fits(value, each) for each in arguments)
    if origin is Literal:
        return any(value == each and type(value) is type(each) for each in arguments)
    if hint in (None, type(None)):
        return value is None
    if hint is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint in (bool, str):
        return isinstance(value, hint)
    kind = origin or hint
    if not inspect.isclass(kind) or kind in (object, Any):
        return True  # Any and the like
    if issubclass(kind, Mapping):
        return isinstance(value, Mapping)
    if issubclass(kind, Sequence):
        is_list = isinstance(value, Sequence) and not isinstance(value, str)
        return is_list and all(fits(each, arguments[0]) for each in value) if arguments else is_list
    return isinstance(value, kind)  # an object, which is built from settings of its own


def in_words(hint: Any) -> str:
    """What an annotation allows.

    Examples:
        >>> in_words(int | None), in_words(Literal["l2", "smooth_l1"]), in_words(Sequence[int])
        ('an integer or null', "one of 'l2', 'smooth_l1'", 'a list of integers')
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        named = tuple(name for each in arguments if get_origin(each) is Literal for name in get_args(each))
        rest = [each for each in arguments if get_origin(each) is not Literal]
        return " or ".join(in_words(each) for each in ([Literal[named]] if named else []) + rest)
    if origin is Literal:
        return f"one of {', '.join(map(repr, arguments))}"
    if hint in _IN_WORDS:
        return _IN_WORDS[hint]
    kind = origin or hint
    if inspect.isclass(kind) and issubclass(kind, Mapping):
        return "settings by name"
    if inspect.isclass(kind) and issubclass(kind, Sequence):
        return f"a list of {_plural(arguments[0])}" if arguments else "a list"
    return f"settings with a {TARGET} that builds {getattr(kind, '__name__', kind)}"


def _plural(hint: Any) -> str:
    return {int: "integers", float: "finite numbers", str: "strings"}.get(hint, in_words(hint))


def shown(value: Any) -> str:
    """A value as it stands in settings, shortened.

    Examples:
        >>> shown(None), shown(True), shown("a")
        ('null', 'true', "'a'")
    """
    text = "null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
