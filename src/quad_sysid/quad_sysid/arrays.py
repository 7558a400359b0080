"""Arrays, frames and responses of other libraries → Records: checked, converted, on one grid.

    record = from_arrays(u=volts, angle=position, dt=0.001, units={'u': 'V', 'angle': 'm'})

The grid, the derivative of a position and the usual segments are those of an imported table
(imports/to_bag.py), so that a bag of the same numbers gives the same answer. Nothing is fitted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from quad_sysid.bags.split import split_segments
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.imports.clock import Stream
from quad_sysid.imports.log import ForeignLog
from quad_sysid.imports.stated_gains import stated
from quad_sysid.imports.to_bag import MIDDLE_COMMAND, MIN_SAMPLES, record_of
from quad_sysid.imports.units import UNITS, Role, written
from quad_sysid.parts import WHERE, Part, part_of, with_parts
from quad_sysid.record import SPEED_DT_S, IOData, Record
from quad_sysid.units import Units

MOST_COMMAND = 0.5
"""Largest normalised command."""
MIN_PER_OSCILLATION = 15
"""Samples below which a narrow oscillation is warned of: a model takes one step per sample."""
NARROW = 1.3
"""Factor to either side of the median frequency between which half of the power is narrow."""
PHYSICAL = ('V', 'mV', 'A', 'mA', 'N', 'mN', 'N m', 'mN m', 'W', 'Pa', 'bar', 'K', 'rad', 'deg',
            'm', 'mm', 'rad/s', 'deg/s', 'rpm', 'm/s', 'mm/s', 'counts')
"""Units of an input without a range of its own: the largest value counts as full command."""
RATES = {**{name: factor for name, (factor, _) in UNITS['rate'].items()},
         'rpm': math.pi / 30.0, 'rev/s': 2.0 * math.pi, 'km/h': 1.0 / 3.6}
MOTIONS = {**{name: factor for name, (factor, _) in UNITS['angle'].items()},
           'rev': 2.0 * math.pi, 'cm': 0.01}
OF_RATE = {'rpm': 'rev', 'km/h': 'm'}
"""Unit of a rate → that of its motion, where it is not the text before the stroke."""
SIGNALS: Mapping[str, tuple[Role, str]] = {
    'battery': ('battery', 'V'), 'throttle': ('thrust', '1'),
    **{f'{axis}_rate': ('rate', 'rad/s') for axis in AXES},
    **{f'{axis}_angle': ('angle', 'rad') for axis in AXES},
    **{f'{axis}_command': ('control', '1') for axis in AXES},
}
"""Other signals that effects may depend on, and their units."""


class Table(Protocol):
    """A frame of pandas or polars, an xarray.Dataset, a mapping: columns by their names."""

    def __getitem__(self, key: Any, /) -> Any:
        """The column."""


Samples: TypeAlias = npt.ArrayLike | Sequence[npt.ArrayLike]
"""(n,) numbers, of one experiment or a list with one array for each; or the name of a column."""


@dataclass(frozen=True)
class _Columns:
    """One experiment as it was handed in: arrays (n,) in their own units; NaN is missing."""

    u: FloatArray
    y: FloatArray | None
    angle: FloatArray | None
    reference: FloatArray | None
    signals: Mapping[str, FloatArray]
    time_s: FloatArray
    dt: float | None
    """None where the times were given."""


def from_arrays(data: Table | IOData | None = None, *, u: Samples | None = None,
                y: Samples | None = None, dt: float | None = None, t: Samples | None = None,
                angle: Samples | None = None, reference: Samples | None = None,
                signals: Mapping[str, Samples] | None = None,
                units: Mapping[str, str | float] | None = None,
                gains: Mapping[str, float] | None = None, train: Part | None = None,
                validate: Part | None = None, axis: str = 'roll') -> Record:
    """A Record of one experiment, which can be passed wherever a flight can.

    u (n,): the input. y (n,): what was measured, a rate, or, by its unit, an angle or a position;
    `angle` (n,) beside a rate or alone. `dt` (s) or the increasing times `t` (n,). `reference`
    (n,): of the angle. `signals`: SIGNALS → (n,). With `data`, a frame or Dataset, all of these
    may be names of its columns; a response of python-control, a pair (u, y) and IOData bring
    their own. `units`: of `u`, `y`, `angle`, `reference`, `t` and the signals, a name or a factor
    to the contract's; rad/s, rad, s where none is given, and u beyond -0.5..0.5 is scaled.
    `gains`: those that flew, by the contract's names (`roll.rate.kp`, …) and SI: normalised
    command per rad/s, a gain in the unit of u times `units.per_command` of the record.
    `train`, `validate`: see Part; the rest of one is the other. NaN and masked values are missing.
    Raises BadInputError, one line that names the argument.
    """
    records = records_of(data, u=u, y=y, dt=dt, t=t, angle=angle, reference=reference,
                         signals=signals, units=units, gains=gains, train=train,
                         validate=validate, axis=axis)
    if len(records) != 1:
        raise BadInputError(WHERE, 'are of several experiments', len(records),
                            'hand the lists to identify, or one experiment here')
    return records[0]


def records_of(data: Any = None, *, u: Any = None, y: Any = None, dt: Any = None, t: Any = None,
               angle: Any = None, reference: Any = None, signals: Any = None, units: Any = None,
               gains: Any = None, train: Any = None, validate: Any = None,
               axis: str = 'roll') -> list[Record]:
    """A Record for each experiment; arguments as `from_arrays`, each a list of several, too."""
    if axis not in AXES:
        raise BadInputError(WHERE, f'axis must be one of {", ".join(AXES)}', repr(axis))
    arguments = {'u': u, 'y': y, 't': t, 'angle': angle, 'reference': reference, 'dt': dt,
                 **{f'signals: {name}': signal for name, signal in _signals(signals).items()}}
    flown = stated(_mapping('gains', gains, 'number', "'roll.rate.kp': 0.07, …"), (axis,),
                   f'{WHERE}: gains')
    several = isinstance(data, list) or any(map(_several, arguments.values()))
    count = 1
    if several:
        lengths = {name: len(values) for name, values in [('the data', data), *arguments.items()]
                   if _several(values) or isinstance(values, list)}
        count = next(iter(lengths.values()))
        if len(set(lengths.values())) > 1:
            raise BadInputError(WHERE, 'needs lists of as many experiments', ', '.join(
                f'{name} has {k}' for name, k in lengths.items()))
        if not count:
            raise BadInputError(WHERE, 'hold no experiment', '[]')

    def of(value: Any, k: int) -> Any:
        return value[k] if several and (_several(value) or isinstance(value, list)) else value

    read = [_columns(data[k] if isinstance(data, list) else data,
                     {name: of(value, k) for name, value in arguments.items()}, _texts(units))
            for k in range(count)]
    units_read = _units(read, _texts(units))
    return [
        _record(columns, units_read, _texts(units), flown, axis,
                WHERE if count == 1 else f'experiment {k + 1}',
                *(part_of(part, k, count) for part in (train, validate)))
        for k, columns in enumerate(read)
    ]


def are_arrays(data: object) -> bool:
    """Whether `data` is no Record, path, or list of these, but arrays or a table."""
    if data is None or isinstance(data, Record | str | Path):
        return False
    if isinstance(data, Sequence):
        return not all(isinstance(item, Record | str | Path) for item in data)
    return True


# what is handed in → columns


def _mapping(name: str, value: Any, of: str, example: str) -> Mapping[str, Any]:
    """The dict of an argument, empty for None."""
    if value is not None and not isinstance(value, Mapping):
        raise BadInputError(WHERE, f'{name} must be a dict of name and {of}',
                            type(value).__name__, f'such as {name}={{{example}}}')
    return value or {}


def _signals(signals: Any) -> Mapping[str, Any]:
    known = _mapping('signals', signals, 'array', "'battery': volts")
    for name in known:
        if name not in SIGNALS:
            raise BadInputError(WHERE, 'signals holds an unknown one', repr(name),
                                f'there are {", ".join(SIGNALS)}')
    return known


def _texts(units: Any) -> Mapping[str, Any]:
    texts = _mapping('units', units, 'unit', "'u': 'V', 'y': 'm/s'")
    allowed = ('u', 'y', 'angle', 'reference', 't', *SIGNALS)
    for name in texts:
        if name not in allowed:
            raise BadInputError(WHERE, 'units names what is no argument', repr(name),
                                f'use {", ".join(allowed[:5])} or a signal')
    return texts


def _several(value: object) -> bool:
    """Whether a list or tuple has an array for each experiment."""
    return isinstance(value, list | tuple) and bool(value) and all(
        not isinstance(item, str | bytes) and (np.ndim(item) > 0 if not hasattr(item, 'shape')
                                               else len(item.shape) > 0) for item in value)


def _columns(data: Any, arguments: Mapping[str, Any], units: Mapping[str, Any]) -> _Columns:
    arguments = _with_data(data, dict(arguments))
    time, dt = arguments.pop('t'), arguments.pop('dt')
    if time is None and dt is None:
        time = _own_time(arguments)
    arrays = {name: _numbers(name, value) for name, value in arguments.items()
              if value is not None}
    if 'u' not in arrays:
        raise BadInputError(WHERE, 'lack u, the input', remedy='identify(u=…, y=…, dt=…)')
    if 'y' not in arrays and 'angle' not in arrays:
        raise BadInputError(WHERE, 'lack y or angle, what was measured',
                            remedy='identify(u=…, y=…, dt=…)')
    n = arrays['u'].size
    for name, array in arrays.items():
        if array.size != n:
            raise BadInputError(WHERE, f'{name} must be as long as u', f'{array.size} and {n}')
    if n < MIN_SAMPLES:
        raise BadInputError(WHERE, f'need {MIN_SAMPLES} samples at least', n, 'measure longer')
    for name in ('u', 'y' if 'y' in arrays else 'angle'):
        _check_moving(name, arrays[name])
    return _Columns(
        arrays['u'], arrays.get('y'), arrays.get('angle'), arrays.get('reference'),
        {name.partition(': ')[2]: array for name, array in arrays.items() if ': ' in name},
        *_times(time, dt, n, units))


def _check_moving(name: str, values: FloatArray) -> None:
    finite = values[np.isfinite(values)]
    if not finite.size:
        raise BadInputError(WHERE, f'{name} holds no number', 'NaN throughout')
    if finite.min() == finite.max():
        raise BadInputError(WHERE, f'{name} never changes', f'{finite[0]:g} throughout',
                            'record an experiment in which it moves')


def _with_data(data: Any, arguments: dict[str, Any]) -> dict[str, Any]:
    """The arguments with what the data bring: columns by name, or a response's own."""
    own = _own_of(data)
    if own is None and data is not None:
        arguments = {name: _column(data, name, value) for name, value in arguments.items()}
        own = {}
        index = getattr(data, 'index', None)
        if arguments['t'] is None and arguments['dt'] is None and _is_time(index):
            own = {'t': index}
    for name, argument in arguments.items():
        if isinstance(argument, str) and name != 'dt':
            raise BadInputError(WHERE, f'{name} names a column of no frame', repr(argument),
                                f'identify(frame, {name}={argument!r}, …)')
    own = own or {}
    if 't' in own and arguments['dt'] is not None:
        del own['t']
    if 'dt' in own and arguments['t'] is not None:
        del own['dt']
    return arguments | {name: value for name, value in own.items()
                        if arguments.get(name) is None}


