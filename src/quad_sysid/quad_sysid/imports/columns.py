"""Named columns of a table → ForeignLog: roles and units; contradictions are refused.

table.py reads, to_bag.py makes the grid and the bag.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.imports import plausible
from quad_sysid.imports.clock import Stream, cycles, draw
from quad_sysid.imports.likely import FEW, likely_units, one_sided, rounded_down
from quad_sysid.imports.log import NO_GAINS, ForeignLog, Mapped
from quad_sysid.imports.mixers import MIRROR, mixer_of
from quad_sysid.imports.plausible import Column
from quad_sysid.imports.stated_gains import stated
from quad_sysid.imports.table import Table, open_table
from quad_sysid.imports.to_bag import MIDDLE_COMMAND
from quad_sysid.imports.units import (
    BEYOND,
    OPTIONS,
    UNITS,
    Option,
    Role,
    Unit,
    flag,
    header_unit,
    unit_of,
    written,
)

ANGLE_LIMIT = {'roll': np.pi, 'pitch': 0.5 * np.pi, 'yaw': np.inf}


@dataclass(frozen=True)
class ColumnOptions:
    """Options of `quad-sysid import` for a table: names of columns and their units.

    A tuple of columns has one for each axis of `axes`, in their order.
    """

    file: Path
    axes: tuple[str, ...]
    time: str | None = None
    """Column of time; None where each column has its own (messages of a bag or an SD card)."""
    control: tuple[str, ...] = ()
    thrust: str | None = None
    motors: tuple[str, ...] = ()
    mixer: str = 'x'
    """`auto`, `x`, `plus` or a file, see mixers.py."""
    rate: tuple[str, ...] = ()
    angle: tuple[str, ...] = ()
    reference: tuple[str, ...] = ()
    rate_reference: tuple[str, ...] = ()
    battery: str | None = None
    acceleration: tuple[str, ...] = ()
    velocity: tuple[str, ...] = ()
    position: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    sample_rate_hz: float | None = None
    """The rate of the rows where no column has their time."""
    frame: str = 'auto'
    """`flu`, `frd`, or `auto`: as the acceleration shows."""
    messages: Path | None = None
    """A folder of .msg files, for a bag without definitions."""
    gains: Mapping[str, Any] = field(default_factory=dict)
    """The gains that flew, by the names of /gains/active, as numbers or text."""

    def called(self, aliases: Mapping[str, str]) -> ColumnOptions:
        """The options with the table's own names of its columns."""
        def one(name: str) -> str:
            return aliases.get(name, name)

        changed: dict[str, Any] = {}
        for option in OPTIONS:
            value = getattr(self, option)
            changed[option] = one(value) if isinstance(value, str) else value and tuple(
                map(one, value))
        return replace(self, **changed, units={one(n): unit for n, unit in self.units.items()})

    def names(self, option: str) -> tuple[str, ...]:
        """The columns of an option."""
        value = getattr(self, option)
        return (value,) if isinstance(value, str) else value or ()


def parse_units(items: list[str]) -> dict[str, str]:
    """Read the `COL=UNIT` of the command's --unit options."""
    units = {}
    for item in items:
        column, equals, unit = item.rpartition('=')
        if not (equals and column and unit):
            raise BadInputError('--unit', 'needs COLUMN=UNIT', repr(item), 'such as gx=deg/s')
        units[column] = unit
    return units


