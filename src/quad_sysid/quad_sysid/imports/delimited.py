"""A text with columns (CSV and its kin) → Table. The meaning of a column is not known here.

The layout (what separates cells, which line is the header, whether a row of units follows it) is
found in the first lines; the rest is read in blocks, so that long recordings fit into memory.
Errors name the line.
"""

from __future__ import annotations

import contextlib
import csv
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from functools import lru_cache
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.imports.units import WRITTEN, header_unit, written

DELIMITERS = (',', ';', '\t')
BLOCK = 20_000
"""Rows that are converted at once."""
WORDS: Mapping[str, float] = {
    **dict.fromkeys(('', '-', 'na', 'n/a', 'nan', 'nat', 'none', 'null', 'inf', '-inf', '+inf'),
                    math.nan), 'true': 1.0, 'false': 0.0,
}
"""Cells that are no numbers and yet have a meaning, in small letters: most say that none is
known, and what is infinite is not known either."""
MOMENT = re.compile(
    r'^(?:(?P<date>\d{4}[-/]\d{1,2}[-/]\d{1,2}|\d{1,2}[./]\d{1,2}[./]\d{4})[T ]*)?'
    r'(?:(?P<hour>\d{1,2}):(?P<minute>\d\d)(?::(?P<second>\d\d(?:[.,]\d+)?))?)?'
    r' ?(?P<zone>Z|UTC|[+-]\d\d:?\d\d)?$')
"""A date, a time of day, or both (ISO 8601; also day.month.year)."""


@dataclass
class _Layout:
    """How the text is laid out."""

    split: Callable[[Iterable[str]], Iterator[list[str]]]
    names: list[str]
    header_line: int
    begin: int
    """Index of the first row among the lines that were looked at."""
    notes: list[str] = field(default_factory=list)
    aliases: dict[str, str] = field(default_factory=dict)


def read_text_table(
    lines: Iterable[str], source: str, selected: Sequence[str] | None = None, first: int = 1
) -> tuple[dict[str, FloatArray], NDArray[np.int64], tuple[str, ...], Mapping[str, str]]:
    """Columns of a text, the lines of its rows (from 1), repairs in words, other names of columns.

    It has a header line; `#` starts a comment line, an empty cell is missing.

    Cells are separated by commas, tabs, semicolons (numbers may then have decimal commas) or
    spaces. Dates and times of day become seconds. A last line without its end was cut off and is
    left out. `first` is the number of the first line; without `selected`, cells without a number
    are missing, and columns without any are left out.

    Raises BadInputError for a missing column, text where a number should be, and a column without
    any number.
    """
    text = _Lines(lines, first)
    numbered = iter(text)
    head = list(islice(numbered, 200))  # the lines that may hold the header
    if not head:
        what = 'holds no complete row' if text.notes or text.comments else 'is empty'
        raise BadInputError(source, what, remedy='record it or copy it again')
    layout = _layout(head, text.comments, source)
    where = f'{source}, line {layout.header_line}'
    names = layout.names if selected is None else [
        layout.aliases.get(name, name) for name in selected]
    absent = [name for name in names if name not in layout.names]
    if absent:
        raise no_column(where, absent, layout.names)
    places = [layout.names.index(name) for name in names]
    blocks: list[FloatArray] = []
    row_numbers: list[NDArray[np.int64]] = []
    complete = 0
    for numbers, rows in _rows(chain(head[layout.begin :], numbered), layout.split):
        complete += sum(_as_wide(cells, len(layout.names)) for cells in rows)
        blocks.append(_block(rows, numbers, places, None if selected is None else names, source))
        row_numbers.append(numbers)
    if not blocks:
        raise BadInputError(source, 'has a header but no rows', remedy='give recorded data')
    row_index = np.concatenate(row_numbers)
    columns = {}
    for i, name in enumerate(names):  # column by column, each freed in its block
        columns[name] = np.concatenate([block[i] for block in blocks])
    if selected is None:
        _check_table(columns, complete, row_index.size, source)
    for name in selected or ():
        if not np.isfinite(columns[layout.aliases.get(name, name)]).any():
            raise BadInputError(f'{source}, line {row_index[0]}, column {name}', 'holds no number')
    return ({n: c for n, c in columns.items() if np.isfinite(c).any()}, row_index,
            (*layout.notes, *text.notes), layout.aliases)


def no_column(where: str, absent: Sequence[str], names: Sequence[str]) -> BadInputError:
    """The error for columns that are absent among `names`, or that are there more than once."""
    several = [name for name in absent if f'{name}[0]' in names]
    if several:
        numbered = [n for n in names if n.rpartition('[')[0] in several]
        return BadInputError(where, f'several columns {", ".join(several)}', ', '.join(numbered),
                             'name each by its number')
    return BadInputError(where, f'no column {", ".join(absent)}', ', '.join(names),
                         'name a column of the file')


