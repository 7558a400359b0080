"""Data of the grey box of one axis, in unbroken stretches and windows."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_sysid.axes import EVERY
from quad_sysid.contract import FloatArray
from quad_sysid.craft import Craft, X
from quad_sysid.errors import NotInformativeError
from quad_sysid.record import (
    SHORT_GAP_S,
    SPEED_GAP_S,
    Record,
    RotorLag,
    across_gaps,
    finite_runs,
)

Span = tuple[int, int]

WINDOW_S = 0.5
"""Length of a free-run window (contract, error.before)."""
SETTLE_S = 1.0
"""Time in which the filter forgets where it began: it starts so long before a span, and the first
window begins so long behind the start of a segment or a gap that ends one."""
BRIDGED_S = 0.1
"""The filter runs on over shorter gaps, without the rate and with commands interpolated."""
MOTORS_SETTLE_S = 0.2
"""Time behind a gap inside a segment until what the interpolated commands did to the motors has
faded: four lags of slow ones."""
LOST_S = 0.02
"""Longest time without a command that turns an aircraft by little: half of a motor's lag."""
UNKNOWN_S = 0.75 * MOTORS_SETTLE_S
"""Time behind it in which the motors may do what nobody knows; the filter settles in the rest."""
SLOPE_S = 0.02
"""An acceleration is the slope of the rate over this time to either side."""
RESTING = 0.05
"""rad/s. Equal largest values below this are the resolution of a gyro at rest, not its limit."""
LEAST_SHARE = 0.05
"""Least size of another axis' command, relative to this axis'."""
LEAST_SPAN = 1e-6
"""Range of a motor's command below which it does not move."""
MEASURED = 0.95
"""Least share of the training in which another axis' rate is known."""
LEAST_RATE = 0.05
"""Least RMS of another axis' rate beyond its gyro's noise, rad/s."""
MISSING = {'angle': 'orientation', 'battery': 'battery voltage'}
"""What the bag lacks if a signal is absent."""


@dataclass(frozen=True)
class Windows:
    """Free-run windows of one length, by their first indices."""

    starts: NDArray[np.int64]
    length: int

    @property
    def count(self) -> int:
        """Number of windows."""
        return int(self.starts.size)

    @property
    def cells(self) -> NDArray[np.int64]:
        """(windows, length) indices of their samples."""
        return self.starts[:, None] + np.arange(self.length)