def read_columns(options: ColumnOptions, opened: Table | None = None) -> ForeignLog:
    """Read the named columns, of the file or of a table that was opened before.

    Raises BadInputError naming file, line and column.
    """
    names = list(_roles(options))
    table = opened or open_table(options.file, names, options.messages)
    options = options.called(table.aliases)
    roles = _roles(options)
    gains = stated(options.gains, options.axes, f'{options.file}, --gain')
    if opened is not None:
        table = replace(table, columns={name: table.columns[name] for name in roles})
    options = replace(options, units=_shared(options))
    units = _units(options, table)
    remarks: list[str] = []
    table = _unsigned(options, table)
    _check_ranges(options, table, units)
    if options.time is not None:
        speeds = [np.nanstd(units[name](table.columns[name])) for name in options.rate]
        table = table.on_clock(options.time, units[options.time])
        times = _column(options, units, options.time, next(iter(table.times.values())))
        remarks += plausible.check_times(times, max(map(float, speeds), default=None))
    elif options.sample_rate_hz is not None and not table.times:
        table = table.at_rate(options.sample_rate_hz)
    elif any(name not in table.times for name in roles):
        raise BadInputError(f'{options.file}', 'is a table, which needs --time',
                            remedy='quad-sysid import FILE alone proposes one; without a column '
                            'of times give --sample-rate')
    streams = {option: _stream(table, units, options.names(option), OPTIONS[option])
               for option in OPTIONS if option != 'time'}
    notes = [*table.notes, *_limited(options, units, table), *_in_our_frame(options, streams)]
    _unwrap(options, streams)
    _check_speeds(options, units, streams)
    remarks += _compared(options, units, streams)
    return ForeignLog(
        source=str(options.file), kind='a table', axes=options.axes,
        rates=_on_axes(options, streams['rate']), angles=_on_axes(options, streams['angle']),
        attitude_setpoint=_on_axes(options, streams['reference']),
        rate_setpoint=_on_axes(options, streams['rate_reference']),
        control=_wrench(options, streams['control'] and _stream(
            table, units, (*options.control, *options.names('thrust')), OPTIONS['control']),
            streams['control']),
        motors=streams['motors'], acceleration=streams['acceleration'],
        velocity=streams['velocity'], position=streams['position'],
        crafts=() if not options.motors or options.mixer == 'auto'
        else (mixer_of(options.mixer, options.motors),),
        battery=streams['battery'], mapped=_mapped(options, units, streams, gains), gains=gains,
        missing=() if gains else (f'{NO_GAINS}; --gain states them',), checks=tuple(remarks),
        clock=tuple(notes), reversing={
            axis: _column(options, units, name, table.columns[name]).advise(units[name].reversed)
            for axis, name in zip(options.axes, options.control, strict=bool(options.control))
        },
    )


def _unsigned(options: ColumnOptions, table: Table) -> Table:
    """The table with the magnitudes of motors whose sign is that of their spin; it says so."""
    columns = {name: table.columns[name] for name in options.motors}
    negative = [name for name, values in columns.items() if np.nanmin(values) < 0.0]
    moving = all(np.nanstd(columns[name]) > 0.0 for name in negative)
    if not negative or not moving or not all(map(one_sided, columns.values())):
        return table
    unsigned = [name for name in columns if name not in negative]
    sense = f', against {", ".join(unsigned)}' if unsigned else ''
    line = (f'{", ".join(negative)} are negative, as motors that turn the other way{sense}: their '
            'magnitude is taken')
    return replace(table, notes=(*table.notes, line), columns={
        **table.columns, **{name: -columns[name] for name in negative}})


def _limited(options: ColumnOptions, units: Mapping[str, Unit], table: Table) -> Iterator[str]:
    """Say of pulses beyond their range that they are limited to it (_stream does)."""
    for option in ('motors', 'control'):
        low, high = OPTIONS[option].span or (-np.inf, np.inf)
        names = [n for n in options.names(option) if units[n].name in BEYOND]
        beyond = sum(int(np.sum((v < low - 1e-6) | (v > high + 1e-6))) for v in (
            units[n](table.columns[n]) for n in names))
        if beyond:
            yield (f'{beyond} values of {", ".join(names)} are beyond the range of '
                   f'{units[names[0]].name} and limited to it, as of disarmed motors')


def _in_our_frame(options: ColumnOptions, streams: dict[str, Stream | None]) -> Iterator[str]:
    """Turn what was measured forward, right, down to forward, left, up; say why."""
    force = streams['acceleration']
    down = None if force is None else plausible.z_points_down(force.values[:, 2])
    if options.frame == 'auto' and down is None:
        if options.motors and len(options.axes) > 1:
            yield ('the places of the motors hold for axes forward, left, up; if y points right '
                   'and z down, give --frame frd')
        return
    is_frd = options.frame == 'frd' or (options.frame == 'auto' and bool(down))
    why = 'as --frame says' if options.frame != 'auto' or force is None else (
        f'the accelerometer shows {np.nanmedian(force.values[:, 2]):+.1f} m/s² on z')
    signs = [MIRROR[AXES.index(axis)] for axis in options.axes]
    if is_frd:
        for role in ('rate', 'angle', 'reference', 'rate_reference', 'control'):
            streams[role] = _times(streams[role], signs)
        streams['acceleration'] = _times(force, MIRROR)
        yield f'forward, right, down ({why}): pitch and yaw turned to forward, left, up'
    if down is not None and _opposed(options, streams):
        for role in ('angle', 'reference'):
            streams[role] = _times(streams[role], signs)
        yield f'the angles turn against the rates, whose frame gravity tells ({why}): turned'


