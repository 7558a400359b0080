"""Lines of a CSV file → columns of numbers, with the line number in every complaint.

Pure: lines in, arrays out. Opening files is the importer's business.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError

DELIMITERS = (',', ';', '\t')


@dataclass(frozen=True)
class Table:
    """Columns (n,) by name, as they stand in the file, and where they stood."""

    source: str
    columns: Mapping[str, FloatArray]
    lines: tuple[int, ...]
    """(n,) line number of each row, counted from 1."""

    def complain(self, row: int, column: str, what: str, remedy: str) -> BadInputError:
        """Build the error that names file, line and column."""
        return BadInputError(
            f'{self.source}, line {self.lines[row]}, column {column}', what,
            f'{self.columns[column][row]:.10g}', remedy,
        )


def read_table(lines: Iterable[str], source: str, wanted: Sequence[str]) -> Table:
    """Columns `wanted` of a table with a header line; `#` starts a comment line.

    Raises BadInputError for a missing column, text or nothing where a number should be, NaN, and
    a time to start with (the first of `wanted`) that does not increase.
    """
    numbered = (
        (number, line) for number, line in enumerate(lines, 1)
        if line.strip() and not line.startswith('#')
    )
    head = next(islice(numbered, 1), None)
    if head is None:
        raise BadInputError(source, 'is empty', remedy='give a CSV file with a header line')
    delimiter = max(DELIMITERS, key=head[1].count)
    names = next(csv.reader([head[1]], delimiter=delimiter))
    header = [name.strip() for name in names]
    absent = [name for name in wanted if name not in header]
    if absent:
        raise BadInputError(
            source, f'no column {", ".join(absent)} in line {head[0]}', ', '.join(header),
            'name a column of the header',
        )
    places = [header.index(name) for name in wanted]
    rows: list[list[float]] = []
    kept: list[int] = []
    for number, line in numbered:
        cells = next(csv.reader([line], delimiter=delimiter))
        rows.append(_numbers(cells, places, wanted, source, number))
        kept.append(number)
    if not rows:
        raise BadInputError(source, 'has a header but no rows', remedy='give recorded data')
    array = np.array(rows)
    columns = {name: array[:, i].copy() for i, name in enumerate(wanted)}
    table = Table(source, columns, tuple(kept))
    back = np.flatnonzero(np.diff(columns[wanted[0]]) <= 0.0)
    if len(back):
        raise table.complain(
            int(back[0]) + 1, wanted[0],
            f'time does not increase after {columns[wanted[0]][back[0]]:.10g}',
            'sort the rows, or leave repeated ones out',
        )
    return table


def _numbers(
    cells: Sequence[str], places: Sequence[int], wanted: Sequence[str], source: str, number: int
) -> list[float]:
    """Finite numbers at `places` of one row."""
    out = []
    for place, name in zip(places, wanted, strict=True):
        text = cells[place].strip() if place < len(cells) else ''
        try:
            value = float(text)
        except ValueError:
            value = float('nan')
        if not np.isfinite(value):
            raise BadInputError(
                f'{source}, line {number}, column {name}', 'needs a finite number', repr(text),
                'mend the row, or leave it out (a gap is allowed)',
            )
        out.append(value)
    return out