@dataclass(frozen=True)
class AxisData:
    """One axis of one or several records on one grid; arrays (n,) or (n, k), read-only.

    Several flights that are fitted together follow one another; no stretch crosses their ends.
    """

    axis: str
    dt: float
    rate: FloatArray
    """(n,) measured, rad/s; a straight line through short gaps, NaN in longer ones."""
    angle: FloatArray | None
    """(n,) measured, rad."""
    control: FloatArray
    """(n, 4) U1..U4."""
    motors: FloatArray
    """(n, k) motor commands 0..1; k is 0 where only the control is known."""
    other_rates: FloatArray
    """(n, 2) the other two axes' rates in the order of AXES, rad/s; NaN where not measured."""
    battery_v: FloatArray | None
    gyro_filter_hz: float | None
    """Cut-off of the filter of the measured rate, Hz; None: unknown. A flight that does not state
    its own is taken to have that of the others."""
    stretches: tuple[Span, ...]
    """Stretches without a gap of more than BRIDGED_S."""
    train: tuple[Span, ...]
    validation: tuple[Span, ...]
    validation_names: tuple[str, ...] = ()
    lost: NDArray[np.bool_] | None = None
    """(n,) whether the rate was not measured; None: only where it is NaN."""
    uncommanded: NDArray[np.bool_] | None = None
    """(n,) whether the command is not known, but filled in; None: nowhere."""
    reference: FloatArray | None = None
    """(n,) external reference of the loop (Record.external); NaN where a record lacks it."""
    derived_s: float | None = None
    """The rate is the angle's slope over this time to either side, s; None: it was measured."""
    other_angles: FloatArray | None = None
    """(n, 2) the other two axes' angles, rad; None: not measured."""
    gyro_filters_hz: FloatArray | None = None
    """(n,) cut-off of each sample, Hz, where it is not one for all."""
    flights: tuple[Span, ...] = ()
    """Samples of each flight; empty: all are of one."""
    source: tuple[AxisData, NDArray[np.int64]] | None = None
    """`whole`, where this is a part of it."""
    trim: tuple[float, float] | None = None
    """Command and rate (rad/s) of the fitted equilibrium; None before a fit."""
    craft: Craft = X
    """The airframe: place and spin of each motor."""
    rotor_lag: RotorLag | None = None
    """The motors' lag as the measured speeds of the rotors show it; None: not measured."""

    @property
    def index(self) -> int:
        """0 roll or surge, 1 pitch or sway, 2 yaw; -1 climb."""
        return EVERY[self.axis].index

    @property
    def share(self) -> FloatArray:
        """(k,) what a unit of each motor's command adds to this axis' command."""
        return self.craft.inverse[self.index + 1]

    @property
    def command(self) -> FloatArray:
        """(n,) this axis' input: U2, U3, U4, or U1 of the climb, normalised; a lean, rad."""
        return np.ascontiguousarray(self.control[:, self.index + 1])

    @property
    def other_axes(self) -> tuple[str, ...]:
        """Names of the other two axes, in the order of `other_rates`."""
        return EVERY[self.axis].others

    def windows(self, spans: Sequence[Span], length_s: float = WINDOW_S) -> Windows:
        """Windows in `spans`, by default of the contract's length, end to end, no partial ones.

        They keep off every gap, and begin anew behind one that ends a span, unless that leaves
        less than half of those of the contract's length: in a log that loses samples throughout,
        short gaps are none.
        """
        settle, motors_settle = (round(seconds / self.dt)
                                 for seconds in (SETTLE_S, MOTORS_SETTLE_S))

        def inside(runs: Sequence[Span], length: int) -> list[int]:
            return [k for a, b in runs for k in range(a, b - length + 1, length)]

        length, usual = (max(2, round(seconds / self.dt)) for seconds in (length_s, WINDOW_S))
        whole = [run for start, stop in self.stretches or ((0, self.rate.size),)
                 for run in bridged([(max(a, start), min(b, stop)) for a, b in sorted(spans)
                                     if a < stop and b > start], self.dt)]
        runs = [(a + settle, b) for a, b in whole]
        known = np.isfinite(self.rate) if self.lost is None else ~self.lost
        for parts in () if known.all() else (whole, spans):
            intact = [(max(a + motors_settle, start + settle), b) for start, stop in parts
                      for a, b in finite_runs(known, (start, stop))]
            if 2 * len(inside(intact, usual)) >= len(inside(runs, usual)):
                runs = intact
        return Windows(np.array(inside(runs, length), dtype=np.int64), length)

    def where_measured(self, errors: FloatArray, windows: Windows) -> FloatArray:
        """Errors (…, windows, length) with straight lines where the rate was lost, as it has."""
        known = None if self.lost is None else ~self.lost[windows.cells]
        if known is None or known.all():
            return errors
        out, rows = errors.copy(), np.arange(windows.length)
        for i in np.flatnonzero(known.any(axis=1) & ~known.all(axis=1)):
            measured = rows[known[i]]
            for window in out.reshape(-1, *known.shape)[:, i]:
                window[:] = np.interp(rows, measured, window[measured])
        return out

    @property
    def clock(self) -> FloatArray:
        """(n,) time of each sample since the first flight's first, s, the flights end to end."""
        return self.whole[1].astype(np.float64) * self.dt

    @property
    def since_start(self) -> FloatArray:
        """(n,) time of each sample since the first of its own flight, s."""
        flight, rows = self.whole
        begins = np.array([start for start, _ in flight.flights] or [0])
        own = begins[np.searchsorted(begins, rows, side='right') - 1]
        return (rows - own).astype(np.float64) * self.dt

    @property
    def whole(self) -> tuple[AxisData, NDArray[np.int64]]:
        """The whole flights, and (n,) the sample there of each here."""
        return self.source or (self, np.arange(self.rate.size))

    def training(self, signal: FloatArray) -> FloatArray:
        """The samples of a signal (n, …) in the training segments; without any, in the others."""
        spans = self.train or self.validation or self.stretches
        return np.concatenate([signal[a:b] for a, b in spans])

    def measures(self, index: int) -> bool:
        """Whether another axis' rate (0 or 1) is known throughout training."""
        return bool(np.isfinite(self.training(self.other_rates[:, index])).mean() >= MEASURED)

    def signal(self, name: str) -> FloatArray | str:
        """(n,) a signal by its word, as it was measured; or a text: why it cannot be used.

        Words: rate, angle, command, throttle, battery, time (of each flight); other rate, other
        angle and other command, followed by 1 or 2 for the first or second of `other_axes`.
        """
        if name.startswith('other'):
            return self._of_another(name[:-2], int(name[-1]) - 1)
        signals: dict[str, FloatArray | None] = {
            'time': self.since_start, 'angle': self.angle, 'battery': self.battery_v,
            'rate': self.rate, 'command': self.command, 'throttle': self.control[:, 0],
        }
        values = signals[name]
        return f'the flight holds no {MISSING[name]}' if values is None else values

    def lacking_motors(self, *, single: bool = False) -> str:
        """Why an effect of the motors, or of a single one, does not show; empty where it may."""
        motors = self.training(self.motors)
        if not motors.shape[1] or np.ptp(motors, axis=0).max() < LEAST_SPAN:
            return 'the flight holds no motor commands'
        if single and all(isinstance(self.signal(f'other command {i}'), str) for i in (1, 2)):
            return 'the other axes hardly move, so no single motor can be distinguished'
        return ''

    def _of_another(self, name: str, index: int) -> FloatArray | str:
        axis = self.other_axes[index]
        if name == 'other angle':
            lean = self.other_angles
            return f'the flight holds no {MISSING["angle"]}' if lean is None else lean[:, index]
        if name == 'other command':
            signal = self.control[:, EVERY[axis].index + 1]
            least = LEAST_SHARE * np.std(self.training(self.command))
            if not np.std(self.training(signal)) >= least:
                return f'the command of {axis} hardly moves during training; excite it as well'
            return signal
        if not self.measures(index):
            return f'the rate of {axis} was not measured throughout'
        rate = self.other_rates[:, index]
        has_moved = np.nanstd(self.training(rate)) >= LEAST_RATE
        return np.nan_to_num(rate) if has_moved else f'{axis} hardly turns during training'


