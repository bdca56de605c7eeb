"""Archives of the results of runs: settings and measurements without weights, in one file that can be kept."""

from __future__ import annotations

import lzma
import tarfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from hdrqn_torchrl.runs.persistence import layout

LARGEST_ARCHIVE = 256 << 20
"""Bytes, unpacked; a hundred times what all studies take."""


class _Bounded:
    """A compressed file whose reading fails once it yields more than any report keeps."""

    def __init__(self, path: Path) -> None:
        self._file, self._left = lzma.open(path), LARGEST_ARCHIVE  # noqa: SIM115  (it goes with this object)

    def read(self, size: int) -> bytes:
        """The next bytes."""
        content = self._file.read(min(size, self._left + 1))
        self._left -= len(content)
        if self._left < 0:
            raise ValueError(f"it holds more than {LARGEST_ARCHIVE:,} bytes")
        return content


def unpack(archive: Path, folder: Path) -> None:
    """Unpacks the files that :func:`keep` puts into an archive, and refuses one that holds anything else."""
    with tarfile.open(fileobj=_Bounded(archive), mode="r|") as members:  # type: ignore[call-overload]
        for member in members:
            place = PurePosixPath(member.name)
            if member.isdir() and not place.is_absolute() and ".." not in place.parts:
                continue
            kept = any(
                place.match(f"*/{pattern}") and len(place.parts) == len(Path(pattern).parts) + 1
                for pattern in layout.KEPT
            )
            if not member.isreg() or not kept or place.is_absolute() or ".." in place.parts:
                raise ValueError(f"{member.name} must be a file of a run, such as 000/metrics.csv")
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            content = members.extractfile(member)
            assert content is not None
            (folder / place).write_bytes(content.read())


def keep(folders: Sequence[Path], archive: Path) -> None:
    """Writes an archive that this program reads in place of the run folders.

    Args:
        folders: of the runs, in the order in which the archive has them: the same runs give the same bytes.
        archive: the file to write.
    """

    def undated(member: tarfile.TarInfo) -> tarfile.TarInfo:
        member.mtime, member.uid, member.gid, member.uname, member.gname = 0, 0, 0, "", ""
        return member

    archive.parent.mkdir(parents=True, exist_ok=True)
    partial = archive.with_name(archive.name + ".partial")
    with tarfile.open(partial, "w:xz") as file:
        for number, folder in enumerate(folders):
            for path in sorted(path for pattern in layout.KEPT for path in folder.glob(pattern)):
                file.add(path, f"{number:03d}/{path.relative_to(folder)}", filter=undated)
    partial.replace(archive)
