"""`quad-tune export`: gains of the contract in the words of PX4, ArduPilot, Betaflight or INAV.

Ours: u = kp e + ki ∫e dt - kd d(rate)/dt in normalised command per rad/s, C1 in 1/s (contract).
Theirs: the same in their own unit of torque, -1..1. `scale` is our U per unit of their torque: 1
where the model was identified from their torque set-points (quad-sysid import says so), else the
factor of their mixer; a design does not contain it, so it is asked for. Each conversion is written
out as a comment, and so is what has no counterpart.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from quad_sysid.arguments import Commands, command
from quad_sysid.autopilot_table import ARDUPILOT, D_FILTER, PX4, Table
from quad_sysid.axes import EVERY
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.files import check_new, read_json, write_whole
from quad_sysid.imports.betaflight_gains import (
    BETAFLIGHT,
    BETAFLIGHT_LEVEL,
    DEGREES,
    INAV,
    INAV_LEVEL,
    PIDSUM,
    RANGE_US,
    YAW_FACTOR,
    YAW_I,
)
from quad_tuning.gain_table import DEFAULT_BOUNDS, ROWS

DESIGN = 'quad_tuning/design/1'
SCHEMAS = (DESIGN, 'quad_sysid/report/1')
"""Schemas of the files that hold gains."""
REMEDY, AGAIN = 'give the file of quad-tune design --out, or a report.json', 'design again'
NEEDED = ('angle.kp', 'rate.kp', 'rate.ki', 'rate.kd')


@dataclass(frozen=True)
class Firmware:
    """Format of a firmware's file of parameters, with the names of `table` or of `cli`."""

    table: Table | None
    notes: tuple[str, ...]
    """Gains without a counterpart."""
    head: str = ''
    row: str = '{name},{value:.9g}'
    cli: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    """Name and scale by our name, for a firmware with whole numbers on a command line."""
    level: float = 1.0
    """Angle gain, 1/s, per unit of its P of the level mode."""
    head_lines: tuple[str, ...] = ()


PX4_NOTES = (
    ('PX4 differentiates the measured rate, as ours; its D filter (IMU_DGYRO_CUTOFF) is of second '
     'order and one for all axes: the lowest.'),
    'MC_*RATE_K is set to 1, so that P, I and D are not multiplied by it.',
)
ARDUPILOT_NOTES = (
    ('ArduPilot differentiates the error, as a design from its own flight does. One from our '
     "firmware's has D on the measured rate: the answer to a reference is quicker here, that to a "
     'disturbance the same.'),
    ('The filters of target and error (FLTT, FLTE) are in a design from its own flight, with '
     'their values, and in no other; its input shaping (ATC_ACCEL_*) is in none.'),
)
AT_THROTTLE = ('P and D stand for the throttle of the flight: divided by what TPA left of them '
               'there, where the log says so.')
BETAFLIGHT_NOTES = (
    ('Scales of Betaflight 3.1 to 2026.12 (src/main/flight/pid.h). D is differentiated from the '
     'measured rate, as ours.'),
    AT_THROTTLE,
    ('Feed-forward, I-term relax, anti-gravity and RPM filters stay as they are. Before 2025.12 '
     'set d_min_* to the same value as d_*, which is the largest D there.'),
)
INAV_NOTES = (
    'Scales of INAV 2 to 8 (src/main/flight/pid.h, FP_PID_RATE_*_MULTIPLIER).', AT_THROTTLE,
    'The control derivative (mc_cd_*) stays as it is.',
)
FIRMWARES = {
    'px4': Firmware(PX4, PX4_NOTES, '# Vehicle-Id\tComponent-Id\tName\tValue\tType (9: float)\n',
                    '1\t1\t{name}\t{value:.9g}\t9'),
    'ardupilot': Firmware(ARDUPILOT, ARDUPILOT_NOTES),
    'betaflight': Firmware(None, BETAFLIGHT_NOTES, cli={
        'rate.kp': ('p_{}', BETAFLIGHT[0]), 'rate.ki': ('i_{}', BETAFLIGHT[1]),
        'rate.kd': ('d_{}', BETAFLIGHT[2]),
    }, level=BETAFLIGHT_LEVEL, head_lines=('set simplified_pids_mode = OFF',)),
    'inav': Firmware(None, INAV_NOTES, cli={
        'rate.kp': ('mc_p_{}', INAV[0]), 'rate.ki': ('mc_i_{}', INAV[1]),
        'rate.kd': ('mc_d_{}', INAV[2]),
    }, level=INAV_LEVEL),
}
"""By the name that --to takes."""
NOT_STATED = ('Warning: the file does not say what was flown, so that P and D are not corrected '
              'for TPA: design again')
