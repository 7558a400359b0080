"""A bag, a foreign log or a table → what is looked at. The readers are those of the import."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quad_sysid.bags import read_bag
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.imports.clock import Cycles, cycles, drawn_on, hold, hold_if_any
from quad_sysid.imports.formats import check_single
from quad_sysid.imports.guess import read_any
from quad_sysid.imports.log import ForeignLog
from quad_sysid.imports.plausible import FASTEST_RAD_S
from quad_sysid.imports.stretches import airborne
from quad_sysid.imports.table import head_of, is_bag
from quad_sysid.imports.to_bag import gains_of, record_of, uneven, volts_on
from quad_sysid.logview.flown import Flown
from quad_sysid.logview.measure import Measured, look_at
from quad_sysid.record import Record, unwrapped

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STILL = 1e-9
"""Spread of a rate below which its axis was not measured."""
SAME_GRID = 0.9
"""Share of the rates' rate from which the raw gyro is put on their grid."""
MOST_TURNS = 200.0
"""Largest set-point of an angle, rad: some thirty turns of yaw."""
CONSEQUENCES = {
    'rate_setpoint': 'rate set-point: no step response of the rate, no loop, no tracking error',
    'motors': 'motors: no balance, no limits', 'speeds': 'rotor speeds: no orders, no motor delay',
    'battery_v': 'battery', 'rates_before': 'gyro before its filters: their delay is by settings',
    'gains': 'gains: no margins',
}


class Look(Measured):
    """The measurements of a log, with their text, pictures and page."""

    def __repr__(self) -> str:
        """The text that the command prints."""
        from quad_sysid.logview.words import lines

        return '\n'.join(lines(self))

    def tree(self) -> dict[str, Any]:
        """The measurements as plain values, for `--json`."""
        from quad_sysid.logview.words import tree

        return tree(self)

    def plot(self, name: str = 'step_rate') -> Figure:
        """One picture as a matplotlib figure: `step_rate`, `spectra`, `throttle`, `loop`."""
        from quad_sysid.logview.pictures import draw

        return draw(self, name).figure

    def save(self, path: str | Path) -> Path:
        """Write the page with all of it; returns where."""
        from quad_sysid.files import write_whole
        from quad_sysid.logview.page import page

        write_whole(path, page(self))
        return Path(path)


def look(flight: Record | Flown | str | Path, *, log: int = 1,
         messages: str | Path | None = None) -> Look:
    """Measure what a log shows without a model, in seconds; see docs/look.md.

    `flight`: a bag, a log of PX4, ArduPilot, Betaflight or INAV, a table, or a Record. `log`: of
    several in a blackbox file, counted from 1; `messages`: a folder of .msg files. Raises
    BadInputError where it cannot be read.
    """
    if isinstance(flight, Record):
        flown = of_record(flight, 'a record')
    elif isinstance(flight, Flown):
        flown = flight
    else:
        flown = read(Path(flight), log, None if messages is None else Path(messages))
    return Look(**vars(look_at(flown)))


def read(path: Path, log: int = 1, messages: Path | None = None) -> Flown:
    """The signals of a file or bag that are looked at; raises BadInputError."""
    record = None
    if is_bag(path, head_of(path)):
        with suppress(BadInputError):  # then it holds other topics, which the readers below know
            record = read_bag(path)
    if record is not None:
        check_single(path, 'a bag', log)
        return of_record(record, 'a bag')
    return of_log(read_any(path, log, messages))


def of_record(record: Record, kind: str) -> Flown:
    """The signals of a record."""
    return _complete(Flown(
        source=record.source, kind=kind, dt=record.dt, rates=record.rates,
        flying=airborne(record.control[:, 0], record.dt), axes=_moving(record.rates),
        rate_setpoint=record.rate_setpoint, angles=record.angles,
        attitude_setpoint=record.attitude_setpoint, control=record.control, motors=record.motors,
        speeds=record.speeds, battery_v=record.battery_v, gains=record.gains,
        injected=_injected(record), warnings=record.warnings, proposed=_proposed(record)))


def _proposed(record: Record) -> tuple[tuple[str, float, float], ...]:
    """Role, start and end, s, of the segments that train or are held out, of all axes at once."""
    spans = [(s.role, s.start_s, s.end_s) for s in record.segments
             if s.role in ('train', 'validation')]
    return tuple(dict.fromkeys(spans))


