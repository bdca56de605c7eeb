"""What a run leaves in its folder beside metrics and checkpoints, and who may write there."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from hdrqn_torchrl.runs.persistence import layout
from hdrqn_torchrl.runs.persistence.files import write_whole
from hdrqn_torchrl.runs.persistence.locking import InUse, lock

if TYPE_CHECKING:
    from hdrqn_torchrl.runs.trainer import Trainer


def write_summary(
    folder: Path, trainer: Trainer, result: dict[str, float], *, ceiling: float | None
) -> dict[str, float | None]:
    """Writes ``summary.json``.

    Args:
        folder: run folder.
        trainer: the trainer that ran.
        result: final greedy evaluation (:func:`~hdrqn_torchrl.runs.evaluation.evaluate`).
        ceiling: return of the scripted player that marks it; ``None`` if there is none.

    Returns:
        What stands in it.
    """
    summary: dict[str, float | None] = {
        **result,
        "frames": trainer.frames,
        "updates": trainer.updates,
        "training_episodes": trainer.episodes,
        **{name: round(seconds, 1) for name, seconds in trainer.clock.state_dict().items()},
        "ceiling": ceiling,
    }
    write_whole(folder / layout.SUMMARY, json.dumps(summary, indent=2) + "\n")
    return summary


@contextmanager
def locked(folder: Path, *, patience_seconds: float = 0.0, tell: Callable[[str], None] | None = None) -> Iterator[None]:
    """Keeps other processes from training in the same folder (:func:`~hdrqn_torchrl.runs.persistence.locking.lock`).

    Args:
        folder: run folder; created if it is not there.
        patience_seconds: how long to wait for another process that trains there.
        tell: called once, with a sentence, if there is one to wait for.

    Raises:
        ValueError: if another process trains there, or nothing can be written.
    """

    def tell_of(owner: str) -> None:
        if tell is not None:
            tell(f"{folder} is in use: waiting for {owner}, which is training there")

    with ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(lock(folder / layout.LOCK, patience_seconds=patience_seconds, tell=tell_of))
        except InUse as error:
            raise ValueError(f"{folder} is in use: {error.owner} is training there; wait or stop it.") from error
        except OSError as error:
            raise ValueError(f"the run folder must be writable, got {folder} ({error}); choose another one.") from error
        yield