@dataclass
class _Lines:
    """Lines with their numbers, without comments and without a last one that was cut off."""

    lines: Iterable[str]
    first: int
    notes: tuple[str, ...] = ()
    comments: list[tuple[int, str]] = field(default_factory=list)
    """Those before the first row; the last may be the header."""

    def __iter__(self) -> Iterator[tuple[int, str]]:
        started = False
        for number, line in enumerate(self.lines, self.first):
            if not line.endswith('\n'):
                why = 'has no end: it may be cut off and is left out'
                self.notes = (f'line {number}, the last, {why}',)
            elif line.startswith('#'):
                if not started:
                    self.comments.append((number, line.lstrip('# \t')))
            elif line.strip():
                started = True
                yield number, line


def _layout(
    head: Sequence[tuple[int, str]], comments: Sequence[tuple[int, str]], source: str
) -> _Layout:
    """The header: the first line of names with a row of as many cells, mostly numbers, behind it.

    A row of units may lie between. Without such a line, the first one.
    """
    if _is_row(cells := _split_one(head[0][1])) and any(map(_is_number, cells)):
        if comments and len(_split_one(comments[-1][1])) == len(cells):
            layout = _named([comments[-1], *head], 0)
            layout.begin -= 1  # among the lines that are no comments
            return layout
        if all(_is_number(cell) or not cell for cell in cells):
            raise BadInputError(f'{source}, line {head[0][0]}',
                                "holds numbers, not the columns' names",
                                remedy='put a header line before it')
    for i in range(len(head) - 1):
        cells = _split_one(head[i][1])
        if len(cells) < 2 or any(map(_is_number, cells)):
            continue
        for rows in (1, 2):
            if i + rows < len(head):
                row = next(_splitter(head[i][1])([head[i + rows][1]]))
                if _as_wide(row, len(cells)) and _is_row(row):
                    return _named(head, i)
    return _named(head, 0)


def _named(head: Sequence[tuple[int, str]], header: int) -> _Layout:
    """The layout with the names of the columns, each once."""
    number, line = head[header]
    split = _splitter(line)
    names = [name.strip() for name in next(split([line]))]
    while names and not names[-1]:
        names.pop()
    layout = _Layout(split, [name or f'column {i + 1}' for i, name in enumerate(names)],
                     number, header + 1)
    if header and number > head[0][0]:
        layout.notes.append(f'lines before the header, left out: {header}')
    _number_repeated(layout)
    units = next(split([head[header + 1][1]]), []) if header + 1 < len(head) else []
    if (_as_wide(units, len(names)) and header + 2 < len(head) and not _is_row(units)
            and _is_row(next(split([head[header + 2][1]])))
            and any(written(unit.strip(' ()[]')) in WRITTEN.values() for unit in units)):
        layout.begin += 1
        layout.notes.append(f'line {head[header + 1][0]} holds units, not numbers')
        for i, unit in enumerate(units[: len(names)]):
            bare = unit.strip(' ()[]')
            if written(bare) in WRITTEN.values() and header_unit(layout.names[i]) is None:
                layout.aliases[layout.names[i]] = f'{layout.names[i]} [{bare}]'
                layout.names[i] = f'{layout.names[i]} [{bare}]'
    return layout


def _number_repeated(layout: _Layout) -> None:
    """Give columns of one name numbers in brackets, which it says."""
    count = {name: layout.names.count(name) for name in dict.fromkeys(layout.names)}
    for name, times in count.items():
        if times == 1:
            continue
        places = [i for i, other in enumerate(layout.names) if other == name]
        new_names = [f'{name}[{k}]' for k in range(times)]
        if set(new_names) & set(layout.names):
            new_names = [f'{name} #{k + 1}' for k in range(times)]
        for place, new in zip(places, new_names, strict=True):
            layout.names[place] = new
        layout.notes.append(f'{times} columns are called {name}: they are named '
                            f'{", ".join(new_names)} in their order')


def _splitter(header: str) -> Callable[[Iterable[str]], Iterator[list[str]]]:
    """What takes lines apart, by what separates the header's cells."""
    delimiter = max(DELIMITERS, key=header.count)
    if delimiter not in header:
        return lambda lines: (line.split() for line in lines)
    if delimiter != ';':
        return lambda lines: csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    return lambda lines: ([cell.replace(',', '.') for cell in cells]
                          for cells in csv.reader(lines, delimiter=';', skipinitialspace=True))


