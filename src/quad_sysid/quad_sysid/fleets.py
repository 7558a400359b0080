"""`quad-sysid fleet`: many bags, each identified in a process of its own; one row per bag.

Each bag that could be read has a folder with its report, its model and its row. The row is written
last, and a bag is done while its row is newer than its files, so that a run that is killed
continues where it stopped. A row says of which bag and with which options it is: other options are
another question, and another folder's bags need a place of their own. The mathematics is imported
by the processes alone.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid import interrupt
from quad_sysid.arguments import NOT_ANSWERED, Commands, command, progress, quiet_and_json
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError, QuadSysidError
from quad_sysid.files import check_place, make_folder, read_json, write_whole

Row = dict[str, Any]
ANSWERED, CANNOT_TELL, FAILED = 'answered', 'cannot_tell', 'failed'
STORAGE = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')
ROW, TABLE = 'row.json', 'fleet.csv'
BASE = ('gain', 'lag', 'delay', 'damping', 'bias')
"""Parameters of the base that every row holds, by axis."""
OF_AXIS = ('verdict', 'effects', 'error_before', 'error_after', 'effect_parameters', 'gains',
           *(f'{name}{end}' for name in BASE for end in ('', '_std')))
COLUMNS = ('bag', 'aircraft', 'status', 'reason', 'start_ns', 'length_s', 'sample_rate_hz',
           'warnings', 'seconds',
           *(f'{axis}_{name}' for axis in AXES for name in OF_AXIS))
LEAST_FLIGHTS = 4
"""Least number of flights among which one can be an outlier."""
OUTLYING = 3.5
"""Distance of an outlier in robust standard deviations (Iglewicz, Hoaglin 1993)."""


@dataclass(frozen=True)
class Job:
    """One bag to identify; small, as it is sent to a process."""

    bag: str
    """Path as it is given to the reader."""
    name: str
    """Path below the fleet's folder, which names it in the table."""
    aircraft: str
    """First folder below the fleet's, empty where the bag lies in it directly."""
    folder: str
    """Of its report, its model and its row."""
    axes: tuple[str, ...] = ()
    search_effects: bool = True

    @property
    def asked(self) -> Row:
        """What the row answers, kept in it."""
        return {'source': self.bag, 'axes': list(self.axes), 'effects': self.search_effects}

    @property
    def row(self) -> Path:
        """Its file."""
        return Path(self.folder, ROW)


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'fleet', _run,
        'Identify every bag below a folder on all cores: one row per bag in a table, and what the '
        'fleet has in common. Called again, it continues.',
        'quad-sysid fleet flights/ --out fleet/',
    )
    parser.add_argument('folder', metavar='FOLDER', type=Path,
                        help='bags, best in one folder per aircraft')
    parser.add_argument('--out', metavar='DIR', type=Path, help='default: FOLDER_fleet here')
    parser.add_argument('--axis', choices=[*AXES, 'all'],
                        help='default: the axes that each bag says were excited')
    parser.add_argument('--workers', metavar='N', type=int, default=os.cpu_count() or 1,
                        help='bags at a time (default: one per core)')
    parser.add_argument('--no-effects', action='store_true', help='fit the models only')
    quiet_and_json(parser, 'the rows')


def _run(options: argparse.Namespace) -> int:
    out = options.out or Path(f'{options.folder.resolve().name}_fleet')
    if options.workers < 1:
        raise BadInputError('--workers', 'must be at least 1', options.workers)
    check_place(out)
    axes = AXES if options.axis == 'all' else (options.axis,) if options.axis else ()
    every = jobs(options.folder, out, axes, search_effects=not options.no_effects)
    rows = run(every, options.workers, show=progress(quiet=options.quiet))
    make_folder(out)
    write_table(rows, out / TABLE)
    if options.json:
        print(json.dumps(rows, indent=1))
    elif not options.quiet:
        print('\n'.join([*lines(rows), '', f'table in {out / TABLE}']))
    if not any(row['status'] == ANSWERED for row in rows):
        print(f'quad-sysid: {options.folder}: no bag could be answered; the reasons are in '
              f'{out / TABLE}', file=sys.stderr)
        return NOT_ANSWERED
    return 0