def _own_of(data: Any) -> dict[str, Any] | None:
    """The arguments that IOData, a response or a pair bring; None for a frame and nothing."""
    if isinstance(data, IOData):
        return {'u': data.u, 'y': _inside(data, data.y), 'dt': data.dt, 'reference': data.r}
    if all(hasattr(data, name) for name in ('time', 'inputs', 'outputs')):
        return {'u': data.inputs, 'y': data.outputs, 't': data.time}
    if isinstance(data, tuple) and len(data) == 2:
        return {'u': data[0], 'y': data[1]}
    if data is not None and not hasattr(data, '__getitem__'):
        raise BadInputError(WHERE, 'are of a kind that cannot be read', type(data).__name__,
                            'identify(u=…, y=…, dt=…), a frame with names, or a path')
    return None


def _inside(z: IOData, values: FloatArray) -> FloatArray:
    """The values of the segments, NaN between them."""
    out = np.full(values.size, np.nan)
    for start, stop in z.segments:
        out[start:stop] = values[start:stop]
    return out


def _column(data: Any, name: str, value: Any) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return data[value]
    except Exception as error:
        columns = getattr(data, 'columns', getattr(getattr(data, 'dtype', None), 'names', None))
        names = list(data if columns is None else columns)
        raise BadInputError(WHERE, f'{name} names a column that is not there', repr(value),
                            f'there are {", ".join(map(str, names))}') from error


