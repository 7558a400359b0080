"""Disk space for bags: what is free, and what is reserved. No formats here."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path
from typing import IO

MB = 1_000_000


def free_bytes(folder: Path) -> int:
    """Free bytes at the nearest existing folder. Raises OSError."""
    while not folder.exists():
        folder = folder.parent
    state = os.statvfs(folder)
    return state.f_bavail * state.f_frsize


def reserved(folder: Path, size: int) -> IO[bytes]:
    """A file without a name that holds `size` bytes of the disk (0: none) until it is closed.

    Raises OSError where the disk has fewer.
    """
    file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115  (lives on)
    try:
        if size > 0:
            os.posix_fallocate(file.fileno(), 0, size)
    except OSError:
        file.close()
        raise
    return file


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
