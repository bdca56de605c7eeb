"""One checkpoint on the disk: sealed with checksums before it gets its name, verified before it is loaded."""

from __future__ import annotations

import json
import os
import shutil
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl.checkpoint import Checkpoint, CheckpointError

from hdrqn_torchrl.runs.persistence.files import RunFileError, check_file, is_hollow, memory_of_this_machine, read_json
from hdrqn_torchrl.runs.persistence.serialization import SafetensorsAdapter
from hdrqn_torchrl.runs.persistence.state_checks import Rule

CHECKSUMS, MANIFEST = "checksums.json", "manifest.json"
MEMORY = "memory-"
"""Prefix of the components that may be left out: replay memories, by far the largest."""


class DurableCheckpoint(Checkpoint):
    """TorchRL's ``Checkpoint`` with checksums, written to the disk before it gets its name.

    Args:
        components: objects with ``state_dict`` and ``load_state_dict``, by name.
        rules: see :class:`~hdrqn_torchrl.runs.persistence.serialization.SafetensorsAdapter`.
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
        sync(destination.parent)


def verify(path: Path) -> None:
    """Checks that a checkpoint is complete and unchanged since it was written.

    Raises:
        CheckpointError: if it is not, naming the file at fault.
    """
    try:
        sums = read_json(path / CHECKSUMS, root=path)
        if not isinstance(sums, dict) or MANIFEST not in sums:
            raise ValueError("it lists no files")
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} is not a checkpoint of this package ({CHECKSUMS}: {error}).") from error
    _check_files(path, sums)
    for name, expected in sums.items():
        if _checksum(path / name) != expected:
            raise CheckpointError(f"{path} is damaged: {name} is not what was written.")
    try:
        read_json(path / MANIFEST, root=path)  # whether TorchRL may
        records = Checkpoint.manifest(path)["components"].values()
    except (CheckpointError, OSError, ValueError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{path} is not a checkpoint of this package (manifest.json: {error}).") from error
    for record in records:
        if not {f"{record['path']}/{name}" for name in record["files"]} <= set(sums):
            raise CheckpointError(f"{path} is not complete: {CHECKSUMS} lacks files of {record['path']}.")


def _check_files(path: Path, sums: Mapping[str, Any]) -> None:
    """Cheap checks before much is read: places, kinds and sizes of the files."""
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


def forget_memories(path: Path) -> None:
    """Replaces a checkpoint by one without its memories; a kill leaves what ``Checkpoints.clean_up`` repairs."""
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
    (stage / MANIFEST).write_text(json.dumps(manifest))
    kept = {name: each for name, each in sums.items() if not name.startswith(tuple(f"{place}/" for place in places))}
    _seal(stage, kept | {MANIFEST: _checksum(stage / MANIFEST)})  # of the others as they were written
    path.rename(backup)
    stage.rename(path)
    sync(path.parent)
    remove_all(backup)


def _seal(stage: Path, sums: Mapping[str, list[int]]) -> None:
    """Adds the checksums, and writes everything to the disk."""
    (stage / CHECKSUMS).write_text(json.dumps(sums))
    for path in (stage, *stage.rglob("*")):
        sync(path)


def _checksum(path: Path) -> list[int]:
    """Size and CRC-32 of a file."""
    value = 0
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            value = zlib.crc32(block, value)
    return [path.stat().st_size, value]


def sync(path: Path) -> None:
    """Waits until a file or the entries of a folder are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_all(path: Path) -> None:
    """Removes a folder with all that is in it, or a file."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
