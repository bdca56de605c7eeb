"""Every file of a run folder is opened here: a regular file inside it, of bounded size, or an error.

A run folder may come from somebody else. The folder itself may be reached through a link, as that is its reader's
choice; nothing inside it may be one, so nothing outside is ever read, changed or removed. A pipe or a device would keep
its reader waiting for ever, and a file can claim a size that no memory holds.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

MEGABYTE = 1 << 20
LIMITS = {".yaml": MEGABYTE, ".json": 16 * MEGABYTE, ".csv": 24 * MEGABYTE, ".txt": MEGABYTE}
"""Largest sizes in bytes of files that are read whole, by ending; several times what the longest runs write."""

_GUARDED = 0
for _flag in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY"):  # no system has all of them
    _GUARDED |= getattr(os, _flag, 0)
_REFUSALS = (errno.ELOOP, errno.ENXIO)  # what the system says of a link and of a pipe that nobody reads


class RunFileError(ValueError):
    """A file in a run folder that is not what a run leaves there."""


def check_file(path: Path, *, root: Path | None = None) -> None:
    """Refuses a path that is, or goes through, a link or anything else but folders and then a regular file.

    Args:
        path: what is going to be opened or removed; it need not be there.
        root: folder that may be reached in any way, ``path`` lies below it; ``None``: the one that ``path`` is in.

    Raises:
        RunFileError: naming what is in the way.
    """
    check_folder(path.parent, root=path.parent if root is None else root)
    _check(path, stat.S_ISREG)


def check_folder(path: Path, *, root: Path) -> None:
    """Refuses a path at or below ``root`` that is, or goes through, anything but folders; as :func:`check_file`."""
    for place in (path, *path.parents):
        if place == root:
            return
        _check(place, stat.S_ISDIR)
    raise RunFileError(f"{path} must lie in {root}.")


def _check(place: Path, is_kind: Callable[[int], bool]) -> None:
    try:
        mode = place.lstat().st_mode
    except FileNotFoundError:
        return
    if not is_kind(mode):
        raise _refusal(place, mode)


def _refusal(place: Path, mode: int) -> RunFileError:
    kinds = (
        (stat.S_ISLNK, "a symbolic link"),
        (stat.S_ISFIFO, "a pipe"),
        (stat.S_ISDIR, "a folder"),
        (stat.S_ISREG, "a file"),
    )
    kind = next((name for is_kind, name in kinds if is_kind(mode)), "a device or socket")
    return _refusal_of(place, kind)


def _refusal_of(place: Path, kind: str) -> RunFileError:
    return RunFileError(
        f"{place} must be what a run leaves there, got {kind}; nothing in a run folder leads out of it."
    )


def open_file(path: Path, mode: str = "rb", *, root: Path | None = None, newline: str | None = None) -> IO[Any]:
    """Opens a regular file.

    Args:
        path: the file.
        mode: ``"r"``, ``"rb"`` or ``"a"``. To replace a file use :func:`replaced`.
        root: see :func:`check_file`.
        newline: as for :func:`open`.

    Raises:
        RunFileError: if it is something else.
        OSError: if it is not there or can't be opened.
    """
    flags = {"r": os.O_RDONLY, "a": os.O_WRONLY | os.O_APPEND | os.O_CREAT}
    descriptor = open_descriptor(path, flags[mode.replace("b", "")], root=root)
    return open(descriptor, mode, newline=newline, encoding=None if "b" in mode else "utf-8")  # noqa: PTH123


def open_descriptor(path: Path, flags: int, *, root: Path | None = None) -> int:
    """As :func:`os.open`, for a regular file and, to write into it, one that has no other name anywhere.

    Raises:
        RunFileError: if it is something else.
        OSError: if it is not there or can't be opened.
    """
    check_file(path, root=root)
    try:
        descriptor = os.open(path, flags | _GUARDED, 0o666)
    except OSError as error:
        if error.errno in _REFUSALS:
            raise _refusal(path, path.lstat().st_mode) from error
        raise
    found = os.fstat(descriptor)
    if stat.S_ISREG(found.st_mode) and (found.st_nlink == 1 or not flags & (os.O_WRONLY | os.O_RDWR)):
        return descriptor
    os.close(descriptor)
    if stat.S_ISREG(found.st_mode):
        raise _refusal_of(path, "a file with other names (hard links)")
    raise _refusal(path, found.st_mode)


def read_bytes(path: Path, *, root: Path | None = None, limit: int | None = None) -> bytes:
    """All bytes of a file.

    Args:
        path: the file.
        root: see :func:`check_file`.
        limit: largest size in bytes; ``None``: that of its ending in :data:`LIMITS`.

    Raises:
        RunFileError: if it is larger, or no regular file.
        OSError: if it is not there or can't be read.
    """
    limit = LIMITS[path.suffix] if limit is None else limit
    with open_file(path, "rb", root=root) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit or len(content := file.read(limit + 1)) > limit:
            raise RunFileError(
                f"{path} must have at most {limit:,} bytes, got {size:,}; no run writes that much there."
            )
    return content


def read_text(path: Path, *, root: Path | None = None, limit: int | None = None) -> str:
    """The text of a file; arguments and errors as for :func:`read_bytes`, and ``UnicodeDecodeError``."""
    return read_bytes(path, root=root, limit=limit).decode()


def read_json(path: Path, *, root: Path | None = None) -> Any:
    """What a JSON file holds.

    Raises:
        RunFileError: if it is no JSON, nested too deeply, too large, or no regular file.
        OSError: if it is not there or can't be read.
    """
    try:
        return json.loads(read_text(path, root=root))
    except RunFileError:
        raise
    except (ValueError, RecursionError) as error:
        raise RunFileError(f"{path} must be a JSON file, got something else ({error}).") from error


@contextmanager
def replaced(path: Path, *, root: Path | None = None) -> Iterator[Path]:
    """Gives the path of a new file that takes the place of ``path`` when it is complete; the old one stays till then.

    A link at ``path`` is replaced and not followed.

    Raises:
        RunFileError: if it lies behind a link.
        OSError: if it can't be written.
    """
    partial = path.with_name(f"{path.stem}.partial{path.suffix}")  # some writers go by the ending
    check_folder(path.parent, root=path.parent if root is None else root)
    partial.unlink(missing_ok=True)
    try:
        os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _GUARDED, 0o666))
        yield partial
        _sync(partial)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Waits until a file is on the disk."""
    descriptor = os.open(path, os.O_RDWR | _GUARDED)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_whole(path: Path, text: str, *, root: Path | None = None) -> None:
    """Writes a text file that is either whole or the one before, whatever happens; as :func:`replaced`."""
    with replaced(path, root=root) as partial:
        partial.write_text(text, encoding="utf-8")


def remove(path: Path, *, root: Path | None = None) -> None:
    """Removes a file, if it is there.

    Raises:
        RunFileError: if it is not a regular file.
    """
    check_file(path, root=root)
    path.unlink(missing_ok=True)


def is_hollow(path: Path) -> bool:
    """Whether a large file consists almost only of holes: it claims a size that nobody has written."""
    with open_file(path) as file:
        descriptor, size = file.fileno(), os.fstat(file.fileno()).st_size
        if size < 256 * MEGABYTE or not hasattr(os, "SEEK_HOLE"):
            return False
        place = data = 0
        while place < size and data * 100 < size:
            try:
                start = os.lseek(descriptor, place, os.SEEK_DATA)
            except OSError:  # only a hole is left
                break
            place = os.lseek(descriptor, start, os.SEEK_HOLE)
            data += place - start
    return data * 100 < size


def memory_of_this_machine() -> int:
    """Bytes of its main memory; a large number where the system does not say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return 1 << 50
