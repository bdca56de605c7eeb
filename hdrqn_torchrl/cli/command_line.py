"""The command line of the programs that look at runs: ``key=value`` arguments."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TextIO, get_type_hints

from omegaconf import MISSING, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.settings.arguments import SettingsError
from hdrqn_torchrl.runs.settings.commands import as_called
from hdrqn_torchrl.runs.settings.seeds import LARGEST_SEED


def check_place(path: Path, key: str) -> None:
    """Refuses a file that can't be written, or is one of a run's own, before anything is done; makes its folder.

    Args:
        path: the file.
        key: the setting that names it.
    """
    real = path.resolve()
    if real.name in (*layout.WRITTEN, layout.WEIGHTS, layout.CARD) and layout.holds_run(real.parent):
        raise SettingsError(f"{key} must not be a file that a run consists of, got {str(path)!r}; name another one.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        probe = path.with_name(f".{path.name}.partial")
        probe.touch()
        probe.unlink()
        if path.is_dir():
            raise IsADirectoryError("it is a folder")
    except OSError as error:
        raise SettingsError(f"{key} must be a file that can be written, got {str(path)!r} ({error}).") from error


def check_folder(path: Path, key: str) -> None:
    """Refuses a folder that files can't be written to, before anything is done; makes it.

    Args:
        path: the folder.
        key: the setting that names it.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise SettingsError(f"{key} must be a folder that can be written to, got {str(path)!r} ({error}).") from error


_RESULTS: ContextVar[TextIO | None] = ContextVar("results", default=None)


@contextlib.contextmanager
def results_alone() -> Iterator[None]:
    """Leaves the standard output to :func:`print_result`: what worlds print meanwhile goes to the error output."""
    before = _RESULTS.set(sys.stdout)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        _RESULTS.reset(before)


def print_result(text: str) -> None:
    """Prints to the standard output, also inside of :func:`results_alone`."""
    print(text, file=_RESULTS.get(), flush=True)


def overrides_last(arguments: Sequence[str]) -> list[str]:
    """Hydra's arguments with its options before the settings, in which order alone it reads them.

    Examples:
        >>> overrides_last(["env=mine", "--config-dir", "my_conf", "~algo.gamma", "-m", "seed=0,1"])
        ['--config-dir', 'my_conf', '-m', 'env=mine', '~algo.gamma', 'seed=0,1']
    """
    settings = [each for each in arguments if not each.startswith("-") and ("=" in each or each.startswith("~"))]
    return [each for each in arguments if each not in settings] + settings


def command_line(schema: type, doc: str, run: Callable[[Any], None]) -> None:
    """Calls ``run`` with an instance of ``schema`` filled from ``key=value`` arguments; exits with a message on errors.

    Args:
        schema: dataclass of the settings; ``MISSING`` marks those that must be given.
        doc: what ``--help`` prints.
        run: does the work.
    """
    arguments = sys.argv[1:]
    if {"-h", "--help"} & set(arguments) or not arguments:
        print(as_called(doc.strip()))
        sys.exit(0 if arguments else 2)
    try:
        if wrong := [argument for argument in arguments if "=" not in argument]:
            raise SettingsError(f"an argument must read key=value, got {wrong[0]!r}; --help shows all of them.")
        pairs = [argument.lstrip("+").split("=", 1) for argument in arguments]  # +: as a training needs it
        texts = {key: value for key, value in pairs if _is_text(schema, key, value)}
        read = [f"{key}={'text' if key in texts else value}" for key, value in pairs]
        try:
            settings = OmegaConf.merge(OmegaConf.structured(schema), OmegaConf.from_dotlist(read))
        except (OmegaConfBaseException, YAMLError) as error:
            known = ", ".join(each.name for each in fields(schema))
            raise SettingsError(f"{str(error).splitlines()[0]}; the settings are {known}.") from error
        if missing := OmegaConf.missing_keys(settings):
            raise SettingsError(f"{min(missing)} must be given: {min(missing)}=...; --help shows all settings.")
        given = replace(OmegaConf.to_object(settings), **texts)  # type: ignore[type-var]
        _check_seed(getattr(given, "seed", None))
        run(given)
        sys.stdout.flush()
    except SettingsError as error:
        sys.exit(f"error: {error}")
    except BrokenPipeError:  # whoever reads the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python would fail again as it ends
        sys.exit(1)


def _check_seed(seed: int | None) -> None:
    if seed is not None and not 0 <= seed <= LARGEST_SEED:
        raise SettingsError(f"seed must lie in [0, {LARGEST_SEED:,}], got {seed}; leave it out for the default.")


def _is_text(schema: type, key: str, value: str) -> bool:
    """Whether a value is taken literally and not as YAML: file names may contain ``#``, ``:``, ``*`` or ``null``.

    Settings of any type (``runs``, ``out``) take a string or a ``[list]``.
    """
    hint = get_type_hints(schema).get(key)
    if hint is Any:
        optional = getattr(schema, key, MISSING) != MISSING  # then it may be null
        return not (value.startswith("[") and value.endswith("]")) and not (optional and value == "null")
    return hint in (str, str | None)


def as_list(value: Any, *, split: bool = False) -> list:
    """A setting that may be missing, one value or several, as a list; with ``split`` also ``a,b``."""
    if value is None:
        return []
    if isinstance(value, list):
        return value
    return str(value).split(",") if split else [value]
