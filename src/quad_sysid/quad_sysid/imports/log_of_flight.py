"""An autopilot's own log beside the bag of the same flight → one bag that has the best of both.

From the log come the rates and commands at the controller's rate, and what SYSTEM ID injected;
from the bag the gains in force, the schedule's segments, and ROS time. `offset_s` turns the log's
time into ROS time, as the bridge says it on /aircraft/log.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid.bags import read_bag
from quad_sysid.bags.writer import BagOptions, write_bag
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.imports.clock import Cycles, Stream
from quad_sysid.imports.formats import format_of, read_log
from quad_sysid.imports.log import TOPICS, ForeignLog
from quad_sysid.imports.to_bag import record_of
from quad_sysid.record import GainChange, Record

STREAMS = (*TOPICS, 'armed')
"""Fields of a ForeignLog that are streams."""
MIN_S = 5.0
"""A log that has less of the bag's flight is of another flight."""
SAME = 0.02
"""Part by which the ratio of both's gains may change."""
LATE_S = 2.0
"""So long before the end they are compared: one may say a change later than the other."""


def joined(bag: Path, log: Path, offset_s: float, out: Path) -> Path:
    """Write the bag of both. Raises BadInputError where they are not of one flight."""
    live = read_bag(bag)
    kind = format_of(log)
    if kind is None:
        raise BadInputError(str(log), 'is no log of an autopilot that is known',
                            remedy='quad-sysid import says which are')
    read = read_log(log, kind)
    start_s = 1e-9 * live.t0_ns
    end_s = start_s + live.n * live.dt
    begin_s = start_s - offset_s  # of the bag, in the log's time
    cut = _cut(read, begin_s - 1.0, end_s - offset_s + 1.0)
    if cut.rates is None or len(cut.rates.time_s) < 2 or np.ptp(cut.rates.time_s) < MIN_S:
        raise BadInputError(str(log), 'is of another flight than the bag', str(bag),
                            'the newest log was fetched; take the right one from the card')
    laid = record_of(cut)
    grid = laid.grid
    record = replace(laid.record, t0_ns=round(1e9 * (float(grid.times[0]) + offset_s)))
    live = replace(live, gains=tuple(
        replace(g, time_s=grid.seconds(g.time_s + begin_s)) for g in live.gains))
    if not read.experiments:
        record = _with_schedule(record, live, grid, begin_s)
    record = _in_our_unit(record, live, grid.seconds(begin_s), grid.seconds(end_s - offset_s))
    notes = {'log of the autopilot': log.name, 'bag of the flight': bag.name,
             'import clock': '; '.join(laid.notes), 'import check': '; '.join(laid.warnings)}
    return write_bag(record, out, BagOptions(notes=notes))


def _cut(log: ForeignLog, begin_s: float, end_s: float) -> ForeignLog:
    """The part of a log between two of its times."""
    def part(name: str) -> Stream | None:
        stream: Stream | None = getattr(log, name)
        if stream is None:
            return None
        from_s = begin_s
        if name == 'armed':  # a change holds until the next one: it was armed before the bag began
            from_s = max(stream.time_s[stream.time_s <= begin_s], default=begin_s)
        keep = (stream.time_s >= from_s) & (stream.time_s <= end_s)
        return Stream(stream.time_s[keep], stream.values[keep])

    cut: dict[str, Any] = {name: part(name) for name in STREAMS}
    return replace(log, **cut)


def _with_schedule(record: Record, live: Record, grid: Cycles, begin_s: float) -> Record:
    """The segments and excitation of a bag, which begins at `begin_s` of the log, on its grid."""
    moved = (replace(s, start_s=max(grid.seconds(s.start_s + begin_s), 0.0),
                     end_s=grid.seconds(s.end_s + begin_s)) for s in live.segments)
    segments = tuple(s for s in moved if s.end_s > 0.0)
    excitation = None
    if live.excitation is not None:
        rows = np.floor((grid.times - begin_s) / live.dt).astype(int)
        inside = (rows >= 0) & (rows < live.n)
        excitation = np.full((record.n, 3), np.nan)
        excitation[inside] = live.excitation[rows[inside]]
    return replace(record, segments=segments, excitation=excitation)


def _in_our_unit(record: Record, live: Record, begin_s: float, end_s: float) -> Record:
    """The log's control in the unit of the bag's gains, and these gains.

    The times are the record's, also of the bag's gains and of its begin and end.
    Where the log holds the controller's own outputs, they are in its unit; the gains are the same
    in both at each time, so what they differ by is the factor. Raises BadInputError where that
    changes.
    """
    if not live.gains:
        return record
    gains = tuple(GainChange(max(g.time_s, 0.0), g.values) for g in live.gains)
    if record.motors is not None or record.desaturation != 'none':
        return replace(record, gains=gains)
    end_s = min(record.n * record.dt, end_s) - LATE_S
    scale: FloatArray = np.ones(4)
    for i, axis in enumerate(AXES, 1):
        first, last = (_factor(record, live, f'{axis}.rate.kp', at_s)
                       for at_s in (max(0.0, begin_s), end_s))
        if not math.isclose(first, last, rel_tol=SAME):
            raise BadInputError(record.source, f'holds other gains of {axis} than the bag: their '
                                f'ratio goes from {first:.3g} to {last:.3g}',
                                remedy='leave the log out, or fly without changing them')
        scale[i] = first
    wrench = None if record.wrench is None else record.wrench * scale
    excitation = record.excitation
    if excitation is not None and any(s.injection == 'control' for s in record.segments):
        excitation = excitation * scale[1:]
    return replace(record, control=record.control * scale, wrench=wrench, gains=gains,
                   excitation=excitation)


def _factor(record: Record, live: Record, name: str, at_s: float) -> float:
    """A gain of the bag over the log's at a time of the record; 1 where one does not say it."""
    of_bag, of_log = live.gains_at(at_s), record.gains_at(at_s)
    if not (of_bag.get(name, 0.0) > 0.0 and of_log.get(name, 0.0) > 0.0):
        return 1.0
    return of_bag[name] / of_log[name]