def at_limit(rate: FloatArray) -> NDArray[np.bool_]:
    """(n,) whether the rate stays at one largest value, the limit of the gyro."""
    size = np.abs(np.nan_to_num(rate))
    largest = float(size.max(initial=0.0))
    clipped = size >= largest * (1.0 - 1e-9)
    moves = largest > RESTING and np.ptp(size) > 0.0 and np.count_nonzero(clipped) > 2
    return clipped & moves


def axis_alone(
    command: FloatArray, rate: FloatArray, dt: float, spans: Sequence[Span],
    gyro_filter_hz: float | None = None,
) -> AxisData:
    """AxisData of command (n,) and rate (n,), rad/s, where nothing else was measured.

    The axis is called roll; `spans` are unbroken and all used for training.
    """
    n = rate.size
    control = np.zeros((n, 4))
    control[:, 1] = command
    return AxisData(
        axis='roll', dt=dt, rate=rate, angle=None, control=control, motors=np.zeros((n, 4)),
        other_rates=np.full((n, 2), np.nan), battery_v=None, gyro_filter_hz=gyro_filter_hz,
        stretches=tuple(spans), train=tuple(spans), validation=(),
    )


def other_axis(data: AxisData, index: int) -> AxisData:
    """AxisData of the first (0) or second (1) of the other two axes: command and rate."""
    return replace(
        data, axis=data.other_axes[index], rate=np.ascontiguousarray(data.other_rates[:, index]),
        angle=None, other_rates=np.full_like(data.other_rates, np.nan), other_angles=None,
        derived_s=None, reference=None, source=None, lost=None,
    )


def shifted_spans(spans: Sequence[Span], passes: Sequence[Span]) -> tuple[Span, ...]:
    """The spans in samples of `passes` put end to end; a span that lies in none is left out."""
    begins = np.cumsum([0] + [b - a for a, b in passes])
    return tuple(
        (a - start + int(begin), b - start + int(begin))
        for a, b in spans
        for (start, stop), begin in zip(passes, begins, strict=False)
        if start <= a and b <= stop
    )


