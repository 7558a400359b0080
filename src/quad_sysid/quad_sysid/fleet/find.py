"""Which bags lie below a folder: rosbag2 directories and bare .mcap files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from quad_sysid.errors import BadInputError

STORAGE = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')


def bags(folder: Path) -> list[Path]:
    """Sorted; a folder with storage files in it and metadata.yaml, or a torn bag, is one bag.

    Raises BadInputError where there is no such folder or no bag in it.
    """
    if not folder.is_dir():
        raise BadInputError(str(folder), 'is no folder', remedy='give the one that holds the bags')
    found = sorted(_below(folder))
    if not found:
        raise BadInputError(str(folder), 'holds no bag (a rosbag2 folder or an .mcap file)',
                            remedy='check the path')
    return found


def _below(folder: Path) -> Iterator[Path]:
    for root, folders, files in os.walk(folder):
        here = Path(root)
        folders.sort()
        stored = [name for name in files if name.endswith(STORAGE)]
        if 'metadata.yaml' in files or any(_named_after(name, here) for name in stored):
            folders.clear()
            yield here
        else:
            yield from (here / name for name in stored if name.endswith('.mcap'))


def _named_after(name: str, folder: Path) -> bool:
    """Whether a storage file is that of a bag in `folder`, as recorders name them: folder_0."""
    return name.startswith(f'{folder.name}_')


def fingerprint(bag: Path) -> str:
    """Size and latest change of a bag's files."""
    files = [bag] if bag.is_file() else [p for p in bag.iterdir() if p.is_file()]
    stats = [p.stat() for p in files]
    return f'{sum(s.st_size for s in stats)}-{max((s.st_mtime_ns for s in stats), default=0)}'
