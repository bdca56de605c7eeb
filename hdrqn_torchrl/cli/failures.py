"""What a training that fails says and leaves behind: why, a traceback, and the command that goes on."""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import hdrqn_torchrl
from hdrqn_torchrl.cli.configuration import RunError
from hdrqn_torchrl.cli.resuming import Plan, command
from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import write_whole
from hdrqn_torchrl.runs.settings.arguments import SettingsError

if TYPE_CHECKING:
    from hdrqn_torchrl.runs.trainer import Trainer

_OURS = Path(hdrqn_torchrl.__file__).parent


@contextlib.contextmanager
def in_words(run: Plan, *, trainer: Trainer | None = None) -> Iterator[None]:
    """Turns errors of the user and of the machine into messages without a traceback.

    Args:
        run: whose command is told.
        trainer: of the training in progress; every error then ends with what was saved and the command that goes on
            from there. The traceback is printed if the error comes from code outside this package: somebody is going
            to look for it there.

    Raises:
        SettingsError: what the user must change.
        RunError: what else has failed.
    """
    try:
        yield
    except Exception as error:
        told = _told(error, run, trainer)
        if told is error:
            raise
        raise told from error


@contextlib.contextmanager
def noting_errors(run: Plan, *, unless: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """A training that fails leaves a traceback; one that can't be resumed with new settings has not failed."""
    try:
        yield
    except Exception as error:
        if not isinstance(error, unless):
            note_error(run.folder)
        raise


def note_error(folder: Path) -> None:
    """Writes the traceback of the error at hand to ``error.txt``."""
    with contextlib.suppress(OSError):
        write_whole(folder / layout.ERROR, traceback.format_exc())


def _told(error: Exception, run: Plan, trainer: Trainer | None) -> Exception:
    """What is raised in its place; itself, if it says all or is a bug."""
    from torchrl.checkpoint import CheckpointError

    from hdrqn_torchrl.learning.finite import NonFiniteError
    from hdrqn_torchrl.runs.collectors.workers import WorkerError

    goes_on = f"`{command(run.folder, run.config.allowed_targets)}`"
    if isinstance(error, CheckpointError):  # it says what was saved
        return RunError(str(error))
    if isinstance(error, NonFiniteError):  # so does it
        return RunError(f"{error} When that is fixed, {goes_on} goes on.")
    if trainer is not None:
        if not _is_ours(error):
            traceback.print_exc()
        return RunError(_in_training(error, run, trainer, goes_on))
    if isinstance(error, ValueError) and not isinstance(error, SettingsError):
        return SettingsError(str(error))
    if isinstance(error, WorkerError):
        return RunError(str(error))
    if isinstance(error, OSError):
        return RunError(f"{error}; when that is fixed, {goes_on} goes on from the last checkpoint.")
    return error


def _is_ours(error: Exception) -> bool:
    """Whether it was raised by this package, in words for its user, or by the machine."""
    from hdrqn_torchrl.runs.collectors.workers import WorkerError

    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return isinstance(error, (OSError, WorkerError)) or Path(frame.f_code.co_filename).is_relative_to(_OURS)


def _in_training(error: Exception, run: Plan, trainer: Trainer, goes_on: str) -> str:
    """A paragraph: what, where, what is left, and how to go on."""
    from hdrqn_torchrl.runs.persistence.checkpoint import Checkpoints

    newest = Checkpoints(run.folder / layout.CHECKPOINTS).newest()
    what = str(error) if _is_ours(error) else f"{type(error).__name__}: {error}"
    where = f"after frame {trainer.frames:,}, seed {run.config.seed}"
    end = (
        "begins again, as nothing was saved before"
        if newest is None
        else f"goes on from the last checkpoint, {newest.name}"
    )
    if isinstance(error, ValueError) and _is_ours(error):
        end += "; with KEY=VALUE resume_override=true where a setting was wrong"
    notes = "".join(f" {note}" for note in getattr(error, "__notes__", ()))
    return f"{what} ({where}; traceback in {run.folder / layout.ERROR}); when that is fixed, {goes_on} {end}.{notes}"