def _is_time(index: object) -> bool:
    """Whether a frame's index holds times, and is not the number of the row."""
    kind = getattr(getattr(index, 'dtype', None), 'kind', '')
    return kind in ('f', 'm', 'M')


def _own_time(arguments: Mapping[str, Any]) -> Any:
    """The times that an xarray.DataArray or a series brings with it."""
    for name in ('y', 'angle', 'u'):
        value = arguments.get(name)
        if _is_time(getattr(value, 'index', None)):
            return getattr(value, 'index')  # noqa: B009
        dims: Any = getattr(value, 'dims', ())
        coords: Any = getattr(value, 'coords', None)
        if coords is not None and len(dims) == 1 and dims[0] in coords:
            return coords[dims[0]]
    raise BadInputError(WHERE, 'lack dt or t, the sample interval or the times',
                        remedy='identify(u=…, y=…, dt=0.001), in s')


def _numbers(name: str, value: Any) -> FloatArray:
    """(n,) real numbers, NaN where masked or missing."""
    array: Any = value
    if isinstance(value, np.ma.MaskedArray):
        array = array.astype(np.float64) if array.dtype.kind in 'fiub' else array
        array = array.filled(np.nan if array.dtype.kind == 'f' else None)
    else:
        try:
            array = np.asarray(value)
        except ValueError as error:  # rows of unlike lengths
            raise BadInputError(WHERE, f'{name} must be (n,)', 'rows of unlike lengths') from error
    if array.dtype.kind == 'O':
        array = _of_objects(name, array)
    if array.dtype.kind not in 'fiub':
        raise BadInputError(WHERE, f'{name} must hold real numbers', array.dtype)
    if array.ndim == 2 and 1 in array.shape:
        array = array.ravel()
    if array.ndim != 1:
        raise BadInputError(WHERE, f'{name} must be (n,), one channel', f'shape {array.shape}',
                            'take one column' if array.ndim == 2 else '')
    out = np.array(array, dtype=np.float64)
    if np.isinf(out).any():
        raise BadInputError(WHERE, f'{name} holds infinity', f'sample {np.isinf(out).argmax()}',
                            'mark what is missing by NaN')
    return out


