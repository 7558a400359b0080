"""`quad-sysid fleet`: arguments and wiring only."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from quad_sysid.arguments import NOT_ANSWERED, Commands, command, quiet_and_json
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.progress import progress


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'fleet', _run,
        'Identify every bag below a folder on all cores or a Dask cluster: one row per bag in a '
        'Parquet table, and a page about the fleet. Called again, it continues.',
        'quad-sysid fleet flights/ --out fleet/',
    )
    parser.add_argument('folder', metavar='FOLDER', type=Path,
                        help='bags, best in one folder per aircraft')
    parser.add_argument('--out', metavar='DIR', type=Path, help='default: FOLDER_fleet here')
    parser.add_argument('--axis', choices=[*AXES, 'all'],
                        help='default: the axes that each bag says were excited')
    parser.add_argument('--scheduler', metavar='ADDRESS', default='',
                        help='of a Dask cluster, such as tcp://host:8786, that sees the same '
                        'paths (default: processes of this machine)')
    parser.add_argument('--workers', metavar='N', type=int, default=0,
                        help='processes (default: one per core)')
    parser.add_argument('--no-effects', action='store_true', help='fit the models only')
    parser.add_argument('--reports', action='store_true',
                        help='keep report.json and model.json of every bag')
    parser.add_argument('--again', action='store_true', help='try failed bags again')
    quiet_and_json(parser, 'the rows')


def _run(options: argparse.Namespace) -> int:
    from quad_sysid.fleet import page
    from quad_sysid.fleet.row import ANSWERED
    from quad_sysid.fleet.run import TABLE, Request, run, write_table
    from quad_sysid.fleet.summary import summarise

    out = options.out or Path(f'{options.folder.resolve().name}_fleet')
    if options.workers < 0:
        raise BadInputError('--workers', 'must not be negative', options.workers)
    axes = AXES if options.axis == 'all' else (options.axis,) if options.axis else ()
    rows = run(
        Request(options.folder, out, axes, not options.no_effects, options.scheduler,
                options.workers, options.reports, options.again),
        progress(quiet=options.quiet),
    )
    summary = summarise(rows)
    write_table(rows, out / TABLE)
    (out / 'fleet.html').write_text(page.page(summary, rows, options.folder.resolve().name),
                                    encoding='utf-8')
    if options.json:
        print(json.dumps(rows, indent=1))
    elif not options.quiet:
        print('\n'.join(page.lines(summary)))
        print(f'\ntable in {out / TABLE}, page in {out / "fleet.html"}')
    if not any(row['status'] == ANSWERED for row in rows):
        print(f'quad-sysid: {options.folder}: no bag could be answered; the reasons are in '
              f'{out / "fleet.html"}', file=sys.stderr)
        return NOT_ANSWERED
    return 0
