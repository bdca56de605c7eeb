"""Checkpoints of a whole training, on ``torchrl.checkpoint``: durable, verified, and unable to run code.

TorchRL's ``Checkpoint`` writes a folder beside its destination and renames it. (Its ``CheckpointRotation`` is not used:
it reads whatever lies beside, archives and pipes, too.) Added here: files that need no pickle (``serialization.py``);
every byte on the disk (fsync) before a checkpoint gets its name; a checksum of every file, checked before anything is
loaded; the last few and the best are kept; removal of what killed writes left behind.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
import warnings
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torchrl.checkpoint import Checkpoint, CheckpointError, GlobalRNGState

from hdrqn_torchrl.runs.files import (
    RunFileError,
    check_file,
    check_folder,
    is_hollow,
    memory_of_this_machine,
    read_json,
)
from hdrqn_torchrl.runs.serialization import SafetensorsAdapter, check_tensors
from hdrqn_torchrl.runs.state_checks import Rule

CHECKSUMS = "checksums.json"
PREFIX, SCORE, MEMORY = "checkpoint-", "greedy_return", "memory-"
_LONGEST_REASON = 400
Replay = bool | Literal["last"]
_UNSCORED = -sys.float_info.max  # the rotation wants a finite number; this one is never the best


class DurableCheckpoint(Checkpoint):
    """TorchRL's ``Checkpoint`` with checksums, written to the disk before it gets its name.

    Args:
        components: objects with ``state_dict`` and ``load_state_dict``, by name.
        rules: see :class:`~hdrqn_torchrl.runs.serialization.SafetensorsAdapter`.
    """

    def __init__(self, components: Mapping[str, Any], rules: Mapping[str, Rule] | None = None) -> None:
        super().__init__()
        for name, component in components.items():
            holds_steps = name.startswith(("collector", "learner-", MEMORY))  # others have sums under the same names
            self.register(name, component, adapter=SafetensorsAdapter(rules if holds_steps else None))

    @staticmethod
    def _publish_path(source: Path, destination: Path) -> None:
        files = sorted(path for path in source.rglob("*") if path.is_file())
        _seal(source, {path.relative_to(source).as_posix(): _checksum(path) for path in files})
        Checkpoint._publish_path(source, destination)
        _sync(destination.parent)


class RandomState(GlobalRNGState):
    """TorchRL's state of all global random generators, whose position in numpy's table is checked."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restores what ``state_dict`` returned.

        Raises:
            ValueError: if it can't be what it returned: numpy reads beyond its table then.
        """
        name, table, place, *_ = state_dict["numpy"]
        if name != "MT19937" or table.shape != (624,) or not 0 <= place <= 624:
            raise ValueError(
                "the stored state of numpy's random numbers must be one of MT19937; use another checkpoint."
            )
        super().load_state_dict(state_dict)


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

    def __init__(self, directory: Path, *, keep_last: int = 2, replay: Replay = True) -> None:
        if keep_last < 2:
            raise ValueError(f"keep_last must be >= 2, got {keep_last}; one must stay while the newest is replaced.")
        if replay not in (True, False, "last"):
            raise ValueError(f"replay must be True, False or 'last', got {replay!r}; True resumes bit for bit.")
        self.directory, self.replay = directory, replay
        self._keep_last = keep_last

    def save(self, components: Mapping[str, Any], *, step: int, score: float | None = None) -> Path:
        """Writes a checkpoint and removes those that are no longer kept.

        Args:
            components: objects with ``state_dict``, by name.
            step: its place in the order, e.g. environment frames.
            score: what makes it the best, if it was measured for these very weights.

        Raises:
            CheckpointError: if it can't be written; earlier checkpoints are untouched.
        """
        try:
            metadata = {SCORE: _UNSCORED if score is None else score}
            kept = {name: each for name, each in components.items() if self.replay or not name.startswith(MEMORY)}
            self._check_place()
            path = self.directory / f"{PREFIX}{step:012d}"
            DurableCheckpoint(kept).save(path, metadata=metadata)
            self._prune()
            for earlier in self._paths():
                if self.replay == "last" and earlier != path:
                    _forget_memories(earlier)
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
            max(scores, key=lambda path: (scores[path], _step(path)), default=None),
        }
        for path in scores.keys() - kept:
            _remove(path.rename(path.with_name(f".{path.name}.delete")))

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
            rules: what entries of TensorDicts must be (:func:`~hdrqn_torchrl.runs.state_checks.rules_of`).

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

        A warning tells of damaged ones that were passed over.

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
        kept = {path for path in self._whole() if _step(path) <= step}
        for path in self._paths():
            if path not in kept:
                _remove(path.rename(path.with_name(f".{path.name}.delete")))

    def _paths(self) -> list[Path]:
        """Folders named like checkpoints, the newest first."""
        self._check_place()
        folders = [path for path in self.directory.glob(f"{PREFIX}[0-9]*") if path.is_dir() and _step(path) >= 0]
        if links := [path for path in folders if path.is_symlink()]:
            raise CheckpointError(
                f"{links[0]} must be a checkpoint, got a symbolic link; nothing in a run folder is followed."
            )
        return sorted(folders, key=_step, reverse=True)

    def _whole(self) -> Iterator[Path]:
        """Undamaged checkpoints, the newest first."""
        for path in self._paths():
            try:
                verify(path)
            except CheckpointError as error:
                warnings.warn(f"{error} It is passed over.", stacklevel=3)
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
                _remove(orphan)


def _forget_memories(path: Path) -> None:
    """Replaces a checkpoint by one without its memories; a kill leaves what :meth:`Checkpoints.clean_up` mends."""
    try:
        manifest, sums = Checkpoint.manifest(path), read_json(path / CHECKSUMS)
        memories = [name for name in manifest["components"] if name.startswith(MEMORY)]
        places = [manifest["components"].pop(name)["path"] for name in memories]
    except (CheckpointError, ValueError, TypeError, KeyError, AttributeError):
        return  # it is damaged, and stays as it is
    if not places:
        return
    stage, backup = (path.with_name(f".{path.name}.{kind}-0") for kind in ("stage", "backup"))
    shutil.copytree(path, stage, symlinks=True, ignore=shutil.ignore_patterns(*(Path(place).name for place in places)))
    (stage / "manifest.json").write_text(json.dumps(manifest))
    kept = {name: each for name, each in sums.items() if not name.startswith(tuple(f"{place}/" for place in places))}
    _seal(stage, kept | {"manifest.json": _checksum(stage / "manifest.json")})  # of the others as they were written
    path.rename(backup)
    stage.rename(path)
    _sync(path.parent)
    _remove(backup)


def _seal(stage: Path, sums: Mapping[str, list[int]]) -> None:
    """Adds the checksums, and writes everything to the disk."""
    (stage / CHECKSUMS).write_text(json.dumps(sums))
    for path in (stage, *stage.rglob("*")):
        _sync(path)


def _in_a_line(error: Exception) -> str:
    """What was wrong first; torch lists every tensor, and shows whole memories."""
    text = " ".join(str(error).split())
    return text if len(text) <= _LONGEST_REASON else f"{text[:_LONGEST_REASON]}..."


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def _step(path: Path) -> int:
    """The step in a checkpoint's name; -1 for other names."""
    number = path.name.removeprefix(PREFIX)
    return int(number) if number.isdecimal() else -1


