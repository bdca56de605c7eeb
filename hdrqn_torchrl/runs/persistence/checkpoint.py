"""Checkpoints of a whole training, on ``torchrl.checkpoint``: durable, verified, and unable to run code.

TorchRL's ``Checkpoint`` writes a folder beside its destination and renames it. (Its ``CheckpointRotation`` is not used:
it reads whatever lies beside, archives and pipes, too.) Added here: files that need no pickle (``serialization.py``);
every byte on the disk (fsync) before a checkpoint gets its name; a checksum of every file, checked before anything is
loaded; the last few and the best are kept; removal of what killed writes left behind.
"""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import SafetensorError
from torchrl.checkpoint import Checkpoint, CheckpointError, GlobalRNGState

from hdrqn_torchrl.runs.persistence.durable import (
    MANIFEST,
    MEMORY,
    DurableCheckpoint,
    forget_memories,
    remove_all,
    verify,
)
from hdrqn_torchrl.runs.persistence.files import RunFileError, check_folder, read_json
from hdrqn_torchrl.runs.persistence.state_checks import Rule

PREFIX, SCORE = "checkpoint-", "greedy_return"
_LONGEST_REASON = 400
Replay = bool | Literal["last"]
_UNSCORED = -sys.float_info.max  # the rotation wants a finite number; this one is never the best


class RandomState(GlobalRNGState):
    """TorchRL's state of all global random generators, whose position in numpy's table is checked."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores what ``state_dict`` returned.

        Raises:
            ValueError: if it is not a valid state: numpy would read beyond its table.
        """
        name, table, place, *_ = state_dict["numpy"]
        if name != "MT19937" or table.shape != (624,) or not 0 <= place <= 624:
            raise ValueError(
                "the stored state of numpy's random numbers must be one of MT19937; use another checkpoint."
            )
        of_gpus = state_dict.get("torch_cuda", ())[: torch.cuda.device_count()]  # a machine may have fewer, or none
        rest = {name: state for name, state in state_dict.items() if name != "torch_cuda"}
        super().load_state_dict(rest | ({"torch_cuda": of_gpus} if of_gpus else {}))


