"""What was measured, as arrays on one uniform grid: Record, Segment, IOData.

Built by bags.read_bag or by hand, from arrays. No file access, no filtering, no fitting.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from quad_sysid.axes import EVERY, axis_of
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.craft import Craft, X
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.motion import Motion, between, lean, relative_thrust, turned, upright
from quad_sysid.units import LENGTHS, Units

ROLES = ('train', 'validation', 'idle')
UNNAMED = ('none', 'unknown')  # signals of segments in which none is known to have been flown
WIDTHS = {
    'rates': 3, 'control': 4, 'angles': 3, 'acceleration': 3, 'motors': None, 'speeds': None,
    'wrench': 4, 'attitude_setpoint': 3, 'rate_setpoint': 3, 'excitation': 3, 'battery_v': 0,
    'velocity': 3, 'altitude': 0, 'lean': 2,
}
"""Array of a Record → its columns: 0 for one without (n,), None for any number."""
ACTING = ('control', 'motors', 'wrench', 'lean', 'acceleration')
SPARSE = ('velocity', 'altitude', 'lean')
"""Arrays that act over a whole cycle, and those that may come more rarely."""
SPEED_DT_S = (0.01, 0.05)
"""Shortest and longest interval, s, at which a speed is looked at: its motors have a lag of some
40 ms, and errors are those of half a second."""
SPEED_GAP_S = 0.25
"""A speed is known between samples this close."""
INJECTIONS = ('attitude', 'rate', 'control')
SHORT_GAP_S = 0.05
"""A gap up to this long, some motors' lag, does not end a segment: the filter predicts through it,
and the rate is compared with a straight line."""
AT_LIMIT = 1e-3
"""A motor this near to 0 or 1 is at its limit."""
INDEPENDENT_S = 1.0
"""Errors that are further apart count as independent: an axis in its loop has settled."""
ENOUGH_ROWS = 20_000
"""Samples of a record that suffice for some dozen coefficients; more cost time only."""


@dataclass(frozen=True)
class Segment:
    """A stretch of a flight with one role; times in s from the record's first sample."""

    role: str
    """`train`, `validation` or `idle`."""
    signal: str
    """`prbs`, `square`, `chirp`, `multisine`, `3211`, `none` or, where the bag does not say,
    `unknown`."""
    axis: str
    injection: str
    start_s: float
    end_s: float
    parameters: Mapping[str, float | int | str | bool] = field(default_factory=dict)

    def excites(self, axis: str) -> bool:
        """Whether it is on this axis, or on the one whose experiment is also this one's.

        Without an experiment the segments of all axes are the same: roll's stand for the climb.
        """
        row = EVERY[axis]
        if not row.turns and not row.excited_as and self.injection not in INJECTIONS:
            return self.axis in {axis, AXES[0]}
        return self.axis in {axis, row.excited_as}


@dataclass(frozen=True)
class GainChange:
    """Gains and loop constants the STM32 acknowledged, valid from `time_s` (s from the start)."""

    time_s: float
    values: Mapping[str, float]


@dataclass(frozen=True)
class RotorLag:
    """The lag from command to rotor speed."""

    seconds: float
    spread: float
    """Standard deviation of its logarithm."""


