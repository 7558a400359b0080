"""One bag → one flat row of plain values, even where it fails: the work of a worker process."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from quad_sysid.contract import AXES
from quad_sysid.errors import QuadSysidError

Row = dict[str, Any]

ANSWERED, CANNOT_TELL, FAILED = 'answered', 'cannot_tell', 'failed'
BASE = ('gain', 'lag', 'delay', 'damping', 'bias')
"""Parameters of the base that every row holds, by axis."""


@dataclass(frozen=True)
class Job:
    """One bag to identify; small, as it is sent to workers."""

    bag: str
    """Path as it is given to the reader."""
    name: str
    """Path below the fleet's folder, which names it in the table."""
    aircraft: str
    """First folder below the fleet's, empty where the bag lies in it directly."""
    fingerprint: str
    """Size and time of the bag's files; if it changes the bag is identified again."""
    axes: tuple[str, ...] = ()
    search_effects: bool = True
    keep: str = ''
    """Folder for report.json and model.json of each bag; empty: only the row is kept."""


def look(job: Job) -> Row:
    """The row of a bag; an error of any kind becomes a row that says so."""
    start = time.monotonic()
    row: Row = {'bag': job.name, 'aircraft': job.aircraft, 'fingerprint': job.fingerprint,
                'status': FAILED, 'reason': ''}
    try:
        row.update(_identified(job))
    except QuadSysidError as error:
        row['reason'] = str(error)
    except Exception as error:  # noqa: BLE001  one bad bag never stops the run
        row['reason'] = f'{type(error).__name__}: {error}'
    return {**row, 'seconds': round(time.monotonic() - start, 3)}


def _identified(job: Job) -> Row:
    from quad_sysid.bags import read_bag
    from quad_sysid.result import identify

    record = replace(read_bag(job.bag), source=job.name)
    found = identify(record, job.axes, effects=None if job.search_effects else ())
    if job.keep:
        found.save(Path(job.keep) / job.name, html=False, pictures=False)
    report = found.report
    row: Row = {'status': ANSWERED if found.answered else CANNOT_TELL,
                'reason': '' if found.answered else found.reasons, 'start_ns': record.t0_ns,
                'length_s': record.n * record.dt, 'sample_rate_hz': 1.0 / record.dt,
                'warnings': len(record.warnings)}
    for axis, tree in report['axes'].items():
        row.update(columns(axis, tree))
    return row


def columns(axis: str, tree: Mapping[str, Any]) -> Row:
    """The row's values of one axis, from its tree in report.json."""
    error = tree['error']
    row: Row = {
        f'{axis}_verdict': tree['verdict'],
        f'{axis}_effects': ','.join(e['name'] for e in tree['effects']),
        f'{axis}_error_before': error['before'],
        f'{axis}_error_after': error['after'],
        f'{axis}_effect_parameters': json.dumps({
            f'{e["name"]}.{p["name"]}': p['value']
            for e in tree['effects'] for p in e['parameters']
        }),
        f'{axis}_gains': json.dumps(tree.get('gains')),
    }
    known = {p['name']: p for p in tree['completed']['parameters']}
    for name in BASE:
        found = known.get(name, {})
        row[f'{axis}_{name}'] = found.get('value')
        row[f'{axis}_{name}_std'] = found.get('std')
    return row


TEXT = (
    'bag', 'aircraft', 'fingerprint', 'status', 'reason',
    *(f'{axis}_{name}' for axis in AXES
      for name in ('verdict', 'effects', 'effect_parameters', 'gains')),
)
"""Columns of text."""
WHOLE = ('start_ns', 'warnings')
"""Columns of whole numbers."""
REAL = ('seconds', 'length_s', 'sample_rate_hz',
        *(f'{axis}_{name}' for axis in AXES for name in ('error_before', 'error_after')),
        *(f'{axis}_{name}{end}' for axis in AXES for name in BASE for end in ('', '_std')))
"""Columns of numbers; null where there is none."""
