"""What a run leaves in its folder beside metrics and checkpoints, and who may write there."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from torchrl.envs import EnvBase

from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.envs.grid.ceilings import ceiling
from hdrqn_torchrl.envs.grid.scripted import PLAYERS, PlayerName
from hdrqn_torchrl.runs.files import write_whole
from hdrqn_torchrl.runs.locking import InUse, lock
from hdrqn_torchrl.runs.trainer import Trainer

References = dict[str, dict[str, float]]


def write_summary(
    folder: Path, trainer: Trainer, result: dict[str, float], *, references: References
) -> dict[str, float | None]:
    """Writes ``summary.json``.

    Args:
        folder: run folder.
        trainer: the trainer that ran.
        result: final greedy evaluation (:func:`~hdrqn_torchrl.runs.evaluation.evaluate`).
        references: scripted players' results by name (:func:`references_for`); ``"memory"`` is the ceiling.

    Returns:
        What stands in it.
    """
    summary: dict[str, float | None] = {
        **result,
        "frames": trainer.frames,
        "updates": trainer.updates,
        "training_episodes": trainer.episodes,
        "wall_seconds": round(trainer.wall_seconds, 1),
        "ceiling": ceiling_of(references),
    }
    write_whole(folder / "summary.json", json.dumps(summary, indent=2) + "\n")
    return summary


@contextmanager
def locked(folder: Path, *, patience_seconds: float = 0.0, tell: Callable[[str], None] | None = None) -> Iterator[None]:
    """Keeps other processes from training in the same folder (:func:`~hdrqn_torchrl.runs.locking.lock`).

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
            stack.enter_context(lock(folder / ".lock", patience_seconds=patience_seconds, tell=tell_of))
        except InUse as error:
            raise ValueError(f"{folder} is in use: {error.owner} is training there; wait or stop it.") from error
        except OSError as error:
            raise ValueError(f"the run folder must be writable, got {folder} ({error}); choose another one.") from error
        yield


def references_for(
    env: EnvBase, players: Sequence[PlayerName] = tuple(PLAYERS), *, tell: Callable[[str], None] | None = None
) -> References:
    """What the scripted players achieve on the task of ``env``, by name; empty for tasks that have none.

    Args:
        env: the bare environment.
        players: which of them.
        tell: called with a sentence before each that has to be simulated.
    """
    if not isinstance(env, MultiGoalGridEnv):
        return {}
    return {player: ceiling(player, env, tell=tell) for player in players}


def ceiling_of(references: References) -> float | None:
    """Return of the scripted player with the agent's own view and perfect memory; ``None`` if the task has none."""
    return references["memory"]["return_mean"] if "memory" in references else None