def _of_objects(name: str, array: Any) -> Any:
    """Python's numbers as float64; None and pandas' NA are missing."""
    def number(value: Any) -> float:
        if value is None or type(value).__name__ in ('NAType', 'NaTType'):
            return math.nan
        if isinstance(value, str | bytes):
            raise TypeError
        return float(value)

    try:
        return np.array([number(value) for value in array.ravel()]).reshape(array.shape)
    except (TypeError, ValueError) as error:
        raise BadInputError(WHERE, f'{name} must hold real numbers', 'objects') from error


def _times(time: Any, dt: Any, n: int,
           units: Mapping[str, Any]) -> tuple[FloatArray, float | None]:
    """(n,) s, and dt where the samples are given by it."""
    per_s = _factor('t', units.get('t', 's'), {k: f for k, (f, _) in UNITS['time'].items()})
    if dt is not None and time is not None:
        raise BadInputError(WHERE, 'take dt or t, not both', remedy='leave one out')
    if time is not None and np.ndim(time) == 0:
        raise BadInputError(WHERE, 't must be (n,) times', repr(time), 'the interval is dt=…')
    if dt is not None:
        number = isinstance(dt, int | float | np.number) and not isinstance(dt, bool | np.bool_)
        if not number or not (math.isfinite(float(dt)) and dt > 0):
            raise BadInputError(WHERE, 'dt must be a positive number of seconds', repr(dt))
        seconds = float(dt) * per_s
        _check_interval('dt', seconds)
        return seconds * np.arange(n, dtype=np.float64), seconds
    values = np.asarray(time)
    if values.dtype.kind in 'mM':
        values, per_s = (values - values[0]) / np.timedelta64(1, 'ns'), 1e-9
    seconds_of = per_s * _numbers('t', values)
    if seconds_of.size != n:
        raise BadInputError(WHERE, 't must be as long as u', f'{seconds_of.size} and {n}')
    if not np.isfinite(seconds_of).all():
        raise BadInputError(WHERE, 't holds NaN', f'sample {np.isnan(seconds_of).argmax()}')
    back = np.diff(seconds_of) <= 0.0
    if back.any():
        index = int(back.argmax()) + 1
        raise BadInputError(WHERE, 't must increase', f'{seconds_of[index]:g} s after '
                            f'{seconds_of[index - 1]:g} s at sample {index}',
                            'sort the rows by time')
    _check_interval('t', float(np.median(np.diff(seconds_of))))
    return seconds_of, None


