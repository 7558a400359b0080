"""`quad-tune export`: gains of the contract as a parameter file of PX4 or ArduPilot.

Ours: u = kp e + ki ∫e dt - kd d(rate)/dt in normalised command per rad/s, C1 in 1/s (contract).
Theirs: the same in their own unit of torque, -1..1. `scale` is our U per unit of their torque: 1
where the model was identified from their torque set-points (quad-sysid import says so), else the
factor of their mixer; a design does not tell which, so it is asked for. Each conversion is written
out as a comment, and so is what has no counterpart.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quad_sysid.arguments import Commands, command
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError
from quad_sysid.files import check_new, read_json, write_whole
from quad_tuning.autopilot_table import ARDUPILOT, D_FILTER, PX4, Table
from quad_tuning.gain_table import DEFAULT_BOUNDS, ROWS

DESIGN = 'quad_tuning/design/1'
SCHEMAS = (DESIGN, 'quad_sysid/report/1')
"""Of the files that hold gains."""
REMEDY, AGAIN = 'give the file of quad-tune design --out, or a report.json', 'design again'
NEEDED = ('angle.kp', 'rate.kp', 'rate.ki', 'rate.kd')


@dataclass(frozen=True)
class Firmware:
    """How a firmware's file of parameters looks; its names are the table's."""

    table: Table
    notes: tuple[str, ...]
    """What has no counterpart."""
    head: str = ''
    row: str = '{name},{value:.9g}'


PX4_NOTES = (
    ('PX4 differentiates the measured rate, as ours; its D filter (IMU_DGYRO_CUTOFF) is of second '
     'order and one for all axes: the lowest.'),
    'MC_*RATE_K is set to 1, so that P, I and D are not multiplied by it.',
)
ARDUPILOT_NOTES = (
    ('ArduPilot differentiates the error, ours the measured rate: the answer to a reference is '
     'quicker there, that to a disturbance the same.'),
    ('Its input shaping (ATC_ACCEL_*) and its filters of target and error (FLTT, FLTE) are not '
     'part of our loop.'),
)
FIRMWARES = {
    'px4': Firmware(PX4, PX4_NOTES, '# Vehicle-Id\tComponent-Id\tName\tValue\tType (9: float)\n',
                    '1\t1\t{name}\t{value:.9g}\t9'),
    'ardupilot': Firmware(ARDUPILOT, ARDUPILOT_NOTES),
}


def add(commands: Commands) -> None:
    """Register the command."""
    parser = command(
        commands, 'export', run,
        'Write designed gains as a parameter file of PX4 or ArduPilot, with each conversion as a '
        'comment.',
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
    gains = read_gains(arguments.gains)
    found = parameters(firmware, gains, scales(arguments.scale))
    rest = left_out(gains)
    content = (
        f'# Gains of {arguments.gains.name}, converted by quad-tune export\n'
        + ''.join(f'# {note}\n' for note in firmware.notes)
        + ''.join(f'# Left out, it has no counterpart here: {note}\n' for note in rest)
        + firmware.head
        + ''.join(f'# {name} = {how}\n' for name, (_, how) in found.items())
        + ''.join(firmware.row.format(name=name, value=value) + '\n'
                  for name, (value, _) in found.items())
    )
    if arguments.out is None:
        print(content, end='')
        return 0
    check_new(arguments.out)
    write_whole(arguments.out, content)
    print(f'{len(found)} parameters in {arguments.out}'
          + (f'; left out: {", ".join(rest)}' if rest else ''))
    return 0


def scales(items: list[str]) -> dict[str, float]:
    """`AXIS=NUMBER` options by axis."""
    out = {}
    for item in items:
        axis, _, number = item.partition('=')
        with suppress(ValueError):
            out[axis] = float(number)
        if axis not in AXES or not 0.0 < out.get(axis, 0.0) < float('inf'):
            raise BadInputError('--scale', 'needs AXIS=NUMBER', repr(item), 'such as roll=0.25')
    return out


def read_axes(path: Path) -> dict[str, Mapping[str, Any]]:
    """What a design or report says of each axis that has gains. Raises BadInputError."""
    tree = read_json(path)
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
    outside the default bounds; the bridge's gate has bounds of its own.
    """
    found: dict[str, float] = {}
    for axis, one in read_axes(path).items():
        for name, given in one['gains'].items():
            where = f'{path}: axes.{axis}.gains.{name}'
            bound = DEFAULT_BOUNDS.get(name)
            if bound is None:
                raise BadInputError(where, 'is no gain that a design changes',
                                    remedy='docs/reference/gains.md lists them')
            found[name] = value = finite(given, where)
            if bounded and not bound.lower <= value <= bound.upper:
                span = f'{bound.lower:g} .. {bound.upper:g} {ROWS[name].unit}'
                raise BadInputError(where, f'must lie in {span}', f'{value:g}', AGAIN)
    return found


def finite(value: object, where: str) -> float:
    """A number of a file; raises BadInputError naming the field."""
    if (isinstance(value, int | float) and not isinstance(value, bool)
            and abs(value) <= sys.float_info.max):  # as NaN is not
        return float(value)
    raise BadInputError(where, 'must be a finite number', repr(value), AGAIN)


def left_out(gains: Mapping[str, float]) -> list[str]:
    """Gains that act and are not exported, with their values."""
    return [f'{name} {value:.6g}' for name, value in gains.items()
            if value and name.partition('.')[2] not in {*NEEDED, D_FILTER}]


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
    lacking = [name for name in NEEDED if name not in own]
    if lacking:
        raise BadInputError(f'gains of {axis}', f'lack {", ".join(lacking)}',
                            remedy='take them from quad-tune design --out or report.json')
    if unit is None:
        raise BadInputError(
            f'--scale {axis}', 'is missing', None,
            'our command per unit of their torque: 1 where the model was identified on their '
            'torque set-points (quad-sysid import says so), else the factor of their mixer')
    theirs = firmware.table.axes[AXES.index(axis)]
    rows = {row.ours: row for row in firmware.table.rows}
    yield (rows['angle.kp'].name(theirs), own['angle.kp'],
           f'{axis}.angle.kp {own["angle.kp"]:.6g} 1/s')
    if firmware.table.multiplier:
        yield firmware.table.multiplier.format(theirs), 1.0, 'P, I, D stand by themselves'
    for ours in NEEDED[1:]:
        if own[ours] < 0.0:
            raise BadInputError(f'{axis}.{ours}', 'must not be negative', own[ours])
        yield (rows[ours].name(theirs), own[ours] / unit,
               f'{axis}.{ours} {own[ours]:.6g} / {unit:.6g}')
    if D_FILTER in own:
        yield rows[D_FILTER].name(theirs), own[D_FILTER], f'{axis}.rate.d_filter_hz, in Hz'
