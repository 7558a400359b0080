"""`quad-sysid fleet`: arguments and wiring, and the rows as tables.

Tables are CSV, and where pyarrow is installed Parquet, a folder for each aircraft.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import os
import sys
from collections.abc import Callable, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from quad_sysid import arguments
from quad_sysid.arguments import Commands
from quad_sysid.axes import EVERY
from quad_sysid.errors import BadInputError
from quad_sysid.files import check_place, escaped, make_folder
from quad_sysid.fleets.bag import ANSWERED, LIMIT_S, OF_AXIS, Row, fits, jobs
from quad_sysid.fleets.place import Place

PAGE, LOG = 'fleet.html', 'fleet.log'
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
        out.write(f'{PARQUET}/craft={fits(folder)}/rows.parquet', _parquet(some, pa))
    return [CSV, PARQUET]


def _parquet(rows: Sequence[Row], pa: Any) -> bytes:
    """One aircraft's rows; types are the same in every file.

    Its name stands in them too: readers take the folder of an aircraft 007 for the number 7.
    """
    from pyarrow import parquet

    schema = pa.schema([
        (name, pa.int64() if name in WHOLE else pa.string() if name in TEXT else pa.float64())
        for name in COLUMNS])
    content = {name: [row.get(name) for row in rows] for name in schema.names}
    sink = pa.BufferOutputStream()
    parquet.write_table(pa.table(content, schema=schema), sink)
    return bytes(sink.getvalue().to_pybytes())


def add(commands: Commands) -> None:
    """Register the command."""
    parser = arguments.command(
        commands, 'fleet', _run,
        'Identify every bag and log below a folder: one row per bag in a table, and one page that '
        'says what the aircraft lack, what drifts, and which flights are odd. Called again, it '
        'continues.',
        'quad-sysid fleet flights/ --out fleet/',
    )
    parser.add_argument('folder', metavar='FOLDER', help='bags and logs, best in one folder per '
                        'aircraft; a path, or an address such as s3://bucket/flights')
    parser.add_argument('--out', metavar='DIR', help='results, path or address (default: '
                        'FOLDER_fleet here)')
    parser.add_argument('--axis', metavar='AXES', default='', help='as of identify, such as '
                        'roll,pitch or all (default: the axes that each bag says were excited)')
    parser.add_argument('--workers', metavar='N', type=int, default=os.cpu_count() or 1,
                        help='bags at a time on this machine (default: one per core)')
    parser.add_argument('--cluster', metavar='ADDRESS|FILE', default='',
                        help='a Dask scheduler (tcp://host:8786), its file, or local, for one of '
                        'this machine')
    parser.add_argument('--shard', metavar='i/n', default='',
                        help='part i of n of the bags, for a queue of jobs; --merge follows')
    parser.add_argument('--merge', action='store_true',
                        help='identify nothing: table and page of the results that are there')
    parser.add_argument('--plan', action='store_true',
                        help='identify ten bags and say what all would cost')
    parser.add_argument('--limit', metavar='S', type=float, default=LIMIT_S,
                        help='longest time for a bag, s (default %(default)g)')
    parser.add_argument('--since', metavar='DAY', default='', help='text and page of flights from '
                        'this day on: 2026-05-31, or 90d for the last 90 days')
    parser.add_argument('--group-by', choices=('aircraft', 'folder', 'none'), default='aircraft',
                        help='what is one aircraft: the first folder below FOLDER (default), the '
                        'whole folder of a bag, or all flights')
    parser.add_argument('--no-effects', action='store_true', help='fit the models only')
    arguments.effects_option(parser)
    arguments.quiet_and_json(parser, 'the rows')


def _run(options: argparse.Namespace) -> int:
    from quad_sysid.fleets.engine import known, run, shard_of
    from quad_sysid.fleets.page import Fleet
    from quad_sysid.session import keywords

    name = options.folder.rstrip('/').rpartition('/')[2] if '://' in options.folder else (
        escaped(Path(options.folder).resolve().name))
    out = Place(options.out or f'{name}_fleet')
    if options.workers < 1:
        raise BadInputError('--workers', 'must be at least 1', options.workers)
    if out.store is None:
        check_place(out.path)
    Fleet([], options.group_by, options.since)  # refused before the work
    axes = keywords(options.axis.split(',') if options.axis else ())['axes']
    arguments.own_effects(options.effects)
    text = Path(options.effects).read_text(encoding='utf-8') if options.effects else ''
    limit_s = arguments.positive('--limit', options.limit)
    every = jobs(options.folder, out.address, axes=axes, effects=text, limit_s=limit_s,
                 search_effects=not options.no_effects)
    if options.shard:
        every = shard_of(every, options.shard)
    if options.merge:
        stored = known(every)
        rows = [stored[job.name] for job in every if job.name in stored]
    else:
        rows = run(every, options.workers, options.cluster, sample=options.plan,
                   show=arguments.progress(quiet=options.quiet),
                   log=_log(out, name, options, options.plan))
    fleet = Fleet(rows, options.group_by, options.since, name)
    partial = bool(options.shard or options.plan)
    files = [] if partial else write(rows, out)
    if not partial:
        out.write(PAGE, fleet.page())
        files.append(PAGE)
    if options.json:
        print(json.dumps(rows, indent=1))
    elif not options.quiet and not options.plan:
        print(fleet)
        if len(rows) < len(every):
            print(f'\n{len(every) - len(rows)} bags are not done yet')
        print('\n' + (f'{", ".join(files)} in {out.address}' if files else
                      f'rows in {out.address}/rows; --merge makes the table of all'))
    if every and not any(row['status'] == ANSWERED for row in rows):
        print(f'quad-sysid: {options.folder}: no bag could be answered; the reasons are in '
              f'{out.address}/{CSV if files else "rows"}', file=sys.stderr)
        return arguments.NOT_ANSWERED
    return 0


def _log(out: Place, name: str, options: argparse.Namespace, echo: bool
         ) -> Callable[[str], None]:
    """What appends lines to the log: among the results, or here where these are on a store."""
    path = make_folder(out.path) / LOG if out.store is None else Path(f'{name}_{LOG}')
    part = f'{options.shard} ' if options.shard else ''

    def log(line: str) -> None:
        stamp = datetime.now(timezone.utc).strftime('%Y-%m-%dT%H:%M:%SZ')
        with path.open('a', encoding='utf-8') as stream:
            stream.write(escaped(f'{stamp} {part}{line}\n'))
        if echo and not line.startswith('bag ') and not (options.quiet or options.json):
            print(line)

    return log