def _split_one(line: str) -> list[str]:
    return [cell.strip() for cell in next(_splitter(line)([line]))]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return bool(cell) and MOMENT.match(cell.strip()) is not None
    return True


def _is_row(cells: Sequence[str]) -> bool:
    """Whether at least half of the cells that hold something hold a number."""
    values = [cell.strip() for cell in cells if cell.strip().lower() not in WORDS]
    numbers = sum(map(_is_number, values))
    return numbers > 0 and 2 * numbers >= len(values)


def _as_wide(cells: Sequence[str], width: int) -> bool:
    """Whether a row has one cell for each of the header's; an empty one may end it."""
    return len(cells) == width or (len(cells) == width + 1 and not cells[-1].strip())


def _rows(
    numbered: Iterator[tuple[int, str]], split: Callable[[Iterable[str]], Iterator[list[str]]]
) -> Iterator[tuple[NDArray[np.int64], list[list[str]]]]:
    while part := list(islice(numbered, BLOCK)):
        numbers = np.array([number for number, _ in part])
        yield numbers, list(split(line for _, line in part))


def _block(rows: Sequence[Sequence[str]], numbers: NDArray[np.int64], places: Sequence[int],
           named: Sequence[str] | None, source: str) -> FloatArray:
    """(k, n) the numbers at `places` of n rows; text in a column that was named is an error."""
    out = np.full((len(places), len(rows)), np.nan)
    last = max(places)
    even = min(map(len, rows)) > last
    columns = list(zip(*rows, strict=False)) if even else []
    for i, place in enumerate(places):
        cells = columns[place] if even else [
            row[place] if place < len(row) else '' for row in rows]
        try:
            out[i] = np.fromiter(map(float, cells), np.float64, len(rows))
        except ValueError:
            out[i] = [_number(cell) for cell in cells]
            if named is not None:
                _refuse_text(cells, out[i], numbers, named[i], source)
    out[~np.isfinite(out)] = np.nan
    return out


def _number(cell: str) -> float:
    """The number in a cell; seconds where it holds a date or a time; NaN without either."""
    text = cell.strip()
    try:
        return float(text)
    except ValueError:
        pass
    number = WORDS.get(text.lower())
    if number is not None:
        return number
    moment = MOMENT.match(text)
    if moment is None or not (moment['date'] or moment['hour']):
        return math.nan
    seconds = _day(moment['date']) if moment['date'] else 0.0
    if moment['hour']:
        seconds += 3600.0 * float(moment['hour']) + 60.0 * float(moment['minute'])
        seconds += float((moment['second'] or '0').replace(',', '.'))
    zone = moment['zone']
    if zone and zone not in ('Z', 'UTC'):
        sign = -1.0 if zone[0] == '-' else 1.0
        seconds -= sign * (3600.0 * float(zone[1:3]) + 60.0 * float(zone[-2:]))
    return seconds


@lru_cache(maxsize=64)
def _day(text: str) -> float:
    """Seconds from 1970 to the begin of a day; NaN of none that there is."""
    parts = [int(part) for part in re.split(r'[-/.]', text)]
    year, first, second = parts if parts[0] > 31 else parts[::-1]
    for month, day in ((first, second), (second, first)):
        with contextlib.suppress(ValueError):
            return 86_400.0 * (date(year, month, day).toordinal() - date(1970, 1, 1).toordinal())
    return math.nan


def _refuse_text(
    cells: Sequence[str], values: FloatArray, numbers: NDArray[np.int64], name: str, source: str
) -> None:
    for k in np.flatnonzero(np.isnan(values)).tolist():
        text = cells[k].strip()
        if text.lower() not in WORDS:
            raise BadInputError(
                f'{source}, line {numbers[k]}, column {name}', 'needs a number or nothing',
                repr(text), 'mend the row, or leave it out (a gap is allowed)')


def _check_table(columns: Mapping[str, FloatArray], whole: int, n: int, source: str) -> None:
    """Raise BadInputError for a text that is no table: few rows (n) are as wide as its header.

    `whole` of them are; a row without any number is none of a recording either.
    """
    numbers = int(np.any([np.isfinite(values) for values in columns.values()], axis=0).sum())
    if 2 * whole <= n:
        raise BadInputError(source, "is not a table: most lines have not the header's columns",
                            f'{whole} of {n} lines with {len(columns)}', 'give a CSV file')
    if 2 * numbers <= n:
        raise BadInputError(source, 'is not a table of numbers: most lines hold none',
                            f'{numbers} of {n} lines with a number', 'give a CSV file')
