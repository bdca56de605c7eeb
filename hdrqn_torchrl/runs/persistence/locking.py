"""One process at a time: a lock of the operating system or, where there is none, a file that names its owner."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hdrqn_torchrl.runs.persistence.files import RunFileError, open_descriptor, open_file

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

Owner = dict[str, str | int | float | None]
_NO_FLOCK = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL}
_LARGEST = 4_096  # bytes of a file that names an owner


class InUse(RuntimeError):
    """Another process holds the lock.

    Args:
        owner: which, in words.
    """

    def __init__(self, owner: str) -> None:
        super().__init__(f"held by {owner}")
        self.owner = owner


@contextmanager
def lock(path: Path, *, patience_seconds: float = 0.0, tell: Callable[[str], None] | None = None) -> Iterator[None]:
    """Holds the lock that ``path`` stands for.

    The operating system's own lock (flock) ends with its process, however that ends. Where there is none (some network
    file systems, Windows), the process that creates ``path`` with the ending ``.owner`` holds the lock until it removes
    that file; one of a process of this machine that has died is taken over.

    Args:
        path: a file for the lock; its folder must exist. The file stays, and names its last owner.
        patience_seconds: how long to wait for another process.
        tell: called once, with the name of the process that holds it.

    Raises:
        InUse: if another process holds it all that time.
        RunFileError: if ``path`` is something else.
        OSError: if the file can't be written.
    """
    until = time.monotonic() + patience_seconds
    while True:
        try:
            release = _take(path)
            break
        except InUse as busy:
            if time.monotonic() >= until:
                raise
            if tell is not None:
                tell(busy.owner)
                tell = None
            time.sleep(0.2)
    try:
        yield
    finally:
        release()


def _take(path: Path) -> Callable[[], None]:
    """Takes the lock or raises :class:`InUse`; returns what gives it back."""
    descriptor = open_descriptor(path, os.O_RDWR | os.O_CREAT)  # a link could lead to any file
    try:
        if _flock(descriptor):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, json.dumps(_myself()).encode(), 0)
            return lambda: os.close(descriptor)
        os.close(descriptor)
    except BlockingIOError as error:
        owner = _parse(os.pread(descriptor, _LARGEST, 0))
        os.close(descriptor)
        raise InUse(_in_words(owner)) from error
    except BaseException:
        with contextlib.suppress(OSError):
            os.close(descriptor)
        raise
    return _create(path.with_name(f"{path.name}.owner"))


def _flock(descriptor: int) -> bool:
    """Whether the operating system has locks for this file, and this one is now held."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError as error:
        if error.errno not in _NO_FLOCK:
            raise
        return False
    return True


def _create(path: Path) -> Callable[[], None]:
    """Creates the file that names this process as the owner."""
    for _ in range(2):
        try:
            descriptor = open_descriptor(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        except (FileExistsError, RunFileError):  # another process holds it, or something else lies there
            owner = _read(path)
            if owner is None or not _has_died(owner):
                remedy = f"if no such process is there any more, remove {path}"
                raise InUse(f"{_in_words(owner or {})} ({remedy})") from None
            _take_over(path, owner)
        else:
            with os.fdopen(descriptor, "w") as file:
                json.dump(_myself(), file)
            return lambda: path.unlink(missing_ok=True)
    raise InUse("another process that came at the same time")


def _take_over(path: Path, dead: Owner) -> None:
    """Removes the file of a dead process, unless another one has just done that and holds the lock."""
    aside = path.with_name(f"{path.name}.{os.getpid()}")
    with contextlib.suppress(FileNotFoundError):
        path.rename(aside)
        owner = _read(aside)
        if owner != dead:
            aside.rename(path)
            raise InUse(_in_words(owner or {}))
        aside.unlink()


def _read(path: Path) -> Owner | None:
    """What a file of :func:`_create` says; ``None`` if it is just being written, or something else."""
    try:
        with open_file(path) as file:
            return _parse(file.read(_LARGEST)) or None
    except (OSError, RunFileError):
        return None


def _parse(content: bytes | None) -> Owner:
    try:
        owner = json.loads(content or b"")
    except (ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _myself() -> Owner:
    return {"host": socket.gethostname(), "pid": os.getpid(), "started": _started(os.getpid())}


def _has_died(owner: Owner) -> bool:
    """Whether a process of this machine has ended. Nothing is known about other machines, or on Windows."""
    pid = owner.get("pid")
    if owner.get("host") != socket.gethostname() or os.name != "posix" or not isinstance(pid, int) or pid <= 0:
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return True
    except PermissionError:
        pass  # it is another user's
    return _started(pid) != owner.get("started")  # the number may have been given anew


def _started(pid: int) -> int | None:
    """When a process began, in ticks since the machine did; ``None`` where that can't be read."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
    except (OSError, ValueError, IndexError):
        return None


def _in_words(owner: Owner) -> str:
    if not {"pid", "host"} <= owner.keys():
        return "another process"
    return f"process {owner['pid']} on {owner['host']}"