@dataclass(frozen=True)
class Record:
    """One flight on a uniform grid of the control cycle; a lost sample is NaN, never invented.

    All arrays have n rows; optional ones are None where the bag lacks the topic.
    """

    source: str
    """Path of the bag, for messages and reports."""
    dt: float
    """Sample interval, s."""
    rates: FloatArray
    """(n, 3) body rates p q r, rad/s (FLU)."""
    control: FloatArray
    """(n, 4) the plant's input U1..U4, normalised: the craft's mixer inverse of the motors."""
    angles: FloatArray | None = None
    """(n, 3) roll, pitch, yaw, rad (yaw unwrapped)."""
    acceleration: FloatArray | None = None
    """(n, 3) m/s²."""
    motors: FloatArray | None = None
    """(n, k) commands 0..1 of the craft's k motors, each in its true place."""
    speeds: FloatArray | None = None
    """(n, k) measured speeds of the rotors, rad/s, positive in flight; NaN where not measured."""
    craft: Craft = X
    """The airframe: place and spin of each motor; the X frame where the bag has no other."""
    rotor_lag: RotorLag | None = None
    """The motors' lag by these speeds during training; the pipeline takes it (rotors.py)."""
    desaturation: str = 'clip'
    """Treatment of commands beyond the motors' range: `clip`, `yaw_first`; by
    `none` the mixer is not known, and the control is as another controller commanded it."""
    wrench: FloatArray | None = None
    """(n, 4) controller output before mixer and limits, normalised."""
    attitude_setpoint: FloatArray | None = None
    """(n, 3) rad."""
    rate_setpoint: FloatArray | None = None
    """(n, 3) rad/s."""
    excitation: FloatArray | None = None
    """(n, 3) excitation as applied by the STM32, in the unit of the segment's injection."""
    battery_v: FloatArray | None = None
    """(n,) battery voltage, V."""
    velocity: FloatArray | None = None
    """(n, 3) m/s over the level and along the heading: forward, left, up; NaN where not measured,
    as between the samples of a slower topic."""
    altitude: FloatArray | None = None
    """(n,) m above where the estimate began; NaN alike."""
    lean: FloatArray | None = None
    """(n, 2) horizontal thrust per vertical one, forward and left, by the attitude of the same
    source; NaN alike. None: that of the angles, which an acceleration deceives."""
    speed_filter_hz: float | None = None
    """Cut-off of the filter of the measured speed, Hz; None: it has none, or it is not known."""
    segments: tuple[Segment, ...] = ()
    gains: tuple[GainChange, ...] = ()
    missing: tuple[str, ...] = ()
    """Topics of the contract that the bag lacks or that hold nothing usable."""
    warnings: tuple[str, ...] = ()
    """Repairs and doubts of the reader, one line each."""
    t0_ns: int = 0
    """Stamp of the first sample, ns."""
    units: Units | None = None
    """Units of the arrays that it was made of; None: it comes from a bag."""

    def __post_init__(self) -> None:
        """Check every array and make it read-only; raises BadInputError naming the field.

        The yaw set-point is put on the turn of the measured yaw, as a controller's error is.
        """
        if not _is_interval(self.dt):
            raise BadInputError('Record', 'dt must be a positive number of seconds', self.dt)
        n = np.shape(self.rates)[0] if np.ndim(self.rates) else 0
        for name, width in WIDTHS.items():
            array = getattr(self, name)
            if array is not None:
                object.__setattr__(self, name, _frozen(name, array, n, width))
        if self.attitude_setpoint is not None:
            yaw = None if self.angles is None else self.angles[:, 2]
            setpoint = unwrapped(self.attitude_setpoint, yaw)
            object.__setattr__(self, 'attitude_setpoint', setpoint)

    def __repr__(self) -> str:
        head = f'{self.source}: {self.n * self.dt:.1f} s at {1.0 / self.dt:.6g} Hz'
        head += '' if self.craft == X else f', {self.craft.count} motors'
        lines = [head, *(f'  {s.role}: {s.signal} on {s.axis}, {s.start_s:.1f} to {s.end_s:.1f} s'
                         for s in self.segments)]
        lines += [f'  lacks {", ".join(self.missing)}'] if self.missing else []
        return '\n'.join([*lines, *(f'  warning: {line}' for line in self.warnings)])

    @property
    def n(self) -> int:
        """Number of grid points."""
        return int(self.rates.shape[0])

    @property
    def time_s(self) -> FloatArray:
        """(n,) s from the first sample."""
        return np.arange(self.n, dtype=np.float64) * self.dt

    def axis(self, name: str, role: str | None = None) -> IOData:
        """Input and output of one axis over the segments of `role` (all of the record: None).

        r is `external(name)` where that is known throughout, else None. Raises BadInputError for
        another axis or role and NotInformativeError where nothing is left. Of the axis of arrays
        u and y are in the units in which they were handed in, and r in that of the motion.
        """
        motion = self.motion(name)
        if role not in (None, *ROLES):
            raise BadInputError('Record.axis', f'role must be of {", ".join(ROLES)}', repr(role))
        u = motion.control[:, EVERY[name].index + 1]
        y, r = motion.rate, self.external(name)
        if role is None:
            spans: list[tuple[int, int]] = [(0, self.n)]
        else:
            spans = [self.span(s) for s in self.segments if s.role == role and s.excites(name)]
        is_finite = np.isfinite(y) & np.isfinite(u)
        runs = [run for span in spans for run in finite_runs(is_finite, span)]
        if not runs:
            raise NotInformativeError(
                f'{self.source}: {name} has no sample with both rate and command'
                + (f' in a segment of role {role}' if role else '')
            )
        if r is not None and not all(np.isfinite(r[a:b]).all() for a, b in runs):
            r = None
        if self.units is not None and name == self.axis_of_units:
            u, y = self.units.command_in(u), self.units.rate_in(y)
            r = None if r is None else r / self.units.per_motion
        return IOData(u=u, y=y, dt=self.dt, r=r, segments=tuple(runs))

    def motion(self, name: str) -> Motion:
        """Commands and motion of an axis.

        Raises BadInputError for another name, NotInformativeError where the bag lacks the speed
        or the attitude.
        """
        axis, angles = axis_of('Record.axis', name), self.angles
        i, control = axis.index, self.control
        if axis.turns:
            return Motion(self.rates[:, i], None if angles is None else angles[:, i], control,
                          self.motors, np.ones(self.n))
        if self.velocity is None or not np.isfinite(self.velocity[:, i]).any():
            raise NotInformativeError(
                f'{self.source}: {name} needs the {"vertical" if i < 0 else "horizontal"} speed; '
                'record /odom' + (', or /baro beside /imu/data with its acceleration'
                                  if i < 0 else ''))
        if i < 0:  # where it leans, less of the thrust points up
            share = np.ones(self.n) if angles is None else upright(between(angles))
            return Motion(self.velocity[:, 2], self.altitude, share[:, None] * control,
                          None if self.motors is None else share[:, None] * self.motors, share)
        if angles is None:
            raise NotInformativeError(f'{self.source}: {name} needs the lean; record the '
                                      'orientation of /imu/data')
        yaw = angles[:, 2]
        mean = float(np.angle(np.nanmean(np.exp(1j * yaw))))
        # along a fixed heading no turn of the aircraft accelerates it; the lean is that of a whole
        # cycle, the speed that of its start
        leaning = turned(lean(between(angles)) if self.lean is None else self.lean,
                         between(yaw) - mean)
        if self.acceleration is not None:
            leaning *= relative_thrust(self.acceleration, angles, self.dt)[:, None]
        driven = np.column_stack([control[:, 0], leaning, control[:, 3]])
        speed = turned(self.velocity[:, :2], yaw - mean)
        return Motion(speed[:, i], None, driven, np.zeros((self.n, 0)), np.ones(self.n))

    def external(self, name: str) -> FloatArray | None:
        """(n,) external reference of an axis' loop; None where the bag does not hold it.

        The attitude set-point (rad), which contains an excitation of the attitude; where the axis
        is excited after C1 or C2 instead, that excitation as applied (rad/s or normalised). It is
        of one unit, that of the training: NaN in segments excited at another place, and None
        where the training's are of several. Of an axis that moves it is not known.
        """
        if not axis_of('Record.external', name).turns:
            return None
        index = AXES.index(name)
        injections = self.injected_at(name)
        if len(injections) > 1:
            return None
        behind = self.excitation is not None and not injections <= {'attitude'}
        signal = self.excitation if behind else self.attitude_setpoint
        if signal is None:
            return None
        out = np.nan_to_num(signal[:, index]) if behind else signal[:, index]
        others = [s for s in self.segments if s.axis == name and s.role != 'idle'
                  and injections and s.injection in INJECTIONS and s.injection not in injections]
        if others:
            out = out.copy()
            for segment in others:
                out[slice(*self.span(segment))] = np.nan
        return out

    def injected_at(self, name: str) -> set[str]:
        """Where the axis is excited in its training, or without any in all of its segments."""
        excitations = [s for s in self.segments if s.axis == name and s.injection in INJECTIONS
                       and s.role != 'idle']
        injections = {s.injection for s in excitations if s.role == 'train'}
        return injections or {s.injection for s in excitations}

    def span(self, segment: Segment) -> tuple[int, int]:
        """Index range [start, stop) of a segment."""
        start = max(0, round(segment.start_s / self.dt))
        return start, min(self.n, round(segment.end_s / self.dt))

    @property
    def axis_of_units(self) -> str:
        """The axis of the arrays that it was made of, whose units are `units`."""
        return next((s.axis for s in self.segments), AXES[0])

    def in_units(self, units: Units | None, name: str) -> Record:
        """The record with the commands of an axis normalised as these units do, if it has any.

        What one of a unit is inside is chosen by the largest value of an experiment. Raises
        BadInputError where the record's arrays are of other units than these.
        """
        own = self.units
        if own is None or units is None or own == units:
            return self
        scale = own.renamed(units)
        if scale is None:
            raise BadInputError(self.source, 'u must be in the unit of the other experiment',
                                f'{own.command}, the other {units.command}',
                                'convert it, and name the same unit')
        if (own.motion in LENGTHS) != (units.motion in LENGTHS):
            raise BadInputError(self.source, 'y must be in a unit as that of the other experiment',
                                f'{own.rate}, the other {units.rate}')
        column = EVERY[name].index + 1

        def scaled(commands: FloatArray) -> FloatArray:
            out = commands.copy()
            out[:, column] = scale[0] * out[:, column] + scale[1]
            return np.asarray(out)

        return replace(self, control=scaled(self.control), units=units,
                       wrench=None if self.wrench is None else scaled(self.wrench))

    def at_interval(self, dt: float) -> Record:
        """The samples at an interval of dt s; times of segments and gains are scaled with it."""
        if dt == self.dt:
            return self
        ratio = dt / self.dt
        return replace(
            self, dt=dt,
            segments=tuple(
                replace(s, start_s=s.start_s * ratio, end_s=s.end_s * ratio) for s in self.segments
            ),
            gains=tuple(replace(g, time_s=g.time_s * ratio) for g in self.gains),
        )

    def for_axis(self, name: str, dt: float | None = None) -> Record:
        """The record at the interval at which this axis is looked at, or of about dt s.

        A speed is slow, and comes more rarely than the control cycle: its axes go from one of its
        samples to the next, with the mean of the commands between them.
        """
        axis = axis_of('Record.axis', name)
        if axis.turns or self.velocity is None:
            return self
        measured = np.flatnonzero(np.isfinite(self.velocity[:, axis.index]))
        if measured.size < 2:
            return self
        interval = float(np.median(np.diff(measured))) * self.dt
        # several of them from one sample to the next where these are further apart
        cycles = max(interval, SPEED_DT_S[0]) / max(1, math.ceil(interval / SPEED_DT_S[1] - 1e-9))
        count = round((cycles if dt is None else dt) / self.dt)
        count = max(count, 1)
        phase = int(np.bincount(measured % count).argmax())
        n = (self.n - phase) // count

        def cells(values: FloatArray) -> FloatArray:
            return values[phase : phase + n * count].reshape(n, count, *values.shape[1:])

        has_sample = np.zeros(n, dtype=bool)
        nearest = np.round((measured - phase) / count).astype(int)
        has_sample[nearest[(nearest >= 0) & (nearest < n)]] = True
        angles = None if self.angles is None else across_gaps(
            self.angles, SHORT_GAP_S / self.dt)  # else a lost sample costs all cells that it is in
        arrays: dict[str, Any] = {}
        for array in WIDTHS:
            values = getattr(self, array)
            if array == 'lean' and angles is not None:
                # the angles know how it moves between its samples, and act up to the next
                tilt = lean(angles)
                values = between(tilt if values is None else tilt + across_gaps(
                    values - tilt, SPEED_GAP_S / self.dt))
            elif values is None:
                continue
            else:
                values = across_gaps(
                    values, (SPEED_GAP_S if array in SPARSE else SHORT_GAP_S) / self.dt)
            values = cells(values)
            values = values.mean(axis=1) if array in ACTING else values[:, 0]
            if array in {'velocity', 'altitude'}:
                values[~has_sample] = np.nan
            arrays[array] = values
        shift_s = phase * self.dt
        return replace(
            self, dt=count * self.dt, t0_ns=self.t0_ns + round(1e9 * shift_s), **arrays,
            segments=tuple(replace(s, start_s=max(0.0, s.start_s - shift_s),
                                   end_s=s.end_s - shift_s)
                           for s in self.segments if s.end_s > shift_s),
            gains=tuple(replace(g, time_s=max(0.0, g.time_s - shift_s)) for g in self.gains))

    def gains_at(self, time_s: float) -> Mapping[str, float]:
        """The gains active at `time_s`; empty where the bag does not say.

        Those of an axis flown by the LQR (`<axis>.lqr.share`) are left out, since the analysis
        knows the cascade only.
        """
        gains: dict[str, float] = {}
        for change in self.gains:
            if change.time_s <= time_s or not gains:
                gains.update(change.values)
        other = {axis for axis in AXES if gains.get(f'{axis}.lqr.share', 0.0) > 0.0}
        return {
            name: value for name, value in gains.items()
            if name.partition('.')[0] not in other or name.split('.')[1] not in {'angle', 'rate'}
        }