def _check_interval(name: str, seconds: float) -> None:
    longest = SPEED_DT_S[1]
    if seconds > longest:
        raise BadInputError(WHERE, f'{name} has intervals that are too long', f'{seconds:g} s',
                            f'at most {longest:g} s, since errors are those of half a second;'
                            " scale a slow machine's time: "
                            f"units={{'t': {longest / seconds:.2g}}} makes it fast enough")


# units


def _factor(name: str, unit: Any, factors: Mapping[str, float]) -> float:
    """What one of a unit is inside, by its name or as a number."""
    if isinstance(unit, int | float | np.number) and not isinstance(unit, bool):
        if math.isfinite(float(unit)) and unit:
            return float(unit)
    elif isinstance(unit, str) and written(unit) in factors:
        return factors[written(unit)]
    every = {*RATES, *MOTIONS, *PHYSICAL, *(u for role in UNITS.values() for u in role)}
    what = 'is not a unit of it' if isinstance(unit, str) and written(unit) in every \
        else 'is no known unit'
    raise BadInputError(WHERE, f'units: {name} {what}', repr(unit),
                        f'use {", ".join(factors)}, or a factor')


def _units(read: Sequence[_Columns], units: Mapping[str, Any]) -> Units:
    """The units of all experiments."""
    command, per_command, zero = _command(read, units.get('u'))
    rate, motion = units.get('y', 'rad/s'), units.get('angle')
    if written(str(rate)) in MOTIONS:
        if any(columns.angle is not None for columns in read):
            raise BadInputError(WHERE, 'units: y is a position beside an angle', repr(rate),
                                'hand in one of them, or y as a rate')
        rate, motion = None, rate
    if rate is None or all(columns.y is None for columns in read):
        motion = 'rad' if motion is None else motion
        per_motion = _factor('angle', motion, MOTIONS)
        name = written(motion) if isinstance(motion, str) else 'unit'
        return Units(command, per_command, zero, f'{name}/s', per_motion, name, per_motion)
    per_rate = _factor('y', rate, RATES | MOTIONS)
    name = written(rate) if isinstance(rate, str) else 'unit/s'
    unit = OF_RATE.get(name, name.removesuffix('/s'))
    return Units(command, per_command, zero, name, per_rate, unit, MOTIONS.get(unit, per_rate))


def _command(read: Sequence[_Columns], unit: Any) -> tuple[str, float, float]:
    """Name, factor and offset of u; what has no range of its own is scaled by a power of two."""
    largest = max(float(np.nanmax(np.abs(columns.u))) for columns in read)
    scaled = 2.0 ** -math.ceil(math.log2(2.0 * largest))
    control_units = UNITS['control']
    if unit is None:
        return Units.command, min(1.0, scaled), 0.0
    name = written(unit) if isinstance(unit, str) else ''
    if name in control_units:
        factor, offset = control_units[name]
        low, high = _reach(read, factor, offset)
        if max(-low, high) <= MOST_COMMAND + 1e-6:
            return name, factor, offset
        if name not in PHYSICAL:
            raise BadInputError(WHERE, f'u in {name} is outside {-MOST_COMMAND:g}..'
                                f'{MOST_COMMAND:g} of a normalised command',
                                f'{low:.3g}..{high:.3g}', 'name its unit, or leave units out')
    if name in control_units or name in PHYSICAL:
        return name, scaled, 0.0
    factor = _factor('u', unit, dict.fromkeys((*control_units, *PHYSICAL), 1.0))
    low, high = _reach(read, factor, 0.0)
    if max(-low, high) > MOST_COMMAND + 1e-6:
        raise BadInputError(WHERE, 'u by its factor is outside -0.5..0.5 of a normalised command',
                            f'{low:.3g}..{high:.3g}', f'use at most {scaled:g}')
    return 'unit', factor, 0.0


def _reach(read: Sequence[_Columns], factor: float, offset: float) -> tuple[float, float]:
    values = [factor * columns.u + offset for columns in read]
    return min(float(np.nanmin(v)) for v in values), max(float(np.nanmax(v)) for v in values)


