"""The rows as tables: CSV, and where pyarrow is installed Parquet, a folder for each aircraft."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

from quad_sysid.axes import EVERY
from quad_sysid.fleets.bag import OF_AXIS, Row
from quad_sysid.fleets.place import Place

CSV, PARQUET = 'fleet.csv', 'fleet.parquet'
UNNAMED = '-'
"""Folder of the flights of no aircraft; a partition without a value is one that pandas refuses."""
ESCAPED = {*map(chr, range(32)), *'"#%\'*/:=?\\{[]^\x7f'}
"""What Hive, and so Spark, escapes in the name of a partition; a letter of any script is none."""
COLUMNS = ('bag', 'aircraft', 'status', 'reason', 'start_ns', 'length_s', 'sample_rate_hz',
           'warnings', 'seconds', 'cpu_s', 'peak_mb', 'bytes',
           *(f'{axis}_{name}' for axis in EVERY for name in OF_AXIS))
TEXT = ('bag', 'aircraft', 'status', 'reason', *(
    f'{axis}_{name}' for axis in EVERY
    for name in ('verdict', 'effects', 'effect_parameters', 'gains')))
WHOLE = ('start_ns', 'warnings', 'bytes')


def write(rows: Sequence[Row], out: Place) -> list[str]:
    """Write all rows with fixed columns, empty where there is no value; names of the tables."""
    text = io.StringIO()
    table = csv.DictWriter(text, COLUMNS, extrasaction='ignore', lineterminator='\n')
    table.writeheader()
    table.writerows(rows)
    out.write(CSV, text.getvalue())
    try:
        import pyarrow as pa
    except ImportError:
        return [CSV]
    out.remove(PARQUET, whole=True)
    by_aircraft: dict[str, list[Row]] = {}
    for row in rows:
        by_aircraft.setdefault(row['aircraft'], []).append(row)
    for aircraft, some in by_aircraft.items():
        folder = ''.join(f'%{ord(c):02X}' if c in ESCAPED or aircraft == UNNAMED else c
                         for c in aircraft) or UNNAMED
        out.write(f'{PARQUET}/craft={folder}/rows.parquet', _parquet(some, pa))
    return [CSV, PARQUET]


def _parquet(rows: Sequence[Row], pa: Any) -> bytes:
    """One aircraft's rows; types are the same in every file.

    Its name stands in them too: readers take the folder of an aircraft 007 for the number 7.
    """
    from pyarrow import parquet

    kinds = {True: pa.string(), False: pa.float64()}
    schema = pa.schema([
        (name, pa.int64() if name in WHOLE else kinds[name in TEXT])
        for name in COLUMNS])
    content = {name: [row.get(name) for row in rows] for name in schema.names}
    sink = pa.BufferOutputStream()
    parquet.write_table(pa.table(content, schema=schema), sink)
    return bytes(sink.getvalue().to_pybytes())