class Checkpoints:
    """The checkpoints in one folder: saves, keeps the last few and the best, finds the newest that is whole.

    Args:
        directory: where they lie; created with the first save.
        keep_last: how many of the newest are kept, beside the best by greedy return.
        replay: which of them keep components named ``memory-...``, by far the largest: all (``True``), none (``False``)
            or ``"last"``, the newest alone.

    Raises:
        ValueError: if an argument breaks its rule.

    Examples:
        >>> import tempfile
        >>> checkpoints = Checkpoints(Path(tempfile.mkdtemp()))
        >>> source, target = torch.nn.Linear(2, 1), torch.nn.Linear(2, 1)
        >>> path = checkpoints.save({"policy": source}, step=100)
        >>> _ = checkpoints.load({"policy": target}, path)
        >>> bool((source.weight == target.weight).all())
        True
    """

    def __init__(self, directory: str | Path, *, keep_last: int = 2, replay: Replay = True) -> None:
        if keep_last < 2:
            raise ValueError(f"keep_last must be >= 2, got {keep_last}; one must stay while the newest is replaced.")
        if replay not in (True, False, "last"):
            raise ValueError(f"replay must be True, False or 'last', got {replay!r}; True resumes bit for bit.")
        self.directory, self.replay = Path(directory), replay
        self._keep_last = keep_last

    def save(self, components: Mapping[str, Any], *, step: int, score: float | None = None) -> Path:
        """Writes a checkpoint and removes those that are no longer kept.

        Args:
            components: objects with ``state_dict``, by name.
            step: its place in the order, e.g. environment frames.
            score: what makes it the best, if it was measured for these very weights; ``None``: what was measured at
                this step before, if anything.

        Raises:
            CheckpointError: if it can't be written; earlier checkpoints are untouched.
        """
        try:
            kept = {name: each for name, each in components.items() if self.replay or not name.startswith(MEMORY)}
            self._check_place()
            path = self.directory / f"{PREFIX}{step:012d}"
            measured = [each for each in (score, _score(path), _UNSCORED) if each is not None]  # at this very step
            DurableCheckpoint(kept).save(path, metadata={SCORE: measured[0]})
            self._prune()
            for earlier in self._paths():
                if self.replay == "last" and earlier != path:
                    forget_memories(earlier)
            return path
        except (OSError, SafetensorError, RunFileError) as error:
            raise CheckpointError(
                f"the checkpoint at step {step} can't be written to {self.directory} ({error}); {self.last_good()}. "
                "Make room or make the folder writable, then resume the run."
            ) from error

    def last_good(self) -> str:
        """Names the newest whole checkpoint, for messages."""
        whole = next(self._whole(), None)
        return f"the last good checkpoint is {whole}" if whole else "there is no earlier checkpoint"

    def _check_place(self) -> None:
        """Refuses a link in place of the folder: what lies elsewhere is neither read nor removed."""
        try:
            check_folder(self.directory, root=self.directory.parent)
        except RunFileError as error:
            raise CheckpointError(str(error)) from error

    def _prune(self) -> None:
        """Removes all but the newest and the best; what can't be read as a checkpoint is left alone."""
        scores = {path: score for path in self._paths() if (score := _score(path)) is not None}  # the newest first
        kept = {
            *list(scores)[: self._keep_last],
            max(scores, key=lambda path: (scores[path], step_of(path)), default=None),
        }
        for path in scores.keys() - kept:
            remove_all(path.rename(path.with_name(f".{path.name}.delete")))

    def load(
        self,
        components: Mapping[str, Any],
        path: Path,
        device: torch.device | str = "cpu",
        rules: Mapping[str, Rule] | None = None,
    ) -> list[str]:
        """Restores components from the checkpoint ``path`` after checking all of it.

        Those named ``memory-...`` are left alone if it was saved without them.

        Args:
            components: objects with ``load_state_dict``, by name.
            path: the checkpoint.
            device: where tensors are put.
            rules: what entries of TensorDicts must be (:func:`~hdrqn_torchrl.runs.persistence.state_checks.rules_of`).

        Returns:
            Names of the components that were left alone.

        Raises:
            CheckpointError: if the checkpoint is not whole, or does not fit the components.
        """
        verify(path)
        try:
            stored = Checkpoint.manifest(path)["components"]
            wanted = {name: each for name, each in components.items() if name in stored or not name.startswith(MEMORY)}
            DurableCheckpoint(wanted, rules).load(path, map_location=device)
            return [name for name in components if name not in wanted]
        except CheckpointError as error:
            raise CheckpointError(
                f"{path} does not fit; it must be loaded with the settings that it was made with ({_in_a_line(error)})."
            ) from error

    def newest(self) -> Path | None:
        """The newest checkpoint that is whole, ``None`` if there are none at all.

        A warning names the damaged ones that were skipped.

        Raises:
            CheckpointError: if there are some and all are damaged.
        """
        newest = next(self._whole(), None)
        if newest is None and self._paths():
            raise CheckpointError(
                f"no checkpoint in {self.directory} can be loaded; remove that folder to start from the beginning."
            )
        return newest

    def best(self) -> Path | None:
        """The whole checkpoint with the best score, or the newest if none has one."""
        scores = {path: score for path in self._whole() if (score := _score(path)) is not None}
        return max(scores, key=lambda path: scores[path], default=None) or self.newest()

    def go_back_to(self, step: int) -> None:
        """Removes later checkpoints, as their steps will be done again, and damaged ones, which would count as kept."""
        kept = {path for path in self._whole() if step_of(path) <= step}
        for path in self._paths():
            if path not in kept:
                remove_all(path.rename(path.with_name(f".{path.name}.delete")))

    def _paths(self) -> list[Path]:
        """Folders named like checkpoints, the newest first."""
        self._check_place()
        folders = [path for path in self.directory.glob(f"{PREFIX}[0-9]*") if path.is_dir() and step_of(path) >= 0]
        if links := [path for path in folders if path.is_symlink()]:
            raise CheckpointError(
                f"{links[0]} must be a checkpoint, got a symbolic link; nothing in a run folder is followed."
            )
        return sorted(folders, key=step_of, reverse=True)

    def _whole(self) -> Iterator[Path]:
        """Undamaged checkpoints, the newest first."""
        for path in self._paths():
            try:
                verify(path)
            except CheckpointError as error:
                warnings.warn(f"{error} It is skipped.", stacklevel=3)
            else:
                yield path

    def clean_up(self) -> None:
        """Removes what killed writes left behind. Call it when no other process writes here."""
        self._check_place()
        for orphan in self.directory.glob(f".{PREFIX}*"):
            name, _, kind = orphan.name[1:].rpartition(".")
            if kind.startswith("backup-") and not (self.directory / name).exists():
                orphan.rename(self.directory / name)  # killed between the two renames of a replacement
            else:
                remove_all(orphan)


def _in_a_line(error: Exception) -> str:
    """The first complaint of an error: torch lists every tensor, and prints whole memories."""
    text = " ".join(str(error).split())
    return text if len(text) <= _LONGEST_REASON else f"{text[:_LONGEST_REASON]}..."


def step_of(path: Path) -> int:
    """The step in a checkpoint's name; -1 for other names.

    Examples:
        >>> step_of(Path("checkpoints/checkpoint-000000150016"))
        150016
    """
    number = path.name.removeprefix(PREFIX)
    return int(number) if number.isdecimal() else -1


def _score(path: Path) -> float | None:
    """What a checkpoint scored, the least there is if it was not measured; ``None`` if it can't be read."""
    try:
        metadata = read_json(path / MANIFEST, root=path)["metadata"]
        score = metadata.get(SCORE) if isinstance(metadata, dict) else None
        return score if isinstance(score, float) and math.isfinite(score) else _UNSCORED
    except (OSError, ValueError, TypeError, KeyError):
        return None
