"""`ros2 run quad_bridge sensors …`: biases, compass, vibration from a bag, the bench by hand.

Wiring only: arguments, the bag, the aircraft's YAML. The maths is in the room `sensors`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from quad_bridge.arguments import OneLineParser, ended_in_one_line, positive, say
from quad_bridge.errors import BadInputError, RefusedError
from quad_bridge.log.reader import read_topics
from quad_bridge.sensors import aircraft_file, by_hand, compass, rest, vibration
from quad_bridge.sensors.correction import STATUS, Correction, as_sent, from_values

IMU, MAG, DIAGNOSTICS = '/imu/data', '/imu/mag', '/diagnostics'
KINDS = {
    IMU: 'sensor_msgs/msg/Imu',
    MAG: 'sensor_msgs/msg/MagneticField',
    DIAGNOSTICS: 'diagnostic_msgs/msg/DiagnosticArray',
}
MOST_AGE_S = 60.0
"""A message whose age differs by more from that of those around it has a damaged stamp."""
USUAL = 51
"""So many messages around it."""


@dataclass(frozen=True)
class _Series:
    """One topic of a bag, and what the bridge says it has subtracted from it."""

    stamps_ns: npt.NDArray[np.int64]
    messages: list[Any]
    told: list[Correction]

    @property
    def times(self) -> rest.FloatArray:
        """Stamps in s from the first."""
        return np.asarray(1e-9 * (self.stamps_ns - self.stamps_ns[0]), dtype=float)

    def as_sent(self, vectors: Sequence[Any], name: str) -> rest.FloatArray:
        """Vectors (n, 3) as the STM32 sent them."""
        return as_sent(self.stamps_ns, _xyz(vectors), self.told, name)


def _series(given: argparse.Namespace, topic: str, seconds: float = np.inf) -> _Series:
    """Stamps and messages of one topic, the first `seconds` of them."""
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
    statuses = [s for s in statuses if s.name.endswith(f': {STATUS}')]
    told = [from_values({v.key: v.value for v in s.values}) for s in statuses]
    return _Series(
        stamps[order],
        [received[k].content for k in order],
        [one for one in told if one is not None],
    )


def _xyz(vectors: Sequence[Any]) -> rest.FloatArray:
    return np.array([[v.x, v.y, v.z] for v in vectors], dtype=float)


def _rest(given: argparse.Namespace) -> list[str]:
    bag = _series(given, IMU, given.seconds)
    gyro = bag.as_sent([m.angular_velocity for m in bag.messages], 'gyro_bias')
    felt = _xyz([m.linear_acceleration for m in bag.messages])
    found = rest.estimate_at_rest(bag.times, gyro, felt)
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
    bag = _series(given, MAG)
    sent = bag.as_sent([m.magnetic_field for m in bag.messages], 'hard_iron')
    found = compass.hard_iron(sent)
    _keep(given, 'compass', found)
    offset = ', '.join(f'{1e6 * v:+.2f}' for v in found.offset)
    return [
        (
            f'hard-iron offset {offset} µT, field {1e6 * found.field:.1f} µT, '
            f'{100 * found.misfit:.1f} % off a sphere'
        )
    ]


def _vibration(given: argparse.Namespace) -> list[str]:
    bag = _series(given, IMU)
    times, messages = bag.times, bag.messages
    step_s = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if step_s <= 0.0:
        raise RefusedError(f'{len(times)} samples of {IMU}, their stamps do not rise')
    lines = []
    for name, unit in (('angular_velocity', 'rad/s'), ('linear_acceleration', 'm/s²')):
        signal = _xyz([getattr(m, name) for m in messages])
        peak = vibration.strongest(signal, 1.0 / step_s, given.filter_hz)
        if peak is None:
            raise RefusedError(
                f'{len(signal)} samples of {name} at {1.0 / step_s:.0f} Hz show none: too few, '
                f'not all finite, or nothing above {vibration.LOWEST_HZ:g} Hz'
            )
        verdict = 'covers it' if peak.covered else 'does not cover it'
        lines.append(
            f'{name} {peak.axis}: {peak.amplitude:.3g} {unit} at {peak.frequency_hz:.1f} Hz '
            f'({100 * peak.share:.0f} % of what shakes); the {given.filter_hz:g} Hz filter '
            f'{verdict} (gain {peak.filter_gain:.2f})'
        )
    return lines


def _inertia(given: argparse.Namespace) -> list[str]:
    value = by_hand.bifilar_inertia(given.mass, given.distance, given.length, given.period)
    return [f'{value:.5f} kg m²: one of inertia_kg_m2 in the airframe section']


def _thrust(given: argparse.Namespace) -> list[str]:
    try:
        lines = given.table.read_text(encoding='utf-8').splitlines()
        rows = [line for line in lines if line.partition('#')[0].strip()]
        table = np.loadtxt(rows, delimiter=',', ndmin=2) if rows else np.empty((0, 2))
    except (OSError, ValueError) as error:
        remedy = 'two columns, command and thrust in N, separated by a comma'
        raise BadInputError(str(given.table), f'cannot be read: {error}', remedy=remedy) from error
    if table.shape[1] != 2:
        raise BadInputError(str(given.table), 'needs two columns', table.shape[1])
    found = by_hand.thrust_curve(table[:, 0], table[:, 1])
    return [
        (
            f'full_thrust_n: {found.full_thrust_n:.3f}, curvature {found.curvature:.3f} of '
            f'effects.thrust_curve; {100 * found.misfit:.1f} % of it unexplained'
        )
    ]


def _keep(given: argparse.Namespace, name: str, found: Any) -> None:
    if given.out is not None:
        now = datetime.now(tz=timezone.utc)
        aircraft_file.write(given.out, {name: aircraft_file.entry(found, now, str(given.bag))})


def _parser() -> OneLineParser:
    parser = OneLineParser(prog='sensors', description="What an aircraft's sensors are worth.")
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
    kind = kinds.add_parser('inertia', help='moment of inertia by a swing on two strings')
    for name, text in (('mass', 'kg'), ('distance', 'm between the strings'),
                       ('length', 'm of a string'), ('period', 's of one swing')):  # fmt: skip
        kind.add_argument(f'--{name}', type=float, required=True, help=text)
    kind.set_defaults(run=_inertia)
    kind = kinds.add_parser('thrust', help='thrust curve of a motor on a scale')
    kind.add_argument('table', type=Path, metavar='CSV', help='command 0..1, thrust in N')
    kind.set_defaults(run=_thrust)
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; exits with the contract's status."""
    given = _parser().parse_args(arguments, argparse.Namespace(warnings=[]))
    try:
        lines = ended_in_one_line('sensors', lambda: given.run(given))
    finally:  # they may be why it was refused
        sys.stderr.writelines(f'sensors: warning: {warning}\n' for warning in given.warnings)
    say('\n'.join(lines) + '\n')