def _times(stream: Stream | None, factors: Sequence[float] | FloatArray) -> Stream | None:
    return stream and Stream(stream.time_s, stream.values * np.asarray(factors))


def _opposed(options: ColumnOptions, streams: Mapping[str, Stream | None]) -> bool:
    """Whether pitch and yaw, where they move, turn against their rates, and roll does not."""
    rate, angle = streams['rate'], streams['angle']
    if rate is None or angle is None or rate.values.shape != angle.values.shape:
        return False
    grid = cycles(rate, str(options.file))
    drawn = draw(angle, grid.times, 3.0 / (angle.rate_hz or np.inf))
    signs = {}
    for i, axis in enumerate(options.axes):
        both = plausible.turn_factor(grid.values[:, i], drawn[:, i], grid.dt)
        if both is not None and abs(both[0]) >= plausible.TOGETHER:
            signs[axis] = both[1] > 0.0
    others = [turns for axis, turns in signs.items() if axis != 'roll']
    return bool(others) and not any(others) and signs.get('roll', True)


def _shared(options: ColumnOptions) -> dict[str, str]:
    """The given units, and for columns of a sensor without any the one that its others have."""
    units = dict(options.units)
    for option, what in OPTIONS.items():
        if what.role not in ('rate', 'angle'):
            continue
        names = options.names(option)
        own = {name: written(units[name], what.role) if name in units
               else header_unit(name, what.role) for name in names}
        common = {unit for unit in own.values() if unit in UNITS[what.role]}
        if len(common) == 1:
            units |= {name: str(*common) for name, unit in own.items() if unit is None}
    return units


def _units(options: ColumnOptions, table: Table) -> dict[str, Unit]:
    """The unit of each column; raises BadInputError with a likely one for a header's unknown."""
    units = {}
    for option, what in OPTIONS.items():
        names = options.names(option)
        for k, name in enumerate(names):
            text = options.units.get(name)
            has_unit = text or header_unit(name, what.role) in {None, *UNITS[what.role]}
            likely = '' if has_unit else likely_units(table, option, names)[k]
            units[name] = unit_of(what.role, text, name, likely)
    return units


def _stream(
    table: Table, units: Mapping[str, Unit], names: tuple[str, ...], option: Option
) -> Stream | None:
    """(n, k) in SI where all of the columns have a number; None for no names.

    Pulses beyond their range are limited to it.
    """
    stream = table.stream(*names)
    if names and stream is None:
        raise BadInputError(table.source, 'has no two rows with a number in each of',
                            ', '.join(names), 'name other columns')
    def converted(i: int, name: str) -> FloatArray:
        values = units[name](stream.values[:, i]) if stream else np.zeros(0)
        return np.clip(values, *option.span) if option.span and units[name].name in BEYOND \
            else values

    return stream and Stream(stream.time_s, np.column_stack([
        converted(i, name) for i, name in enumerate(names)]))


def _unwrap(options: ColumnOptions, streams: dict[str, Stream | None]) -> None:
    """Make a heading continuous, and its reference within half a turn of it (median)."""
    if 'yaw' not in options.axes:
        return
    i, angle = options.axes.index('yaw'), streams['angle']
    for role in ('angle', 'reference'):
        stream = streams[role]
        if stream is None:
            continue
        values = stream.values.copy()
        values[:, i] = np.unwrap(values[:, i])
        difference = values[:1, i]
        if role == 'reference' and angle is not None:
            difference = values[:, i] - np.interp(stream.time_s, angle.time_s, angle.values[:, i])
        values[:, i] -= 2.0 * np.pi * np.round(np.median(difference) / (2.0 * np.pi))
        streams[role] = Stream(stream.time_s, values)
        if role == 'angle':
            angle = streams[role]


def _on_axes(options: ColumnOptions, stream: Stream | None) -> Stream | None:
    """(n, 3) with the columns on their axes, 0 on the others."""
    if stream is None:
        return None
    out = np.zeros((len(stream.values), 3))
    out[:, [AXES.index(axis) for axis in options.axes]] = stream.values
    return Stream(stream.time_s, out)


