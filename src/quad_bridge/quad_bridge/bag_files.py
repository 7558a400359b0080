"""Which files of a bag hold its messages, with or without metadata.yaml. Opens none of them."""

from __future__ import annotations

import re
from pathlib import Path

from quad_bridge.errors import BadInputError

PACKED = '.zstd'
"""Ending of a file that is compressed as a whole."""


def storage_files(bag: Path) -> list[Path]:
    """Storage files of a bag directory in the order of recording, or the one file given.

    A packed file counts where it does not lie beside its content. Raises BadInputError where
    there is none.
    """
    if not bag.exists():
        raise BadInputError(str(bag), 'does not exist', remedy='check the path')
    found = {p.name: p for p in (bag.iterdir() if bag.is_dir() else [bag])}
    files = [
        file
        for name, file in found.items()
        if name.removesuffix(PACKED).endswith(('.mcap', '.db3'))
        and (not name.endswith(PACKED) or name.removesuffix(PACKED) not in found)
    ]
    files.sort(key=lambda p: (len(p.name), p.name))
    if not files:
        raise BadInputError(str(bag), 'holds no .mcap or .db3 file', remedy='check the path')
    return files


def is_sqlite(file: Path) -> bool:
    """Whether its name says sqlite3; else it is mcap."""
    return file.name.removesuffix(PACKED).endswith('.db3')


def missing_parts(files: list[Path]) -> list[str]:
    """A line for each part of a split bag, numbered by the recorder, that is not there."""
    stems = [file.name.partition('.')[0] for file in files]
    numbers = [int(m[1]) for m in (re.search(r'_(\d+)$', stem) for stem in stems) if m]
    if len(numbers) != len(files) or min(numbers) > 0 or max(numbers) > 10_000:
        return []
    absent = sorted(set(range(max(numbers))) - set(numbers))
    return [f'part {number} of the bag is missing' for number in absent]
