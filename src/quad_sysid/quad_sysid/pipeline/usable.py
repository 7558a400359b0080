"""Whether records can be answered at all, before anything is fitted: refusals only.

Several flights need one sample rate and none of them twice; motors must stand in their order; an
axis needs segments of some length in which something moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from quad_sysid.axes import EVERY
from quad_sysid.contract import IDLE, FloatArray
from quad_sysid.craft import Craft
from quad_sysid.discover.constants import LEAST_BLOCKS
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.model.data import SETTLE_S, WINDOW_S, AxisData, Span, at_limit
from quad_sysid.record import ENOUGH_ROWS, SHORT_GAP_S, Record, RotorLag, motors_at_limit
from quad_sysid.rotors import rotors_of
from quad_sysid.units import Units

SAME_RATE = 5e-3
"""Relative difference of sample intervals that two clocks of one rate may have."""
NOTABLE_RATE_ERROR = 5e-4
"""Above this, a warning states the difference."""
SAME_PLACES = 0.02
"""Difference of mixers that two descriptions of one craft may have."""
LEAST_WINDOWS = 8
"""Least number of training windows of 0.5 s for a fit."""
THROUGHOUT = 0.9
"""Largest share of the samples with all motors at their limits."""
CLIPPED = 0.1
"""Share that a gyro may spend at its limit: the fit leaves these samples out and would hold to
0.3, but the errors include them."""
AT_ENDS = 0.01
"""Share of the samples at the ends of the command from which it may be cut off there."""
ROUNDED = 1e-4
"""Share of its range by which a command at its end may differ from it."""
MANY_VALUES = 50
"""Least number of values of a command that a controller computes."""
LEAST_OVERLAP = 50
"""Samples; fewer may agree by chance, as at rest."""


def together(records: Sequence[Record]) -> tuple[Record, ...]:
    """The records at the first one's sample interval, as if all had its clock.

    With the motors' lag where the speeds of the rotors were measured, and arrays in the first
    one's units.

    Raises BadInputError where their rates differ by more than SAME_RATE, where two of them
    hold the same measurement, which would count twice, or where arrays are of unlike units.
    """
    first = records[0]
    records = [record.in_units(first.units, record.axis_of_units) for record in records]
    for record in records[1:]:
        if not same_rate(record.dt, first.dt):
            raise BadInputError(record.source, 'all bags must have one sample rate',
                                f'{1.0 / record.dt:.6g} Hz, the first {1.0 / first.dt:.6g} Hz',
                                'identify them one by one')
        if not same_craft(record.craft, first.craft):
            raise BadInputError(record.source, 'all bags must be of one craft',
                                f'motors {", ".join(record.craft.places)}; the first '
                                f'{", ".join(first.craft.places)}', 'identify them one by one')
    for earlier, other in combinations(records, 2):
        _check_distinct(earlier, other)
    usable = []
    for record in records:
        adapted, dt = record.at_interval(first.dt), first.dt
        if abs(record.dt - dt) > NOTABLE_RATE_ERROR * dt:
            warning = (f'{record.source}: its {1.0 / record.dt:.6g} Hz are taken as the '
                       f"first bag's {1.0 / dt:.6g} Hz")
            adapted = replace(adapted, warnings=(*adapted.warnings, warning))
        rotors = rotors_of(adapted, training=True)
        if rotors.lag_s is not None:
            adapted = replace(adapted, rotor_lag=RotorLag(rotors.lag_s, rotors.spread))
        usable.append(replace(adapted, warnings=(*adapted.warnings, *rotors.lines)))
    return tuple(usable)


def same_craft(craft: Craft, other: Craft) -> bool:
    """Whether two descriptions give one mixer."""
    return craft.count == other.count and bool(
        np.allclose(craft.inverse, other.inverse, atol=SAME_PLACES))


def same_rate(dt: float, other: float) -> bool:
    """Whether two sample intervals, s, are those of one rate under two clocks."""
    return abs(dt - other) <= SAME_RATE * other


def _check_distinct(record: Record, other: Record) -> None:
    """Refuse a flight that is given twice, whole or in part, by stamps or from its start."""
    for shift in {round((other.t0_ns - record.t0_ns) * 1e-9 / record.dt), 0}:
        a = record.rates[max(shift, 0) :][: max(other.n + min(shift, 0), 0)]
        b = other.rates[max(-shift, 0) :][: a.shape[0]]
        is_finite = np.isfinite(a[: b.shape[0]]).all(axis=1) & np.isfinite(b).all(axis=1)
        a, b = a[: b.shape[0]][is_finite], b[is_finite]
        if a.shape[0] < LEAST_OVERLAP or not np.ptp(a, axis=0).any():
            continue
        same = (a == b).all(axis=1)
        if same.mean() > 0.5:  # no two flights have the same noise
            raise BadInputError(other.source, f'holds the same measurement as {record.source}',
                                f'{np.count_nonzero(same)} samples', 'give each flight once')


BETTER = 0.5
"""Another order counts where it leaves less than this share of what the contract's leaves."""
FLOOR = 2e-4
"""RMS of a motor command, normalised, below which a difference is rounding (1 µs of pulse)."""