def _injected(record: Record) -> FloatArray | None:
    """The excitation of the segments that excite the command itself."""
    if record.excitation is None:
        return None
    out = np.full_like(record.rates, np.nan)
    for segment in record.segments:
        if segment.injection == 'control' and segment.axis in AXES and segment.signal != 'none':
            rows, i = slice(*record.span(segment)), AXES.index(segment.axis)
            out[rows, i] = np.nan_to_num(record.excitation[rows, i])
    return out if np.isfinite(out).any() else None


def of_log(log: ForeignLog) -> Flown:
    """A foreign log, also one that the import refuses since it has no commands of use."""
    base = log.rates or log.angles
    if base is None or len(base.time_s) < 2:
        raise BadInputError(log.source, 'holds no body rates and no angles',
                            remedy='log the gyro; quad-sysid import lists what the log holds')
    try:
        read = record_of(log)
    except BadInputError as error:
        laid = cycles(base, log.source)
        flown = _without_commands(log, laid, str(error))
    else:
        laid = read.grid
        flown = replace(of_record(read.record, log.kind),
                        warnings=(*log.checks, *read.warnings, *uneven(read.notes)))
    flown = replace(flown, loop_s=log.loop_s)
    times = laid.times
    if log.d_term is not None and len(times) == flown.n:
        width = log.d_term.values.shape[1]
        d_term = np.full((flown.n, len(AXES)), np.nan)
        d_term[:, :width] = hold(log.d_term, times, flown.dt)
        flown = replace(flown, d_term=d_term)
    before = log.rates_before
    if before is not None and before.rate_hz >= SAME_GRID / flown.dt and len(times) == flown.n:
        flown = replace(flown, rates_before=drawn_on(before, times), before_dt=flown.dt)
    elif before is not None and len(before.time_s) > 2:
        before_cycles = cycles(before, log.source)
        flown = replace(flown, rates_before=before_cycles.values, before_dt=before_cycles.dt)
    return _complete(flown)


def _without_commands(log: ForeignLog, laid: Cycles, why: str) -> Flown:
    rates = laid.values if log.rates is not None else np.gradient(laid.values, laid.dt, axis=0)
    resample = partial(hold_if_any, times=laid.times, dt=laid.dt)
    motors = resample(log.motors)
    throttle = None if motors is None else motors.mean(axis=1)
    flying = np.ones(len(rates), bool) if throttle is None or not np.isfinite(throttle).any() \
        else airborne(throttle, laid.dt)
    angles, setpoint = drawn_on(log.angles, laid.times), resample(log.attitude_setpoint)
    if setpoint is not None:
        setpoint = unwrapped(setpoint, None if angles is None else angles[:, 2])
    return Flown(
        source=log.source, kind=log.kind, dt=laid.dt, rates=rates, flying=flying,
        axes=tuple(a for a in log.axes if a in _moving(rates)), motors=motors,
        rate_setpoint=resample(log.rate_setpoint), attitude_setpoint=setpoint,
        angles=angles, battery_v=volts_on(log.battery, laid.times),
        gains=gains_of(log, log.gains, laid),
        warnings=(f'it cannot be identified: {why}',))


def _possible(flown: Flown) -> Flown:
    """Without set-points that no aircraft can follow, as damaged logs hold."""
    removed = 0
    clean: dict[str, Any] = {}
    for name, largest in (('rate_setpoint', FASTEST_RAD_S), ('attitude_setpoint', MOST_TURNS)):
        values = getattr(flown, name)
        if values is not None and (wrong := np.abs(values) > largest).any():
            removed += int(wrong.any(axis=1).sum())
            clean[name] = np.where(wrong, np.nan, values)
    if not clean:
        return flown
    note = f'set-points beyond what an aircraft can follow were dropped from {removed} samples'
    return replace(flown, warnings=(*flown.warnings, note), **clean)


def _complete(flown: Flown) -> Flown:
    """Without what cannot be, and what the log lacks, in words."""
    flown = _possible(flown)
    if not flown.axes:
        raise BadInputError(flown.source, 'shows no axis that turns',
                            remedy='give the log of a flight')
    lacks = [text for name, text in CONSEQUENCES.items()
             if getattr(flown, name) is None or (name == 'gains' and not flown.gains)]
    return replace(flown, lacks=tuple(lacks))


def _moving(rates: FloatArray) -> tuple[str, ...]:
    spread = [float(np.nanstd(rates[:, i])) if np.isfinite(rates[:, i]).any() else 0.0
              for i in range(len(AXES))]
    return tuple(axis for axis, size in zip(AXES, spread, strict=True) if size > STILL)