def unwrapped(setpoint: FloatArray, yaw: FloatArray | None) -> FloatArray:
    """Attitude set-points (n, 3) whose yaw is within half a turn of the measured one, rad.

    Without one, it goes on without jumps.
    """
    turn, heading = 2.0 * np.pi, setpoint[:, 2]
    finite = np.flatnonzero(np.isfinite(heading))
    if yaw is None or not np.isfinite(yaw).any():
        near = np.unwrap(heading[finite])
        turns = np.round((near - heading[finite]) / turn)
    else:
        measured = np.flatnonzero(np.isfinite(yaw))
        turns = np.round((np.interp(finite, measured, yaw[measured]) - heading[finite]) / turn)
    if not turns.any():
        return setpoint
    out = setpoint.copy()
    out[finite, 2] += turn * turns
    return np.asarray(out)


def across_gaps(values: FloatArray, most: float) -> FloatArray:
    """(n,) or (n, k) with straight lines between known samples at most so many rows apart."""
    out, rows = values.reshape(values.shape[0], -1).copy(), np.arange(values.shape[0])
    for column in out.T:
        finite = np.flatnonzero(np.isfinite(column))
        if finite.size < 2 or finite.size == rows.size:
            continue
        after = np.clip(np.searchsorted(finite, rows), 1, finite.size - 1)
        near = (finite[after] - finite[after - 1] <= most) & (rows >= finite[0])
        near &= rows <= finite[-1]
        column[near] = np.interp(rows[near], finite, column[finite])
    return np.asarray(out.reshape(values.shape))