MOST = 250
"""Largest P, I, D of their command lines."""
DIFFERS = 0.1
"""Relative difference from which filters are said to differ."""


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'export', run,
        'Write designed gains as a parameter file of PX4 or ArduPilot, or as lines for the '
        'command line of Betaflight or INAV, with each conversion as a comment.',
        'quad-tune design result/model.json --out gains.json && quad-tune export gains.json '
        '--to px4 --scale roll=0.25 --scale pitch=0.25',
    )
    parser.add_argument('gains', metavar='GAINS.json', type=Path,
                        help='of quad-tune design --out, or a report.json')
    parser.add_argument('--to', choices=tuple(FIRMWARES), required=True)
    parser.add_argument('--scale', metavar='AXIS=NUMBER', action='append', default=[],
                        help="our command per unit of the firmware's torque; 1 where the model "
                        'was identified on its torque set-points; repeat for each axis')
    parser.add_argument('--out', metavar='FILE', type=Path,
                        help='a new file; default: print it')


def run(arguments: argparse.Namespace) -> int:
    """Read, convert, print or write; raises BadInputError."""
    firmware = FIRMWARES[arguments.to]
    if firmware.cli:
        return _command_line(firmware, arguments)
    gains = read_gains(arguments.gains)
    scale = scales(arguments.scale)
    values = parameters(firmware, gains, scale)
    rest = left_out(gains)
    way = [', '.join(f'{name} {value:.4g}'
                     for name, (value, _) in parameters(firmware, step, scale).items())
           for step in _steps(gains, read_axes(arguments.gains), to_gains=True)
           if step != gains]
    content = (
        f'# Gains of {arguments.gains.name}, converted by quad-tune export\n'
        + ''.join(f'# {note}\n' for note in firmware.notes)
        + ''.join(f'# Left out, it has no counterpart here: {note}\n' for note in rest)
        + ''.join(f'# {line}\n' for line in (*_shared_filter(firmware, gains),
                                              *_out_of_range(firmware, values)))
        + ''.join(f'# Step {k} of {len(way) + 1}, set and fly it before the next: {step}\n'
                  for k, step in enumerate(way, 1))
        + firmware.head
        + ''.join(f'# {name} = {how}\n' for name, (_, how) in values.items())
        + ''.join(firmware.row.format(name=name, value=value) + '\n'
                  for name, (value, _) in values.items())
    )
    _output(content, arguments.out, f'{len(values)} parameters in {arguments.out}'
            + (f'; left out: {", ".join(rest)}' if rest else ''))
    return 0


def _shared_filter(firmware: Firmware, gains: Mapping[str, float]) -> Iterator[str]:
    """A warning for each axis whose D filter is not the lowest, where all axes share one."""
    rows = () if firmware.table is None else firmware.table.rows
    if not any(row.ours == D_FILTER and '{' not in row.parameter for row in rows):
        return
    cutoffs = {axis: gains[f'{axis}.{D_FILTER}'] for axis in AXES
               if f'{axis}.{D_FILTER}' in gains and gains[f'{axis}.rate.kd']}
    lowest = min(cutoffs.values(), default=0.0)
    for axis, hz in cutoffs.items():
        if hz > (1.0 + DIFFERS) * lowest:
            yield (f'Warning: {axis} was designed with D filtered at {hz:.3g} Hz. Here all axes '
                   f'share {lowest:.3g} Hz, with which it has not the margins of the design.')


def _out_of_range(firmware: Firmware,
                  values: Mapping[str, tuple[float, str]]) -> Iterator[str]:
    """A line for each parameter that the autopilot's own list does not allow."""
    for name, (low, high) in {} if firmware.table is None else firmware.table.ranges.items():
        if name in values and not low <= (value := float(f'{values[name][0]:.6g}')) <= high:
            yield (f"Out of range: {name} = {value:g}; the autopilot's own is {low:g} to "
                   f'{high:g}, and the bridge would refuse it.')