def _wrench(
    options: ColumnOptions, control: Stream | None, torques: Stream | None
) -> Stream | None:
    """U1..U4 (n, 4) of control columns, the thrust behind them: U1 in the middle without it.

    `torques` are the control columns in our frame.
    """
    if control is None or torques is None:
        return None
    out = np.zeros((len(control.values), 4))
    out[:, 0] = control.values[:, -1] if options.thrust else MIDDLE_COMMAND
    index = np.searchsorted(torques.time_s, control.time_s)
    for i, axis in enumerate(options.axes):
        out[:, 1 + AXES.index(axis)] = torques.values[index, i]
    return Stream(control.time_s, out)


def _mapped(
    options: ColumnOptions, units: Mapping[str, Unit], streams: Mapping[str, Stream | None],
    gains: Mapping[str, float],
) -> tuple[Mapped, ...]:
    """The use of each column, and the stated gains."""
    out = []
    entries = [(option, k, name) for option in OPTIONS
               for k, name in enumerate(options.names(option))]
    for option, k, name in entries:
        unit, stream = units[name], streams.get(option)
        place = 'motor' if option == 'motors' else option.replace('_', ' ')
        place += f' {k + 1}' if option == 'motors' else \
            f', {options.axes[k]}' if OPTIONS[option].per_axis else ''
        how = '' if unit.factor == 1.0 and not unit.offset else f'{unit.factor:.6g} * column'
        how += f' + {unit.offset:g}' if unit.offset else ''
        out.append(Mapped(name, unit.name, place, how, stream.rate_hz if stream else 0.0))
    if options.control and not options.thrust:
        out.append(Mapped('no thrust', '1', f'U1 = {MIDDLE_COMMAND:g}', ''))
    other_axes = [axis for axis in AXES if axis not in options.axes]
    if other_axes:
        out.append(Mapped(', '.join(other_axes), '-', '0', 'not measured'))
    if gains:
        out.append(Mapped('--gain', '-', '/gains/active', ', '.join(
            f'{name} {value:.6g}' for name, value in gains.items())))
    return tuple(out)


def _roles(options: ColumnOptions) -> dict[str, Role]:  # noqa: C901 - one check each
    """Column → role, the time first; raises BadInputError on a contradiction."""
    unknown = [axis for axis in options.axes if axis not in AXES]
    if unknown or not options.axes or len(set(options.axes)) < len(options.axes):
        raise BadInputError('--axis', 'is not an axis', ','.join(options.axes) or None,
                            f'use {", ".join(AXES)}, several by commas, or all')
    if bool(options.control) == bool(options.motors):
        raise BadInputError('import', 'needs exactly one of --control and --motors',
                            remedy='the input of the model comes from one of them')
    if options.motors and not 2 <= len(options.motors) <= 8:
        raise BadInputError('--motors', 'needs the columns of all motors, 4, 6 or 8',
                            ','.join(options.motors), 'separate them by commas')
    for option in ('acceleration', 'velocity', 'position'):
        if len(options.names(option)) not in (0, len(AXES)):
            raise BadInputError(f'--{option}', 'needs three columns: x, y, z',
                                ','.join(options.names(option)), 'separate them by commas')
    if not options.rate and not options.angle:
        raise BadInputError('import', 'needs --rate or --angle', remedy='name what was measured')
    roles: dict[str, Role] = {}
    for option, what in OPTIONS.items():
        names = options.names(option)
        if what.per_axis and names and len(names) != len(options.axes):
            raise BadInputError(
                flag(option), f'needs a column for each of {", ".join(options.axes)}',
                ','.join(names), 'separate them by commas, or name the axes with --axis',
            )
        for name in names:
            if name in roles:
                raise BadInputError('import', 'one column is named twice', name,
                                    'name each once')
            roles[name] = what.role
    unknown = [name for name in options.units if name not in roles]
    if unknown:
        raise BadInputError('--unit', 'names a column that is not imported', ', '.join(unknown),
                            f'imported are {", ".join(roles)}')
    return roles