def jobs(folder: Path, out: Path, axes: tuple[str, ...] = (), *,
         search_effects: bool = True) -> list[Job]:
    """Every bag below a folder, sorted, with its folder below `out`.

    Raises BadInputError where there is no such folder or no bag in it.

    A folder with storage files and metadata.yaml, or with files that are named after it as
    recorders do, is one bag; so is an .mcap file elsewhere. A folder that cannot be opened counts
    as a bag, so that its row says so.
    """
    if not folder.is_dir():
        raise BadInputError(str(folder), 'is not a folder',
                            remedy='give the one that holds the bags')
    found: list[Path] = []
    closed: list[OSError] = []
    for root, folders, files in os.walk(folder, onerror=closed.append):
        here = Path(root)
        stored = [name for name in files if name.endswith(STORAGE)]
        if 'metadata.yaml' in files or any(n.startswith(f'{here.name}_') for n in stored):
            folders.clear()
            found.append(here)
        else:
            found += [here / name for name in stored if name.endswith('.mcap')]
    found += [Path(error.filename) for error in closed]
    if not found:
        raise BadInputError(str(folder), 'holds no bag (a rosbag2 folder or an .mcap file)',
                            remedy='check the path')
    every = []
    for bag in sorted(found):
        below = bag.relative_to(folder)
        name = str(below) if below.parts else bag.name
        every.append(Job(bag=str(bag.resolve()), name=name,
                         aircraft=below.parts[0] if len(below.parts) > 1 else '',
                         folder=str((out / 'bags' / name).resolve()), axes=axes,
                         search_effects=search_effects))
    return every


def _done(job: Job) -> Row | None:
    """The row of an earlier call, if it is newer than the bag and answers what is asked.

    Raises BadInputError where it is of another bag.
    """
    if not job.row.exists():
        return None
    row: Row = read_json(job.row)
    asked = row.get('asked')
    if asked and asked['source'] != job.bag:
        raise BadInputError('--out', f'{job.folder} holds the results of another bag',
                            asked['source'], 'choose another place')
    bag = Path(job.bag)
    try:
        files = [bag] if bag.is_file() else [p for p in bag.iterdir() if p.is_file()]
        old = any(p.stat().st_mtime > job.row.stat().st_mtime for p in files)
    except OSError:  # its row says so
        return None
    return None if old or asked != job.asked else row


def run(every: Sequence[Job], workers: int = 1, *, show: Callable[[str], None] = lambda _: None,
        work: Callable[[Job], Row] | None = None) -> list[Row]:
    """Identify the bags that are not done; the rows of all, in their order.

    `work` makes the row of one (default: `look`).
    """
    rows: dict[str, Row] = {job.name: row for job in every if (row := _done(job)) is not None}
    todo = [job for job in every if job.name not in rows]
    for number, row in enumerate(_rows(todo, workers, work or look), 1):
        rows[row['bag']] = row
        show(f'bag {min(number + 1, len(todo))} of {len(todo)}, {row["bag"]} {row["status"]}')
    show('')
    return [rows[job.name] for job in every]


def _rows(todo: Sequence[Job], workers: int, work: Callable[[Job], Row]) -> Iterator[Row]:
    """Rows as they come: a process that dies takes one bag with it and no other."""
    # imported here: no other command starts processes
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
    from concurrent.futures.process import BrokenProcessPool
    from multiprocessing import forkserver, resource_tracker

    context = multiprocessing.get_context('forkserver')
    context.set_forkserver_preload(['quad_sysid.pipeline.identify', 'quad_sysid.report.document'])
    resource_tracker.ensure_running()  # which lets the signals in again
    with interrupt.held():  # a terminal sends SIGINT to all, and this process ends them
        forkserver.ensure_running()

    def alone(job: Job) -> Row:
        with interrupt.starting:
            if interrupt.ending:
                return _row(job)
            process = ProcessPoolExecutor(1, context, _begin)
            row = process.submit(work, job)
        with process:
            try:
                return row.result()
            except BrokenProcessPool:
                return {**_row(job), 'reason': 'its process died', 'seconds': 0.0}

    with ThreadPoolExecutor(workers) as threads:
        waiting = [threads.submit(alone, job) for job in todo]
        try:
            for future in as_completed(waiting):
                yield future.result()
        finally:
            threads.shutdown(cancel_futures=True)


def _begin() -> None:
    """First in the process of a bag: the command's ends it, and it leaves nothing half done."""
    interrupt.take_over(terminated=True)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})  # the server's, see above


def _row(job: Job) -> Row:
    """The row of a bag that failed, the reason left open."""
    return {'bag': job.name, 'aircraft': job.aircraft, 'status': FAILED, 'reason': '',
            'asked': job.asked}


def look(job: Job) -> Row:
    """The row of a bag; an error of any kind becomes a row that says so."""
    start = time.monotonic()
    row = _row(job)
    try:
        row |= _identified(job)
    except QuadSysidError as error:
        row['reason'] = str(error)
    except Exception as error:  # noqa: BLE001  one bad bag never stops the run
        row['reason'] = f'{type(error).__name__}: {error}'
    row['seconds'] = round(time.monotonic() - start, 3)
    if row['status'] != FAILED:
        write_whole(job.row, json.dumps(row))
    return row


