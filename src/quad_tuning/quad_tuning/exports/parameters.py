"""Gains of the contract → parameters of PX4 and ArduPilot, with each conversion written out.

Ours: u = kp e + ki ∫e dt - kd d(rate)/dt in normalised command per rad/s, C1 in 1/s (contract).
Theirs: the same in their own unit of torque, -1..1. `scale` is our U per unit of their torque: 1
where the model was identified from their torque set-points (quad-sysid import says so), else the
factor of their mixer. No files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError

PX4 = 'px4'
ARDUPILOT = 'ardupilot'

NAMES: Mapping[str, Mapping[str, Any]] = {
    PX4: {'axes': ('ROLL', 'PITCH', 'YAW'), 'angle': 'MC_{}_P', 'rate': 'MC_{}RATE_{}',
          'filter': 'IMU_DGYRO_CUTOFF'},
    ARDUPILOT: {'axes': ('RLL', 'PIT', 'YAW'), 'angle': 'ATC_ANG_{}_P', 'rate': 'ATC_RAT_{}_{}',
                'filter': 'ATC_RAT_{}_FLTD'},
}
FIRMWARES = tuple(NAMES)

NOTES: Mapping[str, tuple[str, ...]] = {
    PX4: (
        ('PX4 differentiates the measured rate, as ours; its D filter (IMU_DGYRO_CUTOFF) is of '
        'second order and one for all axes.'),
        'MC_*RATE_K is set to 1, so that P, I and D are not multiplied by it.',
    ),
    ARDUPILOT: (
        ('ArduPilot differentiates the error, ours the measured rate: the answer to a reference '
         'is quicker there, that to a disturbance the same.'),
        ('Its input shaping (ATC_ACCEL_*) and its filters of target and error (FLTT, FLTE) are '
         'not part of our loop.'),
    ),
}
"""What has no counterpart."""


@dataclass(frozen=True)
class Line:
    """One parameter with its origin."""

    name: str
    value: float
    how: str
    """The conversion with its numbers."""


def lines(firmware: str, gains: Mapping[str, float], scale: Mapping[str, float]) -> list[Line]:
    """Parameters for `gains` (the contract's names, any axes); scale by axis, default 1.

    Raises BadInputError where an axis' gains are incomplete, negative or the scale is not above 0.
    """
    out: list[Line] = []
    for axis in AXES:
        own = {k.partition('.')[2]: v for k, v in gains.items() if k.startswith(f'{axis}.')}
        if not own:
            continue
        lacking = [n for n in ('angle.kp', 'rate.kp', 'rate.ki', 'rate.kd') if n not in own]
        if lacking:
            raise BadInputError(f'gains of {axis}', f'lack {", ".join(lacking)}',
                                remedy='take them from quad-tune design --out or report.json')
        unit = scale.get(axis, 1.0)
        if not 0.0 < unit < float('inf'):
            raise BadInputError('--scale', f'{axis} must be a positive number', unit)
        out += _lines(firmware, axis, own, unit)
    if not out:
        raise BadInputError('gains', 'hold none of roll, pitch, yaw',
                            remedy='give the file of quad-tune design --out')
    return out


def _lines(firmware: str, axis: str, own: Mapping[str, float], unit: float) -> list[Line]:
    """The parameters of one axis."""
    names = NAMES[firmware]
    name = names['axes'][AXES.index(axis)]
    out = [Line(names['angle'].format(name), own['angle.kp'],
                f'{axis}.angle.kp {own["angle.kp"]:.6g} 1/s')]
    if firmware == PX4:
        out.append(Line(f'MC_{name}RATE_K', 1.0, 'P, I, D stand by themselves'))
    for letter, ours in (('P', 'rate.kp'), ('I', 'rate.ki'), ('D', 'rate.kd')):
        value = own[ours]
        if value < 0.0:
            raise BadInputError(f'{axis}.{ours}', 'must not be negative', value)
        out.append(Line(names['rate'].format(name, letter), value / unit,
                        f'{axis}.{ours} {value:.6g} / {unit:.6g}'))
    if 'rate.d_filter_hz' in own:
        out.append(Line(names['filter'].format(name), own['rate.d_filter_hz'],
                        f'{axis}.rate.d_filter_hz, in Hz'))
    return out


def text(firmware: str, found: list[Line], source: str) -> str:
    """The parameter file for the firmware's ground stations.

    PX4 has one cut-off of the D filter for all axes: the lowest is written.
    """
    kept: dict[str, Line] = {}
    for line in found:
        if line.name not in kept or line.value < kept[line.name].value:
            kept[line.name] = line
    head = [f'# Gains of {source}, converted by quad-tune export', *(
        f'# {note}' for note in NOTES[firmware]
    )]
    body = [f'# {line.name} = {line.how}' for line in kept.values()]
    if firmware == PX4:
        head.append('# Vehicle-Id\tComponent-Id\tName\tValue\tType (9: float)')
        rows = [f'1\t1\t{line.name}\t{line.value:.9g}\t9' for line in kept.values()]
    else:
        rows = [f'{line.name},{line.value:.9g}' for line in kept.values()]
    return '\n'.join([*head, *body, *rows]) + '\n'