def _check_ranges(options: ColumnOptions, table: Table, units: Mapping[str, Unit]) -> None:
    """Raise BadInputError at the first row that is outside the normalised range."""
    for option, name in ((key, n) for key in OPTIONS for n in options.names(key)):
        low, high = OPTIONS[option].span or (-np.inf, np.inf)
        raw, unit = table.columns[name], units[name]
        values, slack = unit(raw), BEYOND.get(unit.name, 0.0) + 1e-6
        outside = np.flatnonzero((values < low - slack) | (values > high + slack))
        if len(outside):
            fits = _fitting(raw, low, high)
            names = options.names(option)
            likely = likely_units(table, option, names)[names.index(name)]
            if likely in UNITS[OPTIONS[option].role]:
                converted = unit_of(OPTIONS[option].role, likely, name)(raw)
                slack = BEYOND.get(likely, 0.0)
                if np.nanmin(converted) >= low - slack and np.nanmax(converted) <= high + slack:
                    fits = likely
            raise table.complain(
                int(outside[0]), name,
                f'in unit {unit.name} is outside {low:g}..{high:g} of a normalised command '
                f'({len(outside)} rows)',
                f'name its unit, or a factor, such as --unit {shlex.quote(f"{name}={fits}")}'
                if len(outside) > FEW * len(raw) else
                'mend the row or leave it out (a gap is allowed), or name the unit that is meant',
            )


def _fitting(raw: FloatArray, low: float, high: float) -> str:
    """The factor, or FACTOR:OFFSET, by which a column just fits into low..high."""
    bottom, top = float(np.nanmin(raw)), float(np.nanmax(raw))
    factor = min([*([high / top] if top > 0.0 else []), *([low / bottom] if bottom < 0.0 else [])],
                 default=0.0)
    if factor > 0.0:
        return f'{rounded_down(factor):g}'
    factor = rounded_down((high - low) / (top - bottom)) if top > bottom else 1.0
    return f'{factor:g}:{low - factor * bottom:.6g}'


def _column(options: ColumnOptions, units: Mapping[str, Unit], name: str, values: FloatArray,
            degrees: str = 'deg') -> Column:
    unit = units[name]
    named = name in options.units or header_unit(name) is not None
    return Column(str(options.file), name, unit, named, values, degrees)


def _compared(options: ColumnOptions, units: Mapping[str, Unit],
              streams: Mapping[str, Stream | None]) -> list[str]:
    """Compare rates, angles and references; disagreements in words."""
    base = streams['rate'] or streams['angle']
    if base is None:
        return []
    grid = cycles(base, str(options.file))
    on_grid = {
        role: grid.values if stream is base else draw(stream, grid.times, 3.0 / stream.rate_hz)
        for role in ('rate', 'angle', 'reference') if (stream := streams[role]) is not None
    }
    notes, leaning = [], []
    for i, axis in enumerate(options.axes):
        columns = {
            role: _column(options, units, getattr(options, role)[i], values[:, i],
                          'deg/s' if role == 'rate' else 'deg')
            for role, values in on_grid.items()
        }
        slides = [c.name for c in columns.values() if c.unit.name.startswith('m')]
        if slides:
            notes.append(f'{", ".join(slides)}: in metres, which a bag of an aircraft has no '
                         f'place for: read every rad of {axis} as a metre (qs.from_arrays keeps '
                         'the unit)')
        if 'angle' in columns:
            _check_angle(columns['angle'], axis)
        if 'rate' in columns:
            notes += plausible.check_rate(columns['rate'], columns.get('angle'), grid.dt)
        if columns.keys() >= {'rate', 'angle'} and axis != 'yaw':
            leaning.append((columns['rate'], columns['angle']))
        if 'reference' in columns and 'angle' in columns:
            plausible.check_reference(columns['reference'], columns['angle'])
    return notes + plausible.check_extent(leaning)


def _check_speeds(options: ColumnOptions, units: Mapping[str, Unit],
                  streams: Mapping[str, Stream | None]) -> None:
    """Check the unit of speeds, and of places by how fast they change over a window."""
    for option, unit in (('velocity', 'mm/s'), ('position', 'mm')):
        stream = streams[option]
        if stream is None or len(stream.time_s) < 2:
            continue
        moved, over_s = stream.values, 1.0
        if option == 'position':
            wide = max(1, round(plausible.WINDOW_S * stream.rate_hz))
            moved, over_s = moved[wide:] - moved[:-wide], wide / stream.rate_hz
        for name, values, change in zip(options.names(option), stream.values.T, moved.T,
                                        strict=True):
            plausible.check_speed(_column(options, units, name, values), change / over_s, unit)


def _check_angle(angle: Column, axis: str) -> None:
    limit = ANGLE_LIMIT[axis]
    largest = float(np.nanmax(np.abs(angle.values)))
    if largest >= limit:
        raise BadInputError(
            angle.where, f'is beyond the range of a {axis} angle', f'{largest:.4g} of {limit:.4g}',
            f'name its unit, such as {angle.advise("deg")}'
            + ('; import a rig that turns so far as --axis roll' if axis == 'pitch' else ''),
        )