def _identified(job: Job) -> Row:
    from quad_sysid.bags import read_bag
    from quad_sysid.result import identify

    record = replace(read_bag(job.bag), source=job.name)
    found = identify(record, job.axes, effects=None if job.search_effects else ())
    found.save(job.folder, html=False, pictures=False)
    row: Row = {'status': ANSWERED if found.answered else CANNOT_TELL,
                'reason': '' if found.answered else found.reasons, 'start_ns': record.t0_ns,
                'length_s': record.n * record.dt, 'sample_rate_hz': 1.0 / record.dt,
                'warnings': len(record.warnings)}
    for axis, tree in found.report['axes'].items():
        row |= {f'{axis}_{name}': value for name, value in _of_axis(tree).items()}
    return row


def _of_axis(tree: Mapping[str, Any]) -> Row:
    """The row's values of one axis, by OF_AXIS, from its tree in report.json."""
    effects = {f'{e["name"]}.{p["name"]}': p['value']
               for e in tree['effects'] for p in e['parameters']}
    known = {p['name']: p for p in tree['completed']['parameters']}
    return {'verdict': tree['verdict'], 'effects': ','.join(e['name'] for e in tree['effects']),
            'error_before': tree['error']['before'], 'error_after': tree['error']['after'],
            'effect_parameters': json.dumps(effects), 'gains': json.dumps(tree.get('gains')),
            **{f'{name}{end}': known.get(name, {}).get(field)
               for name in BASE for end, field in (('', 'value'), ('_std', 'std'))}}


def write_table(rows: Sequence[Row], path: Path) -> None:
    """Write rows as CSV with fixed columns; empty where a row has no value."""
    text = io.StringIO()
    table = csv.DictWriter(text, COLUMNS, extrasaction='ignore', lineterminator='\n')
    table.writeheader()
    table.writerows(rows)
    write_whole(path, text.getvalue())


def lines(rows: Sequence[Row]) -> list[str]:
    """The fleet in lines for a terminal: counts, who lacks what, spread of the parameters."""
    from quad_sysid.report.tables import Table
    from quad_sysid.report.words import number

    answered = [row for row in rows if row['status'] == ANSWERED]
    counts = Counter(row['status'].replace('_', ' ') for row in rows)
    craft = len({row['aircraft'] for row in rows} - {''}) or 1
    told = ', '.join(f'{count} {name}' for name, count in sorted(counts.items()))
    tables = (
        Table(['aircraft', 'axis', 'effect', 'found in', 'of flights'], _lacks(answered), (3, 4)),
        Table(['axis', 'parameter', 'flights', 'median', '5 %', '95 %', 'spread, %'],
              [[axis, name, str(len(values)), number(median, 4),
                *(number(float(q)) for q in np.quantile(values, [0.05, 0.95])),
                f'{100.0 * sigma / abs(median):.1f}' if median else '–']
               for axis, name, values, median, sigma, _ in _spreads(answered)], (2, 3, 4, 5, 6),
              caption='Spread: robust standard deviation over the median.'),
        Table(['axis', 'parameter', 'far outside'],
              [[axis, name, bag] for axis, name, *_, far in _spreads(answered) for bag in far]),
    )
    shown = [line for table in tables if table.rows for line in ('', *table.text())]
    return [f'{len(rows)} bags of {craft} aircraft: {told}.', *shown]


def _lacks(rows: Sequence[Row]) -> list[list[str]]:
    """Aircraft, axis, effect, flights in which it was found, flights answered."""
    out = []
    for craft, axis in sorted({(row['aircraft'], axis) for row in rows for axis in AXES}):
        flights = [row for row in rows if row['aircraft'] == craft
                   and row.get(f'{axis}_verdict') not in (None, CANNOT_TELL)]
        found = Counter(effect for row in flights
                        for effect in row[f'{axis}_effects'].split(',') if effect)
        out += [[craft or 'all', axis, effect, str(n), str(len(flights))]
                for effect, n in found.most_common()]
    return out


def _spreads(rows: Sequence[Row]
             ) -> Iterator[tuple[str, str, list[float], float, float, list[str]]]:
    """Axis, parameter, its values, median, robust standard deviation, outlying bags."""
    for axis in AXES:
        for name in BASE:
            known = [(row['bag'], float(row[f'{axis}_{name}'])) for row in rows
                     if row.get(f'{axis}_{name}') is not None]
            if not known:
                continue
            values = [value for _, value in known]
            median = float(np.median(values))
            sigma = 1.4826 * float(np.median(np.abs(np.array(values) - median)))
            far = [bag for bag, value in known if len(known) >= LEAST_FLIGHTS
                   and abs(value - median) > OUTLYING * sigma > 0.0]
            yield axis, name, values, median, sigma, far