def motors_at_limit(motors: FloatArray, idle: float = 0.0) -> np.ndarray:
    """Whether each motor command, an array of any shape, is at a limit of its range, idle..1."""
    return np.asarray((motors <= idle + AT_LIMIT) | (motors >= 1.0 - AT_LIMIT))


def finite_runs(mask: np.ndarray, span: tuple[int, int]) -> list[tuple[int, int]]:
    """Index ranges [start, stop) inside `span` where `mask` (n,) is True without a break."""
    start, stop = span
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask[start:stop], [False]))))
    return [(start + int(a), start + int(b)) for a, b in edges.reshape(-1, 2)]


@dataclass(frozen=True)
class IOData:
    """Input and output of one channel, in one or several unbroken segments.

    u, y, r are (n,), finite inside the segments; `segments` are index ranges [start, stop) that do
    not overlap and are fitted together without joining their ends (empty: the whole). dt in s.
    """

    u: FloatArray
    y: FloatArray
    dt: float
    r: FloatArray | None = None
    segments: Sequence[tuple[int, int]] = ()

    def __post_init__(self) -> None:
        """Check every field; raises BadInputError naming the argument."""
        u, y = _signal('u', self.u), _signal('y', self.y)
        if u.ndim != 1 or u.shape != y.shape:
            raise BadInputError('IOData', 'u and y must be 1-D of one length',
                                f'{u.shape} and {y.shape}')
        if not _is_interval(self.dt):
            raise BadInputError('IOData', 'dt must be a positive number of seconds', self.dt)
        r = None if self.r is None else _signal('r', self.r)
        if r is not None and r.shape != y.shape:
            raise BadInputError('IOData', 'r must have the length of y', r.shape)
        segments = _spans(self.segments, int(y.size))
        for name, x in (('u', u), ('y', y), ('r', y if r is None else r)):
            for start, stop in segments:
                if not np.isfinite(x[start:stop]).all():
                    raise BadInputError('IOData',
                                        f'segment {start}:{stop} of {name} holds NaN or infinity',
                                        remedy='split it there, as Record.axis does')
        for name, value in (('u', u), ('y', y), ('r', r), ('segments', segments)):
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return (f'IOData: {self.n} samples at {1.0 / self.dt:.6g} Hz in {len(self.segments)} '
                f'segments, {"with" if self.r is not None else "no"} reference r')

    @property
    def n(self) -> int:
        """Number of samples in all segments."""
        return sum(stop - start for start, stop in self.segments)

    def inside(self, signal: FloatArray) -> FloatArray:
        """The samples of a signal (n,) within the segments, one after the other."""
        return np.concatenate([signal[start:stop] for start, stop in self.segments])