def _output(content: str, out: Path | None, done: str) -> None:
    """Print a file's content, or write it and say that it is `done`."""
    if out is None:
        print(content, end='')
        return
    check_new(out)
    write_whole(out, content)
    print(done)


def _command_line(firmware: Firmware, arguments: argparse.Namespace) -> int:
    """Lines of a command line: the steps of the design in turn, each to be flown."""
    if arguments.scale:
        raise BadInputError('--scale', f'is not needed for {arguments.to}', None,
                            'how much of the range of the motors its P, I and D give is known')
    # the firmware's own range bounds them, see MOST
    gains, axes = read_gains(arguments.gains, bounded=False), read_axes(arguments.gains)
    flown = _flown(arguments.gains, axes)
    steps = _steps(gains, axes)
    rounded = [[line for line in cli_lines(firmware, step, {}, flown) if line.startswith('set')]
               for step in steps]
    steps = [step for step, own, later in zip(steps, rounded, [*rounded[1:], None], strict=True)
             if own != later]  # the firmware cannot tell these apart
    if not any(rounded):
        raise BadInputError(str(arguments.gains), f'holds no P, I, D, which {arguments.to} has',
                            remedy='design with --method pid')
    levels = {name: value / firmware.level for name, value in gains.items()
              if name in ('roll.angle.kp', 'pitch.angle.kp')}
    rest = left_out({name: value for name, value in gains.items() if name not in levels},
                    NEEDED[1:])
    notes = [f'Gains of {arguments.gains.name}, converted by quad-tune export', *firmware.notes,
             *(f'Not set: {name} {gains[name]:.6g} 1/s is {level:.0f} of the P of the level mode, '
               'which is one for roll and pitch' for name, level in levels.items()),
             *(f'Left out, it has no counterpart here: {one}' for one in rest),
             *_filters(gains, flown), *([] if flown else [NOT_STATED])]
    out = [f'# {line}' for line in notes]
    before = dict(flown)
    for number, step in enumerate(steps, 1):
        if len(steps) > 1:
            out.append(f'# step {number} of {len(steps)}: '
                       + ('fly it before the next' if number < len(steps) else 'the design'))
            out += [f'# with {name} {hz:.3g} Hz' for name, hz in step.items()
                    if name.endswith(D_FILTER)]
        out += [*firmware.head_lines, *cli_lines(firmware, step, before, flown), 'save']
        before = {**before, **step}
    _output('\n'.join(out) + '\n', arguments.out, f'{len(steps)} steps in {arguments.out}')
    return 0


def cli_lines(firmware: Firmware, gains: Mapping[str, float], before: Mapping[str, float],
              flown: Mapping[str, float]) -> list[str]:
    """`set` lines for gains by the contract's names, each with what it was before.

    Raises BadInputError where a value is outside the firmware's range.
    """
    out = []
    for axis in AXES:
        for gain, (parameter, unit) in firmware.cli.items():
            name = f'{axis}.{gain}'
            if name not in gains:
                continue
            whole = flown.get(RANGE_US, PIDSUM) if unit in INAV else PIDSUM
            unit_si = unit * DEGREES / (whole or PIDSUM)
            if (axis, gain, unit) == ('yaw', 'rate.ki', BETAFLIGHT[1]):
                unit_si *= flown.get(YAW_FACTOR, YAW_I)
            unit_si *= flown.get(f'{axis}.rate.tpa_{gain[-2:]}', 1.0)
            value, old = (round(known[name] / unit_si) if name in known and unit_si else None
                          for known in (gains, before))
            if value is None or not 0 <= value <= MOST:
                raise BadInputError(name, f'must be 0 to {MOST} in the unit of the firmware',
                                    value, 'it cannot have this gain')
            change = '' if old is None else f', from {old} ({value - old:+d})'
            out += [f'# {name} {gains[name]:.6g} / {unit_si:.6g}{change}',
                    f'set {parameter.format(axis)} = {value}']
    return out