def slice_of(data: AxisData, passes: Sequence[Span]) -> AxisData:
    """The samples of these unbroken stretches only, joined."""
    index = np.concatenate([np.arange(a, b) for a, b in passes])
    arrays: dict[str, Any] = {
        name: np.ascontiguousarray(value[index]) for name, value in vars(data).items()
        if isinstance(value, np.ndarray)
    }
    flight, rows = data.whole
    return replace(
        data, **arrays, stretches=shifted_spans(passes, passes),
        train=shifted_spans(data.train, passes),
        validation=shifted_spans(data.validation, passes),
        validation_names=tuple(
            name for name, span in zip(data.validation_names, data.validation, strict=False)
            if shifted_spans([span], passes)
        ),
        flights=(), source=(flight, rows[index]),
    )


def axis_data(records: Sequence[Record], axis: str) -> AxisData:
    """Join the axis of several records (same dt) into one AxisData.

    Raises NotInformativeError where the axis was not measured or never trained on.
    """
    dt = records[0].dt
    parts = [_prepare(record, axis) for record in records]
    if len({part['motors'].shape[1] for part in parts}) > 1:  # not known in one of them
        parts = [part | {'motors': part['motors'][:, :0]} for part in parts]
    fields: dict[str, Any] = {
        key: np.concatenate([values[key] for values in parts]) for key in parts[0]
    }
    is_finite = np.isfinite(fields['rate'])
    stops = itertools.accumulate(record.n for record in records)
    flights = tuple(itertools.pairwise([0, *stops]))

    def pieces(role: str) -> list[tuple[Span, str]]:
        """Unbroken spans of a role, with the names of their signals."""
        return [
            ((a + begin, b + begin), segment.signal)
            for record, (begin, _) in zip(records, flights, strict=True)
            for segment in record.segments
            if segment.role == role and segment.excites(axis)
            for a, b in finite_runs(is_finite[begin:], record.span(segment))
        ]

    for name, least in (('angle', 0.0), ('other_angles', 0.0), ('battery_v', 0.5)):
        known = [np.isfinite(part[name].reshape(len(part[name]), -1)).all(axis=1).mean()
                 for part in parts]  # a flight without it has not what another one had
        fields[name] = filled(fields[name]) if min(known) > least else None
    units = {place for record in records for place in record.injected_at(axis)}
    if len(units) > 1 or not np.isfinite(fields['reference']).any():
        fields['reference'] = None
    for role in ('train', 'validation'):
        fields[role] = tuple(span for span, _ in pieces(role))
    has_angle = EVERY[axis].turns and fields['angle'] is not None
    known_gains = records[0].gains_at(np.inf) if has_angle else {}
    filters = [run for record in records for run in _filters(record, axis)]
    usual = next((hz for hz, _ in filters if hz is not None), None)
    cut_offs = [(hz or usual, count) for hz, count in filters]
    return AxisData(
        axis=axis, dt=dt, **fields,
        stretches=tuple(run for flight in flights
                        for run in bridged(finite_runs(is_finite, flight), dt)),
        gyro_filter_hz=usual,
        gyro_filters_hz=None if len({hz for hz, _ in cut_offs}) < 2
        else np.concatenate([np.full(count, hz) for hz, count in cut_offs]),
        derived_s=known_gains.get('sensor.rate_from_angle_s') or None,
        validation_names=tuple(name for _, name in pieces('validation')),
        flights=flights, craft=records[0].craft,
        rotor_lag=next((r.rotor_lag for r in records if r.rotor_lag is not None), None),
    )


def _filters(record: Record, axis: str) -> list[tuple[float | None, int]]:
    """Cut-off of the sensor's filter, Hz, and for how many samples; None where it is not known."""
    if not EVERY[axis].turns:
        return [(record.speed_filter_hz or None, record.n)]
    starts = sorted({0, *(min(max(round(change.time_s / record.dt), 0), record.n)
                          for change in record.gains)})
    return [(record.gains_at((start + 0.5) * record.dt).get('sensor.gyro_filter_hz') or None,
             end - start) for start, end in itertools.pairwise([*starts, record.n])]