def _signal(name: str, value: object, where: str = 'IOData') -> FloatArray:
    """`value` as real numbers, or BadInputError naming the argument."""
    try:
        array = np.asarray(value)
        real = None if array.dtype.kind == 'c' else np.asarray(array, dtype=float)
    except (TypeError, ValueError):
        real = None
    if real is None:
        kind = getattr(value, 'dtype', type(value).__name__)
        raise BadInputError(where, f'{name} must hold real numbers', kind)
    return real


def _frozen(name: str, value: object, n: int, width: int | None) -> FloatArray:
    """An array of a Record as float64 that nobody can write to; BadInputError for other shapes."""
    array = _signal(name, value, 'Record')
    columns = array.shape[1:] if width is None else (width,) if width else ()
    if array.ndim != (1 if width == 0 else 2) or array.shape != (n, *columns) or not n:
        expected = ', '.join(['n', *([] if width == 0 else [str(width or 'motors')])])
        raise BadInputError('Record', f'{name} must be ({expected}) with n as in rates',
                            f'{array.shape} for n = {n}')
    if array is value and array.flags.writeable:
        array = array.copy()
    array.flags.writeable = False
    return array


def _is_interval(dt: object) -> bool:
    return isinstance(dt, (int, float, np.number)) and bool(np.isfinite(dt) and dt > 0)


def _spans(value: object, n: int) -> tuple[tuple[int, int], ...]:
    """Index ranges inside 0..n that do not overlap, in the given order; empty: the whole."""
    try:
        spans = tuple((operator.index(a), operator.index(b)) for a, b in value)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise BadInputError('IOData', 'segments must be pairs of whole numbers (start, stop)',
                            value) from error
    for start, stop in spans:
        if not 0 <= start < stop <= n:
            raise BadInputError('IOData', f'a segment must lie in 0..{n}', (start, stop))
    sorted_spans = sorted(spans)
    for first, other in itertools.pairwise(sorted_spans):
        if other[0] < first[1]:
            raise BadInputError('IOData', 'segments must not overlap, samples would count twice',
                                f'{first} and {other}')
    return spans or ((0, n),)
