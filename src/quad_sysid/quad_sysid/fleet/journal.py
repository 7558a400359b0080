"""Rows on disk: a journal that grows line by line, and the Parquet table made of it.

A line is written when its bag is done, so a run that is killed goes on where it stood.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

from quad_sysid.errors import BadInputError
from quad_sysid.fleet.row import REAL, TEXT, WHOLE, Row

JOURNAL = 'rows.jsonl'
TABLE = 'fleet.parquet'


class Journal:
    """The journal in a folder; the last line of a bag counts."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / JOURNAL
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInputError('--out', f'{folder} cannot be made', error.strerror) from error

    def rows(self) -> dict[str, Row]:
        """Rows by bag; a line that a kill cut off is left out."""
        found: dict[str, Row] = {}
        try:
            text = self._path.read_text(encoding='utf-8')
        except FileNotFoundError:
            return found
        for row in map(_row, text.splitlines()):
            if row is not None:
                found[row['bag']] = row
        return found

    def add(self, row: Row) -> None:
        """Append one row and have the disk keep it."""
        line = json.dumps(row) + '\n'
        with self._path.open('a+b') as stream:
            if stream.tell() and not _ends_whole(self._path):
                stream.write(b'\n')
            stream.write(line.encode())
            stream.flush()
            os.fsync(stream.fileno())


def _row(line: str) -> Row | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return row if isinstance(row, dict) and 'bag' in row else None


def _ends_whole(path: Path) -> bool:
    with path.open('rb') as stream:
        stream.seek(-1, os.SEEK_END)
        return stream.read(1) == b'\n'


def write_table(rows: Sequence[Row], path: Path) -> Path:
    """Write rows as Parquet with fixed columns and types; needs pyarrow."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise BadInputError(str(path), 'needs the package pyarrow',
                            remedy='pip install pyarrow') from error
    schema = pa.schema([
        *((name, pa.string()) for name in TEXT), *((name, pa.int64()) for name in WHOLE),
        *((name, pa.float64()) for name in REAL),
    ])
    content = {name: [row.get(name) for row in rows] for name in schema.names}
    part = path.with_name(f'.{path.name}.part')
    try:
        parquet.write_table(pa.table(content, schema=schema), part)
        part.replace(path)
    except OSError as error:
        raise BadInputError(str(path), 'cannot be written', error.strerror) from error
    return path