def swapped_motors(record: Record) -> tuple[int, ...] | None:
    """The motors (1..n) that stand in the places of /motors/command; None: in order.

    None also where the record lacks one of the topics. Only orders are compared, so that topics
    that lag by a cycle, or limits below the nominal ones, raise no alarm.
    """
    if record.motors is None or record.wrench is None or record.desaturation == 'none':
        return None
    idle = record.gains_at(np.inf).get(IDLE, 0.0)
    expected = record.craft.commands(record.wrench, record.desaturation, idle)
    is_finite = np.isfinite(record.motors).all(axis=1) & np.isfinite(expected).all(axis=1)
    samples = np.flatnonzero(is_finite)
    rows = samples[:: max(1, samples.size // ENOUGH_ROWS)]
    if rows.size == 0:
        return None
    motors, expected = record.motors[rows], expected[rows]
    from scipy.optimize import linear_sum_assignment  # slow to import

    square = np.mean((motors[:, :, None] - expected[:, None, :]) ** 2, axis=0)
    best = linear_sum_assignment(square)[1]
    plain = float(np.sqrt(np.mean(np.diag(square))))
    residual = float(np.sqrt(np.mean(square[np.arange(len(best)), best])))
    if plain <= FLOOR or residual >= BETTER * plain:
        return None
    return tuple(int(motor) + 1 for motor in best)


def refusal(record: Record) -> str:
    """One line that says why no gains may come of this record; empty where nothing is wrong."""
    order = swapped_motors(record)
    if order is None:
        return ''
    return (f'{record.source}: /motors/command holds the motors in the order '
            f'{", ".join(map(str, order))} (by /control/wrench and the mixer), not '
            f'{", ".join(map(str, range(1, len(order) + 1)))}; '
            'put them in order and fly again')


def check_usable(data: AxisData, records: Sequence[Record]) -> None:
    """Raise NotInformativeError for segments too short, nothing that moves, or limits."""
    if not data.train or not data.windows(data.validation).count:
        role = 'validation' if data.train else 'train'
        raise NotInformativeError(f'{data.axis}: {_lacking(data, records, role)}')
    check_limits(data, data.train, 'the training')
    check_moving(data)


def too_few_windows(data: AxisData) -> str:
    """Why the held-out segments can confirm nothing; empty where they can."""
    count = data.windows(data.validation).count
    return '' if count >= LEAST_BLOCKS else (
        f'only {count} windows of 0.5 s are held out, and a test needs {LEAST_BLOCKS}: fly the '
        'schedule to its end, or name longer segments with --train and --validate')


def cut_off_command(data: AxisData, units: Units | None = None) -> str:
    """Where the command often stands at its ends: that its record may be cut off; else empty.

    A command of few values, such as a PRBS at the control, is at its ends by itself.
    """
    command = data.training(data.command)
    command = command[np.isfinite(command)]
    ends = float(command.min()), float(command.max())
    near = ROUNDED * (ends[1] - ends[0])
    inside = command[(command > ends[0] + near) & (command < ends[1] - near)]
    share = 1.0 - inside.size / command.size
    if share < AT_ENDS or np.unique(inside).size < MANY_VALUES:
        return ''
    low, high = sorted((units or Units()).command_in(np.array(ends)))
    return (f'the command stands at {low:.3g} or {high:.3g}, its ends, for {share:.0%} of the '
            'training, and no model follows the rate: where only its record is limited there, '
            'the fit misses what the aircraft was sent; record the command as it was sent')


def _lacking(data: AxisData, records: Sequence[Record], role: str) -> str:
    """What the axis lacks of a role: the segments, or their length."""
    name = 'training' if role == 'train' else role
    recorded_axes = {s.axis for record in records for s in record.segments if s.role == role}
    if recorded_axes & {data.axis, EVERY[data.axis].excited_as}:
        longest = max((b - a for a, b in vars(data)[role]), default=0) * data.dt
        flown_s = max((s.end_s - s.start_s for record in records for s in record.segments
                       if s.role == role and s.excites(data.axis)), default=0.0)
        remedy = 'fly longer'
        if flown_s >= SETTLE_S + WINDOW_S:
            remedy = (f'the log has gaps of more than {1e3 * SHORT_GAP_S:.0f} ms: log fewer '
                      'values, or to a faster medium')
        return (f'the longest unbroken {name} segment lasts {longest:.2g} s, '
                f'{SETTLE_S + WINDOW_S:g} s are needed; {remedy}')
    if recorded_axes:
        recorded = ', '.join(axis for axis in EVERY if axis in recorded_axes)
        return f'no {name} segment is on this axis (on {recorded} only); excite it'
    option = '--train' if role == 'train' else '--validate'
    return f'the flight holds no {name} segment; name one with {option}'


def check_limits(data: AxisData, spans: Sequence[Span], where: str) -> None:
    """Raise NotInformativeError for motors or gyro at their limits over spans, named `where`."""
    motors = _inside(data.motors, spans)
    stuck = motors_at_limit(motors).all(axis=1)
    # the commands no longer say what the controller does
    if motors.shape[1] and stuck.mean() > THROUGHOUT:
        raise NotInformativeError(
            f'{data.axis}: all motors are at their limits (0 or 1) during '
            f'{100.0 * stuck.mean():.0f} % of {where}; is it armed? Fly with less excitation '
            'or lower gains'
        )
    rate = _inside(data.rate, spans)
    clipped = at_limit(rate)
    if clipped.mean() > CLIPPED:  # the same largest rate again and again, as no noisy gyro gives
        raise NotInformativeError(
            f'{data.axis}: the measured rate stays at {np.abs(rate).max():.3g} rad/s during '
            f'{100.0 * clipped.mean():.0f} % of {where}: the gyro is at its limit; widen its '
            'range or fly more gently'
        )


def check_moving(data: AxisData) -> None:
    """Raise NotInformativeError for training too short for a fit, or in which nothing moves."""
    count = data.windows(data.train).count
    if count < LEAST_WINDOWS:
        raise NotInformativeError(
            f'{data.axis}: training holds {count} windows of 0.5 s, at least {LEAST_WINDOWS} are '
            'needed; fly a longer excitation or widen --train'
        )
    if np.ptp(_inside(data.command, data.train)) < 1e-9:
        raise NotInformativeError(
            f'{data.axis}: the command never moves during training; excite this axis'
        )
    if np.ptp(_inside(data.rate, data.train)) < 1e-9:
        raise NotInformativeError(f'{data.axis}: the measured rate is constant during training; '
                                  'check the gyro and that the axis is free to turn')


def _inside(signal: FloatArray, spans: Sequence[Span]) -> FloatArray:
    return np.concatenate([signal[a:b] for a, b in spans])
