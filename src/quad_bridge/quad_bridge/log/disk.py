"""Disk space for bags: free space, a reserve for the flight, deletion of old bags.

Knows paths and bytes, no formats. A bag is a directory, closed once it holds metadata.yaml.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from quad_bridge.errors import BadInputError

MB = 1_000_000
METADATA = 'metadata.yaml'
"""The file that marks a folder as a closed bag."""
DOOMED = '.deleting'
"""Suffix of a bag that is being deleted."""
CLOCK_SET_S = 1_577_836_800
"""2020; an earlier time comes from a computer without a clock and gives no age."""


def free_bytes(folder: Path) -> int:
    """Free bytes at the nearest existing folder. Raises OSError."""
    while not folder.exists():
        folder = folder.parent
    told = os.statvfs(folder)
    return told.f_bavail * told.f_frsize


class Reserve:
    """Reserved disk space: an unnamed file, which ends with the process.

    `give` frees as much as the bag has grown, so that bag and reserve together stay constant;
    `release` frees the rest.
    """

    def __init__(self, folder: Path, size: int) -> None:
        """Reserve `size` bytes (0: none). Raises OSError where the disk has fewer."""
        self._size = self._left = size
        self._file = None
        if size <= 0:
            return
        file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115  (lives on)
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError:
            file.close()
            raise
        self._file = file

    def give(self, used: int) -> None:
        """Shrink the reserve to its size less `used`: bytes of the bag and its next write."""
        self._shrink(min(self._left, self._size - used))

    def more(self, size: int) -> bool:
        """Shrink by `size` more, where others took the freed space; False if nothing is left."""
        if self._file is None or self._left <= 0:
            return False
        self._size -= size
        self._shrink(self._left - size)
        return True

    def _shrink(self, left: int) -> None:
        if self._file is not None:
            self._left = max(left, 0)
            self._file.truncate(self._left)

    def release(self) -> None:
        """Free the whole reserve; a second call does nothing."""
        file, self._file = self._file, None
        if file is not None:
            file.close()


@dataclass(frozen=True)
class Budget:
    """Largest total size of the bags in one folder."""

    folder: Path
    prefix: str
    limit: int = 0
    """Bytes; 0: no limit."""
    delete_oldest: bool = False
    """Whether closed bags may be deleted, the oldest first, to stay within the limit."""

    def bags(self) -> list[Path]:
        """Bags with this prefix in the folder, the first closed first."""
        if not self.folder.is_dir():
            return []
        name = re.compile(re.escape(self.prefix) + r'_\d{8}_\d{6}(_\d+)?' + f'({DOOMED})?')
        found = (p for p in self.folder.iterdir() if name.fullmatch(p.name) and p.is_dir())
        return sorted(found, key=lambda bag: (_closed_s(bag), bag.name))

    def excess(self, more: int = 0) -> int:
        """Bytes by which all bags and `more` exceed the limit; 0 or less: they do not."""
        if not self.limit:
            return -1
        return sum(map(bag_bytes, self.bags())) + more - self.limit

    def make_room(
        self, more: int, current: Path | None = None,
        refused: Callable[[Path], None] = lambda _bag: None,
    ) -> list[Path]:  # fmt: skip
        """Delete closed bags as needed and allowed; returns them.

        `refused` is called with bags that cannot be deleted; they stay complete. Never deleted are
        `current` and bags without metadata.yaml, which may be another recorder's or await
        `recover`. Raises BadInputError where the limit remains exceeded.
        """
        if self.delete_oldest:
            for left in [b for b in self.bags() if b.name.endswith(DOOMED)]:
                shutil.rmtree(left, ignore_errors=True)  # somebody was killed at it
        deleted: list[Path] = []
        closed = [b for b in self.bags() if b != current and (b / METADATA).is_file()]
        while (excess := self.excess(more)) > 0:
            if not self.delete_oldest or not closed:
                raise BadInputError(
                    str(self.folder),
                    f'bags {self.prefix}_* and the reserve exceed the disk budget',
                    f'{excess / MB:.0f} MB too much',
                    'remove bags, raise disk_budget_mb or set delete_oldest',
                )
            if _delete(oldest := closed.pop(0)):
                deleted.append(oldest)
            else:
                refused(oldest)
        return deleted


def _closed_s(bag: Path) -> float:
    """Time at which a bag was closed, s; infinity if it was not, or by an unset clock."""
    try:
        closed_s = (bag / METADATA).stat().st_mtime
    except OSError:
        return float('inf')
    return closed_s if closed_s > CLOCK_SET_S else float('inf')


def _delete(bag: Path) -> bool:
    """Delete a closed bag; False, with the bag unchanged, where that is not permitted.

    The files are first moved out, and back if one cannot be moved.
    """
    doomed = bag.with_name(bag.name + DOOMED)
    moved: list[Path] = []
    try:
        doomed.mkdir()
        for file in sorted(bag.iterdir()):
            file.rename(doomed / file.name)
            moved.append(file)
        bag.rmdir()
    except OSError:
        with contextlib.suppress(OSError):
            for file in moved:
                (doomed / file.name).rename(file)
            doomed.rmdir()
        return False
    shutil.rmtree(doomed, ignore_errors=True)
    return True


def bag_bytes(bag: Path) -> int:
    """Size of a bag's files, bytes; 0 without a bag."""
    total = 0
    for file in list(bag.iterdir()) if bag.is_dir() else []:
        with contextlib.suppress(OSError):  # gone since it was listed
            total += file.stat().st_size if file.is_file() else 0
    return total


def is_full(error: OSError) -> bool:
    """Whether a write failed because the disk is full."""
    return error.errno in {errno.ENOSPC, errno.EDQUOT}


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that new names survive a power cut. Raises OSError."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno != errno.EINVAL:  # file systems that cannot sync a folder
            raise
    finally:
        os.close(fd)
