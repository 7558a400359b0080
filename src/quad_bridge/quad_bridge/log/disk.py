"""Disk space for bags: free space, and a reserve for the flight. No formats here."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

MB = 1_000_000


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
