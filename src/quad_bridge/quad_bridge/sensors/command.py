"""`ros2 run quad_bridge sensors …`: biases, compass and vibration from a bag.

Wiring only: arguments, the bag, the aircraft's YAML. The maths is in the room `sensors`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from quad_bridge.arguments import OneLineParser, ended_in_one_line, positive, say
from quad_bridge.errors import BadInputError, RefusedError
from quad_bridge.log.reader import read_topics
from quad_bridge.sensors import aircraft_file, compass, rest, vibration
from quad_bridge.sensors.correction import STATUS, as_sent, from_values

IMU, MAG, DIAGNOSTICS = '/imu/data', '/imu/mag', '/diagnostics'
KINDS = {
    IMU: 'sensor_msgs/msg/Imu',
    MAG: 'sensor_msgs/msg/MagneticField',
    DIAGNOSTICS: 'diagnostic_msgs/msg/DiagnosticArray',
}
MOST_AGE_S = 60.0
"""Difference of a message's age from its neighbours' above which its stamp is damaged."""
USUAL = 51  # so many messages around it


class _Series(NamedTuple):
    """One topic of a bag in the order of its stamps, with the bag's corrections."""

    stamps_ns: npt.NDArray[np.int64]
    messages: list[Any]
    statuses: list[Any]

    @property
    def times(self) -> rest.FloatArray:
        """Stamps in s from the first."""
        return np.asarray(1e-9 * (self.stamps_ns - self.stamps_ns[0]), dtype=float)

    def xyz(self, field: str) -> rest.FloatArray:
        """The vectors (n, 3) of one field."""
        vectors = [getattr(message, field) for message in self.messages]
        return np.array([[v.x, v.y, v.z] for v in vectors], dtype=float)

    def as_sent(self, field: str, offset: str) -> rest.FloatArray:
        """The same as the STM32 sent them; `offset` names what the bridge may have subtracted."""
        told = [from_values({v.key: v.value for v in s.values}) for s in self.statuses]
        known = [one for one in told if one is not None]
        return as_sent(self.stamps_ns, self.xyz(field), known, offset)