def _steps(gains: Mapping[str, float], axes: Mapping[str, Mapping[str, Any]], *,
           to_gains: bool = False) -> list[dict[str, float]]:
    """The sets of gains on the way to the design, each of which keeps its margins.

    `to_gains`: without those beyond `gains`, which follow after another flight.
    """
    paths = {axis: tree.get('steps') or tree.get('gain_steps') or []
             for axis, tree in axes.items()}
    for axis, path in paths.items():
        if not (isinstance(path, list) and all(isinstance(step, dict) for step in path)):
            raise BadInputError(f'axes.{axis}.steps', 'must be a list of objects', repr(path),
                                AGAIN)
        own = [gains.get(f'{axis}.{name}') for name in NEEDED]
        ends = [k for k, step in enumerate(path, 1) if to_gains
                and [step.get(f'{axis}.{name}') for name in NEEDED] == own]
        paths[axis] = path[:min(ends, default=len(path))]
    out: list[dict[str, float]] = []
    for k in range(max((len(path) for path in paths.values()), default=0)):
        here = dict(gains)
        for axis, path in paths.items():
            step = path[min(k, len(path) - 1)] if path else {}
            here |= {n: finite(v, f'axes.{axis}.steps.{n}') for n, v in step.items() if n in gains}
        if not out or here != out[-1]:
            out.append(here)
    return out or [dict(gains)]


def _filters(gains: Mapping[str, float], flown: Mapping[str, float]) -> Iterator[str]:
    """A warning for each filter of the design that is not the aircraft's."""
    for axis in AXES:
        designed, has = (known.get(f'{axis}.{D_FILTER}') for known in (gains, flown))
        if designed is None:
            continue
        if not has:
            yield (f'Warning: the design filters D of {axis} at {designed:.3g} Hz (first order); '
                   'compare dterm_lpf*')
        elif abs(designed / has - 1.0) > DIFFERS:
            yield (f'Warning: the design filters D of {axis} at {designed:.3g} Hz (first order), '
                   f"the aircraft's low-passes together at {has:.3g} Hz: scale their cut-offs by "
                   f'{designed / has:.3g}')


def scales(items: list[str]) -> dict[str, float]:
    """`AXIS=NUMBER` options by axis."""
    out = {}
    for item in items:
        axis, _, number = item.partition('=')
        with suppress(ValueError):
            out[axis] = float(number)
        if axis not in AXES or not 0.0 < out.get(axis, 0.0) < float('inf'):
            raise BadInputError('--scale', 'needs AXIS=NUMBER above 0, AXIS of roll, pitch, yaw',
                                repr(item), 'such as roll=0.25')
    return out


def read_axes(path: Path) -> dict[str, Mapping[str, Any]]:
    """The part of a design or report on each axis that has gains; raises BadInputError."""
    tree = read_json(path, REMEDY)
    schema = tree.get('schema') if isinstance(tree, dict) else None
    if schema not in SCHEMAS:
        raise BadInputError(f'{path}: schema', f'must be {" or ".join(SCHEMAS)}', schema, REMEDY)
    axes = tree.get('axes')
    if not isinstance(axes, Mapping):
        raise BadInputError(f'{path}: axes', 'is missing', None, REMEDY)
    answered = {str(axis): one for axis, one in axes.items()
                if isinstance(one, Mapping) and isinstance(one.get('gains'), Mapping)}
    if not any(one['gains'] for one in answered.values()):
        raise BadInputError(f'{path}: gains', 'holds none',
                            remedy='the design was refused, or this is a model: run quad-tune '
                            'design MODEL.json --out gains.json first')
    return answered


def read_gains(path: Path, *, bounded: bool = True) -> dict[str, float]:
    """The gains of all axes in a design or report, SI: what is sent, before any target.

    Raises BadInputError naming file and field of what is no gain, not finite or, where `bounded`,
    outside the default bounds and what was flown; the bridge's gate has bounds of its own.
    """
    gains: dict[str, float] = {}
    axes = {axis: one for axis, one in read_axes(path).items()
            if axis not in EVERY or not EVERY[axis].outer}
    flown = _flown(path, axes)
    if not any(one['gains'] for one in axes.values()):
        raise BadInputError(f'{path}: gains', 'are of an outer loop of your own only, which no '
                            'firmware here has', remedy='design roll, pitch, yaw or climb')
    for axis, one in axes.items():
        for name, raw in one['gains'].items():
            where = f'{path}: axes.{axis}.gains.{name}'
            bound = DEFAULT_BOUNDS.get(name)
            if bound is None:
                raise BadInputError(where, 'is no gain that a design changes',
                                    remedy='docs/reference/gains.md lists them')
            gains[name] = value = finite(raw, where)
            most = max(bound.upper, flown.get(name, bound.upper))
            if bounded and not bound.lower <= value <= most:
                span = f'{bound.lower:g} .. {bound.upper:g} {ROWS[name].unit}'
                raise BadInputError(where, f'must lie in {span}', f'{value:g}', AGAIN)
    return gains