# columns → record


def _record(series: _Columns, units: Units, texts: Mapping[str, Any], gains: Mapping[str, float],
            axis: str, source: str, train: Any, validate: Any) -> Record:
    index = AXES.index(axis)
    y_moves = series.y is not None and written(str(texts.get('y'))) in MOTIONS
    rate, angle = (None, series.y) if y_moves else (series.y, series.angle)

    def stream(columns: Mapping[int, FloatArray], width: int = 3) -> Stream:
        out = np.zeros((series.u.size, width))
        for index, values in columns.items():
            out[:, index] = values
        is_finite = np.isfinite(out).all(axis=1)
        return Stream(series.time_s[is_finite], out[is_finite])

    def signal(name: str) -> FloatArray | None:
        values = series.signals.get(name)
        if values is None:
            return None
        role, usual = SIGNALS[name]
        unit = texts.get(name, usual)
        table = {'rate': RATES, 'angle': MOTIONS}.get(
            role, {unit: factor for unit, (factor, _) in UNITS[role].items()})
        offset = UNITS[role].get(written(unit), (1.0, 0.0))[1] if isinstance(unit, str) else 0.0
        return _factor(name, unit, table) * values + offset

    other_axes = [name for name in AXES if name != axis]
    rates, angles, control = ({AXES.index(name): values for name in other_axes
                               if (values := signal(f'{name}_{kind}')) is not None}
                              for kind in ('rate', 'angle', 'command'))
    per_angle = units.per_motion if angle is series.y or series.angle is None else _factor(
        'angle', texts.get('angle', units.motion), MOTIONS | {units.motion: units.per_motion})
    command = {1 + index: values for index, values in control.items()}
    throttle = signal('throttle')
    command[0] = np.full(series.u.size, MIDDLE_COMMAND) if throttle is None else throttle
    command[1 + index] = units.command_of(series.u)
    reference = series.reference
    if reference is not None:
        reference = reference * _factor('reference', texts.get('reference', units.motion),
                                        MOTIONS | {units.motion: units.per_motion})
    battery = signal('battery')
    log = ForeignLog(
        source=source, kind='a table', gains=gains,
        rates=None if rate is None else stream({**rates, index: units.rate_of(rate)}),
        control=stream(command, 4), axes=(axis,),
        angles=None if angle is None else stream({**angles, index: per_angle * angle}),
        attitude_setpoint=None if reference is None else stream({index: reference}),
        battery=None if battery is None else stream({0: battery}, 1),
    )
    read = record_of(log, dt=series.dt)
    measured = np.asarray(angle if rate is None else rate)
    record = replace(read.record, units=units, warnings=(
        *read.record.warnings, *read.warnings, *_gap_warning(series.u),
        *_too_coarse(measured, read.record.dt)))
    start_s = next(float(each.time_s[0]) for each in (log.rates, log.angles) if each is not None)
    return split_segments(with_parts(record, series.time_s - start_s, (axis,), train, validate),
                          axes=(axis,))


def _gap_warning(u: FloatArray) -> tuple[str, ...]:
    """A warning where the input is missing, else nothing."""
    lost = int(np.isnan(u).sum())
    text = (f'u is missing in {lost} of {u.size} samples: the one before is held there, which '
            'biases what is fitted where it had changed')
    return (text,) if lost else ()


def _too_coarse(measured: FloatArray, dt: float) -> tuple[str, ...]:
    """A warning where what was measured oscillates too fast for its sampling; else nothing."""
    centred = np.nan_to_num(measured - np.nanmean(measured))
    power = np.abs(np.fft.rfft(centred)) ** 2
    frequency_hz = np.fft.rfftfreq(centred.size, dt)
    middle = frequency_hz[int(np.searchsorted(np.cumsum(power), 0.5 * power.sum()))]
    near = (frequency_hz > middle / NARROW) & (frequency_hz < middle * NARROW)
    if middle * dt * MIN_PER_OSCILLATION < 1.0 or power[near].sum() < 0.5 * power.sum():
        return ()
    return ((f'what was measured oscillates at {middle:.3g} Hz, {1.0 / (middle * dt):.0f} '
             'samples per oscillation; a model takes one step per sample and wants thirty: sample '
             'faster'),)