def _score(path: Path) -> float | None:
    """What a checkpoint scored, the least there is if it was not measured; ``None`` if it can't be read."""
    try:
        metadata = read_json(path / "manifest.json", root=path)["metadata"]
        score = metadata.get(SCORE) if isinstance(metadata, dict) else None
        return score if isinstance(score, float) and math.isfinite(score) else _UNSCORED
    except (OSError, ValueError, TypeError, KeyError):
        return None


def verify(path: Path) -> None:
    """Checks that a checkpoint is complete and unchanged since it was written.

    Raises:
        CheckpointError: if it is not, naming the file at fault.
    """
    try:
        sums = read_json(path / CHECKSUMS, root=path)
        if not isinstance(sums, dict) or "manifest.json" not in sums:
            raise ValueError("it lists no files")
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} is not a checkpoint of this package ({CHECKSUMS}: {error}).") from error
    _check_files(path, sums)
    for name, expected in sums.items():
        if _checksum(path / name) != expected:
            raise CheckpointError(f"{path} is damaged: {name} is not what was written.")
    try:
        read_json(path / "manifest.json", root=path)  # whether TorchRL may
        records = Checkpoint.manifest(path)["components"].values()
    except (CheckpointError, OSError, ValueError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{path} is not a checkpoint of this package (manifest.json: {error}).") from error
    for record in records:
        if not {f"{record['path']}/{name}" for name in record["files"]} <= set(sums):
            raise CheckpointError(f"{path} is not complete: {CHECKSUMS} lacks files of {record['path']}.")


def _check_files(path: Path, sums: Mapping[str, Any]) -> None:
    """What can be told without reading much, before much is read: places, kinds and sizes."""
    total = 0
    for name, expected in sums.items():
        file = path / name
        try:
            if not Path(os.path.normpath(file)).is_relative_to(os.path.normpath(path)):
                raise RunFileError(f"{name} lies outside of it")
            check_file(file, root=path)
        except RunFileError as error:
            raise CheckpointError(f"{path} is not a checkpoint of this package: {error}.") from error
        if not file.is_file():
            raise CheckpointError(f"{path} is not complete: {name} is missing.")
        size = file.stat().st_size
        if not isinstance(expected, list) or expected[:1] != [size]:
            raise CheckpointError(f"{path} is damaged: {name} is not what was written.")
        total += size
        if is_hollow(file) or total > memory_of_this_machine():
            raise CheckpointError(
                f"{path} is damaged: {name} holds less than its {size:,} bytes, or more than memory does."
            )


def load_policy(policy: nn.Module, directory: Path, which: str = "best") -> None:
    """Loads a policy's weights from a run.

    Args:
        policy: built with the settings of the run.
        directory: the run's folder of checkpoints.
        which: ``"best"``, ``"last"``, or the path of a checkpoint or of a file of :func:`save_weights`.

    Raises:
        ValueError: if there is none, it is damaged, or it does not fit.
    """
    checkpoints = Checkpoints(directory)
    try:
        path = {"best": checkpoints.best, "last": checkpoints.newest}.get(which, lambda: Path(which))()
        if path is None:
            raise ValueError(f"checkpoint={which} is not in {directory}: the run has not saved anything yet.")
        if path.is_file():
            load_weights(policy, path)
        else:
            checkpoints.load({"policy": policy}, path)
    except CheckpointError as error:
        raise ValueError(f"checkpoint can't be loaded: {error}") from error


def save_weights(module: nn.Module, path: Path) -> None:
    """Writes a module's parameters and buffers to ``path``, which is either the whole file or the one before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    save_file({name: value.detach().cpu().contiguous().clone() for name, value in module.state_dict().items()}, partial)
    _sync(partial)
    partial.replace(path)
    _sync(path.parent)


def load_weights(module: nn.Module, path: Path) -> None:
    """Reads what :func:`save_weights` wrote into ``module``.

    Raises:
        ValueError: if there is no such file, it is of another kind, or it does not fit the module.
    """
    try:
        module.load_state_dict(read_weights(path))
    except RuntimeError as error:
        raise ValueError(f"{path} does not fit this policy; build it with the settings of its run.\n{error}") from error


def read_weights(path: Path) -> dict[str, Tensor]:
    """What :func:`save_weights` wrote, by name.

    Raises:
        ValueError: if there is no such file, or it is of another kind.
    """
    if not path.is_file():
        raise ValueError(f"path must name a weights file, got {path}; a run keeps its own in checkpoints/.")
    try:
        check_tensors(path)
        return load_file(path)
    except (SafetensorError, ValueError) as error:
        raise ValueError(
            f"{path} must be a safetensors file, got something else ({error}); see checkpoints/."
        ) from error


def _checksum(path: Path) -> list[int]:
    """Size and CRC-32 of a file."""
    value = 0
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            value = zlib.crc32(block, value)
    return [path.stat().st_size, value]


def _sync(path: Path) -> None:
    """Waits until a file or the entries of a folder are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