def _series(given: argparse.Namespace, topic: str, seconds: float = np.inf) -> _Series:
    """The first `seconds` of one topic."""
    bag = read_topics(given.bag, {topic: KINDS[topic], DIAGNOSTICS: KINDS[DIAGNOSTICS]})
    given.warnings += bag.warnings
    received = bag.messages[topic]
    if not received:
        what = f'holds no {topic} ({KINDS[topic]})'
        raise BadInputError(str(given.bag), what, remedy='record it')
    headers = [one.content.header.stamp for one in received]
    stamps = np.array([10**9 * stamp.sec + stamp.nanosec for stamp in headers], np.int64)
    age = np.array([one.time_ns for one in received], float) - stamps
    around = np.lib.stride_tricks.sliding_window_view(np.pad(age, USUAL // 2, 'edge'), USUAL)
    usual = np.median(around, axis=1)  # of those around it: a system clock may have been set
    sound = np.flatnonzero(np.abs(age - usual) <= 1e9 * MOST_AGE_S)
    if len(sound) < len(stamps):
        count = len(stamps) - len(sound)
        given.warnings.append(f'{given.bag}: {count} {topic} left out, their stamps cannot be')
    order = sound[np.argsort(stamps[sound], kind='stable')]
    order = order[stamps[order] - stamps[order[0]] <= 1e9 * seconds]
    statuses = [s for one in bag.messages[DIAGNOSTICS] for s in one.content.status]
    own = [s for s in statuses if s.name.endswith(f': {STATUS}')]
    return _Series(stamps[order], [received[k].content for k in order], own)


def _rest(given: argparse.Namespace) -> list[str]:
    bag = _series(given, IMU, given.seconds)
    gyro = bag.as_sent('angular_velocity', 'gyro_bias')
    found = rest.estimate_at_rest(bag.times, gyro, bag.xyz('linear_acceleration'))
    _keep(given, 'rest', found)
    bias, drift = (
        ', '.join(f'{v:+.5f}' for v in values) for values in (found.gyro_bias, found.gyro_drift)
    )
    return [
        f'gyro bias {bias} rad/s, drift {drift} rad/s per s over {found.duration_s:.0f} s',
        (
            f'gravity is measured {found.acceleration_norm_error:+.3f} m/s² off; level offset '
            f'roll {found.level[0]:+.4f} rad, pitch {found.level[1]:+.4f} rad'
        ),
    ]


def _compass(given: argparse.Namespace) -> list[str]:
    found = compass.hard_iron(_series(given, MAG).as_sent('magnetic_field', 'hard_iron'))
    _keep(given, 'compass', found)
    offset = ', '.join(f'{1e6 * v:+.2f}' for v in found.offset)
    radius, misfit = 1e6 * found.field, 100 * found.misfit
    return [f'hard-iron offset {offset} µT, field {radius:.1f} µT, {misfit:.1f} % off a sphere']


def _vibration(given: argparse.Namespace) -> list[str]:
    bag = _series(given, IMU)
    step_s = float(np.median(np.diff(bag.times))) if len(bag.messages) > 1 else 0.0
    if step_s <= 0.0:
        raise RefusedError(f'{len(bag.messages)} samples of {IMU}, their stamps do not rise')
    lines = []
    for name, unit in (('angular_velocity', 'rad/s'), ('linear_acceleration', 'm/s²')):
        signal = bag.xyz(name)
        peak = vibration.strongest(signal, 1.0 / step_s, given.filter_hz)
        if peak is None:
            raise RefusedError(
                f'{len(signal)} samples of {name} at {1.0 / step_s:.0f} Hz show none: too few, '
                f'not all finite, or nothing above {vibration.LOWEST_HZ:g} Hz'
            )
        verdict = 'covers it' if peak.covered else 'does not cover it'
        lines.append(
            f'{name} {peak.axis}: {peak.amplitude:.3g} {unit} at {peak.frequency_hz:.1f} Hz '
            f'({100 * peak.share:.0f} % of the vibration); the {given.filter_hz:g} Hz filter '
            f'{verdict} (gain {peak.filter_gain:.2f})'
        )
    return lines


def _keep(given: argparse.Namespace, name: str, found: Any) -> None:
    if given.out is not None:
        now = datetime.now(tz=timezone.utc)
        aircraft_file.write(given.out, {name: aircraft_file.entry(found, now, str(given.bag))})


def _parser() -> OneLineParser:
    parser = OneLineParser(prog='sensors', description="How good an aircraft's sensors are.")
    kinds = parser.add_subparsers(required=True, metavar='WHAT')
    for name, run, text in (
        ('rest', _rest, 'biases, drift, level of an aircraft that stands still'),
        ('compass', _compass, 'hard-iron offsets while it is turned about all axes'),
        ('vibration', _vibration, 'the strongest vibration of a flight'),
    ):
        kind = kinds.add_parser(name, help=text, description=text)
        kind.add_argument('bag', type=Path, metavar='BAG')
        kind.set_defaults(run=run)
        if name == 'vibration':
            kind.add_argument('--filter-hz', type=positive, default=42.0, help="the gyro filter's")
        else:
            kind.add_argument('--out', type=Path, metavar='AIRCRAFT.yaml', help='kept there')
        if name == 'rest':
            kind.add_argument('--seconds', type=positive, default=np.inf, help='the first so many')
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; exits with the contract's status."""
    given = _parser().parse_args(arguments, argparse.Namespace(warnings=[]))
    try:
        lines = ended_in_one_line('sensors', lambda: given.run(given))
    finally:  # they may be why it was refused
        sys.stderr.writelines(f'sensors: warning: {warning}\n' for warning in given.warnings)
    say('\n'.join(lines) + '\n')