def _prepare(record: Record, axis: str) -> dict[str, Any]:
    """The axis' arrays of one record; the rate is NaN where it or the command is not known."""
    n, entry, motion = record.n, EVERY[axis], record.motion(axis)
    rate, control, motors = motion.rate, motion.control, motion.motors
    if motors is None:
        motors = np.zeros((n, 0)) if record.desaturation == 'none' else \
            motion.share[:, None] * record.craft.commands(record.control)
    is_finite = np.isfinite(rate) & np.isfinite(control[:, entry.index + 1])
    if not is_finite.any():
        raise NotInformativeError(
            f'{record.source}: {axis} has no sample with both rate and command; '
            'record /imu/data with /motors/command or /control/wrench'
        )
    missing, external = np.full(n, np.nan), record.external(axis)
    # rows from one known sample to the next, whatever rounding makes of a whole number of them
    max_gap = (SHORT_GAP_S if entry.turns else SPEED_GAP_S) / record.dt + 1.0 + 1e-9
    other_motion = [_rate_and_angle(record, name) for name in entry.others]
    return {
        'rate': across_gaps(np.where(is_finite, rate, np.nan), max_gap),
        'lost': ~is_finite, 'uncommanded': ~np.isfinite(control[:, entry.index + 1]),
        'angle': missing if motion.position is None else motion.position,
        'other_angles': np.column_stack([position for _, position in other_motion]),
        'control': filled(control),
        'motors': filled(motors) if motors.shape[1] else motors,
        'other_rates': across_gaps(np.column_stack([rate for rate, _ in other_motion]), max_gap),
        'battery_v': missing if record.battery_v is None else record.battery_v,
        'reference': missing if external is None else external,
    }


def _rate_and_angle(record: Record, axis: str) -> tuple[FloatArray, FloatArray]:
    """(n,) rate and position of another axis; NaN where the record does not hold them."""
    missing = np.full(record.n, np.nan)
    try:
        motion = record.motion(axis)
    except NotInformativeError:
        return missing, missing
    return motion.rate, missing if motion.position is None else motion.position


def where_commands_were_lost(data: AxisData, is_measured: NDArray[np.bool_],
                             passes: Sequence[Span]) -> NDArray[np.bool_]:
    """(n,) samples that were measured where no command was known for LOST_S, and UNKNOWN_S behind.

    None if that were more than half: in a log that loses samples throughout. None where only the
    angle was measured, which says little of the rate in one cycle.
    """
    follows_gyro, inside = np.zeros((2, is_measured.size), dtype=bool)
    if data.uncommanded is None or data.derived_s is not None:
        return follows_gyro
    for start, stop in passes:
        inside[start:stop] = is_measured[start:stop]
        for begin, end in finite_runs(data.uncommanded, (start, stop)):
            if end - begin > max(2, round(LOST_S / data.dt)):
                follows_gyro[begin : end + round(UNKNOWN_S / data.dt)] = True
    follows_gyro &= inside
    return follows_gyro if 2 * follows_gyro.sum() <= inside.sum() else np.zeros_like(follows_gyro)


def bridged(runs: Sequence[Span], dt: float) -> list[Span]:
    """Runs joined over gaps of at most BRIDGED_S."""
    merged: list[Span] = []
    for start, stop in runs:
        if merged and (start - merged[-1][1]) * dt <= BRIDGED_S:
            merged[-1] = merged[-1][0], stop
        else:
            merged.append((start, stop))
    return merged


def filled(values: FloatArray) -> FloatArray:
    """(n,) or (n, k) with unknown rows interpolated linearly."""
    rows = values.reshape(values.shape[0], -1)
    finite_rows, grid = np.flatnonzero(np.isfinite(rows).all(axis=1)), np.arange(rows.shape[0])
    columns = [np.interp(grid, finite_rows, v[finite_rows]) for v in rows.T]
    return np.column_stack(columns).reshape(values.shape)


def high(x: FloatArray) -> float:
    """97th percentile of |x|, which a few spikes do not move, at least 1e-9."""
    return max(float(np.nanpercentile(np.abs(x), 97.0)), 1e-9)


def typical_acceleration(data: AxisData, spans: Sequence[Span]) -> float:
    """Scatter of the acceleration within these spans, rad/s²; 1 where nothing moves."""
    reach = max(1, round(SLOPE_S / data.dt))
    inside = [data.rate[a:b] for a, b in spans if b - a > 4 * reach] or [np.zeros(4 * reach)]
    change = np.concatenate([x[2 * reach :] - x[: -2 * reach] for x in inside])
    return float(np.std(change)) / (2 * reach * data.dt) or 1.0
