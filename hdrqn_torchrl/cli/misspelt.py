"""What a setting that conf/ does not know was meant to be: Hydra only proposes to append it, which is refused later."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import ConfigCompositionException
from omegaconf import OmegaConf

from hdrqn_torchrl.cli.configuration import CONF
from hdrqn_torchrl.runs.settings.commands import command_of
from hdrqn_torchrl.runs.settings.comparing import flat

_UNKNOWN = re.compile(r"Could not override '(.+?)'")


@contextlib.contextmanager
def misspelt_named(arguments: Sequence[str]) -> Iterator[None]:
    """After Hydra has ended the program, says what :func:`misspelt` finds in its arguments."""
    try:
        yield
    except SystemExit as end:
        if end.code == 1:  # Hydra's own
            for sentence in misspelt(arguments):
                print(sentence, file=sys.stderr)
        raise


def misspelt(arguments: Sequence[str]) -> list[str]:
    """A sentence for each setting of a training's command that does not exist, with those that it resembles.

    Args:
        arguments: of the command line, as Hydra takes them.

    Returns:
        None of them if the command is wrong in another way, about which Hydra has said all.
    """
    given = [each for each in arguments if not each.startswith("-") and "=" in each]
    told = []
    with initialize_config_dir(str(CONF), version_base="1.3"):
        try:
            overrides = [_alone(each) for each in OverridesParser.create().parse_overrides(given)]
            while True:
                try:
                    known = compose("config", [*_search_path(arguments), *overrides])
                    break
                except ConfigCompositionException as error:
                    if not (found := _UNKNOWN.match(str(error))):
                        return []
                    key = found[1]
                    overrides = [each for each in overrides if each.partition("=")[0] != key]
                    told.append(key)
        except Exception:  # only a hint is lost
            return []
    settings = flat(OmegaConf.to_container(known))
    groups = sorted(path.name for path in CONF.iterdir() if path.is_dir())
    return [_entry_by_entry(key) if settings.get(key) == {} else _sentence(key, [*settings, *groups]) for key in told]


def _alone(override: Override) -> str:
    """An override of a sweep with the first of its values."""
    if not override.is_sweep_override():
        return str(override.input_line)
    return f"{override.get_key_element()}={next(override.sweep_string_iterator())}"


def _search_path(arguments: Sequence[str]) -> Iterator[str]:
    """The user's own folder of files, if the command has one."""
    for option, value in zip(arguments, [*arguments[1:], ""], strict=True):
        name, _, joined = option.partition("=")
        if name in ("--config-dir", "-cd"):
            yield f"hydra.searchpath=['file://{Path(joined or value).absolute()}']"


def _entry_by_entry(key: str) -> str:
    return f"error: {key} takes entries of your own one by one, not as a whole: '+{key}.NAME=VALUE'."


def _sentence(key: str, known: Sequence[str]) -> str:
    last = key.rpartition(".")[2]
    alike = [each for each in known if each.rpartition(".")[2] == last] or get_close_matches(key, known, 3, 0.75)
    meant = f"did you mean {' or '.join(alike)}? " if alike else ""
    shown = f"`{command_of('train')} --cfg job` shows every setting and its default"
    return f"error: {key} must be a known setting; {meant}{shown}."