def _flown(path: Path, axes: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Gains and filters of the flights behind the designs. Raises BadInputError."""
    gains: dict[str, float] = {}
    for axis, one in axes.items():
        own, where = one.get('flown_gains', {}), f'{path}: axes.{axis}.flown_gains'
        if not isinstance(own, Mapping):
            raise BadInputError(where, 'must be an object', repr(own), AGAIN)
        gains |= {name: finite(value, f'{where}.{name}') for name, value in own.items()}
    return gains


def finite(value: object, where: str) -> float:
    """A number of a file; raises BadInputError naming the field."""
    if (isinstance(value, int | float) and not isinstance(value, bool)
            and abs(value) <= sys.float_info.max):  # as NaN is not
        return float(value)
    raise BadInputError(where, 'must be a finite number', repr(value), AGAIN)


def left_out(gains: Mapping[str, float], exported: Sequence[str] = NEEDED) -> list[str]:
    """Gains that act and are not exported, beside these and their filter, with their values."""
    names = {f'{axis}.{name}' for axis in AXES for name in (*exported, D_FILTER)}
    return [f'{name} {value:.6g}' for name, value in gains.items() if value and name not in names]


def parameters(firmware: Firmware, gains: Mapping[str, float],
               scale: Mapping[str, float]) -> dict[str, tuple[float, str]]:
    """Name → value and conversion, for gains by the contract's names; scale by axis.

    Raises BadInputError where an axis' gains are incomplete or negative, or its scale is missing.
    A name that all axes share has the lowest value.
    """
    out: dict[str, tuple[float, str]] = {}
    for axis in AXES:
        own = {k.partition('.')[2]: v for k, v in gains.items() if k.startswith(f'{axis}.')}
        for name, value, how in _of_axis(firmware, axis, own, scale.get(axis)) if own else ():
            if name not in out or value < out[name][0]:
                out[name] = value, how
    if not out:
        raise BadInputError('gains', 'hold none of roll, pitch, yaw',
                            remedy='give the file of quad-tune design --out')
    for axis in scale:
        if not any(name.startswith(f'{axis}.') for name in gains):
            raise BadInputError('--scale', 'names an axis without gains in the file', axis)
    return out


def _of_axis(firmware: Firmware, axis: str, own: Mapping[str, float],
             unit: float | None) -> Iterator[tuple[str, float, str]]:
    missing = [name for name in NEEDED if name not in own]
    if missing:
        raise BadInputError(f'gains of {axis}', f'lack {", ".join(missing)}',
                            remedy='take them from quad-tune design --out or report.json')
    if unit is None:
        raise BadInputError(
            f'--scale {axis}', 'is missing', None,
            f'give --scale {axis}=NUMBER, our command per unit of their torque: 1 where the model '
            'was identified on their torque set-points, else what quad-sysid import says')
    table = firmware.table
    if table is None:
        return
    axis_name = table.axes[AXES.index(axis)]
    rows = {row.ours: row for row in table.rows}
    yield (rows['angle.kp'].name(axis_name), own['angle.kp'],
           f'{axis}.angle.kp {own["angle.kp"]:.6g} 1/s')
    if table.multiplier:
        yield table.multiplier.format(axis_name), 1.0, 'P, I, D stand by themselves'
    for gain in NEEDED[1:]:
        if own[gain] < 0.0:
            raise BadInputError(f'{axis}.{gain}', 'must not be negative', own[gain])
        yield (rows[gain].name(axis_name), own[gain] / unit,
               f'{axis}.{gain} {own[gain]:.6g} / {unit:.6g}')
    if D_FILTER in own and own['rate.kd']:
        yield rows[D_FILTER].name(axis_name), own[D_FILTER], f'{axis}.rate.d_filter_hz, in Hz'
