"""`ros2 run quad_bridge sensors rest BAG`: the biases of an aircraft that stood still.

Wiring only: arguments, the bag, a YAML file. The maths is in rest.py.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import yaml

from quad_bridge.arguments import OneLineParser, ended_in_one_line, positive, say
from quad_bridge.errors import BadInputError, RefusedError
from quad_bridge.log.reader import read_topics
from quad_bridge.sensors.correction import STATUS, as_sent, from_values
from quad_bridge.sensors.rest import MIN_S, RestEstimate, estimate_at_rest
from quad_bridge.si import FloatArray

IMU, DIAGNOSTICS = '/imu/data', '/diagnostics'
KINDS = {IMU: 'sensor_msgs/msg/Imu', DIAGNOSTICS: 'diagnostic_msgs/msg/DiagnosticArray'}
MAX_AGE_S = 60.0
"""Difference of a message's age from its neighbours' above which its stamp is damaged."""
USUAL = 51  # so many messages around it


def at_rest(bag: Path, seconds: float, warnings: list[str]) -> RestEstimate:
    """The estimate of the first `seconds` of a bag, of the rates as the STM32 sent them.

    Lines about what is damaged go to `warnings`. Raises BadInputError and RefusedError.
    """
    read = read_topics(bag, KINDS)
    warnings += read.warnings
    received = read.messages[IMU]
    if not received:
        raise BadInputError(str(bag), f'holds no {IMU} ({KINDS[IMU]})', remedy='record it')
    headers = [message.content.header.stamp for message in received]
    stamps = np.array([10**9 * stamp.sec + stamp.nanosec for stamp in headers], np.int64)
    age = np.array([message.time_ns for message in received], float) - stamps
    neighbours = np.lib.stride_tricks.sliding_window_view(np.pad(age, USUAL // 2, 'edge'), USUAL)
    usual = np.median(neighbours, axis=1)  # of its neighbours: a system clock may have been set
    sound = np.flatnonzero(np.abs(age - usual) <= 1e9 * MAX_AGE_S)
    if len(sound) < len(stamps):
        count = len(stamps) - len(sound)
        warnings.append(f'{bag}: {count} {IMU} left out, their stamps cannot be')
    order = sound[np.argsort(stamps[sound], kind='stable')]
    order = order[stamps[order] - stamps[order[0]] <= 1e9 * seconds]
    messages, stamps = [received[k].content for k in order], stamps[order]
    corrections = [
        from_values({v.key: v.value for v in status.values})
        for message in read.messages[DIAGNOSTICS]
        for status in message.content.status
        if status.name.endswith(f': {STATUS}')
    ]
    rates = _rows([message.angular_velocity for message in messages])
    sent = as_sent(stamps, rates, [known for known in corrections if known is not None])
    forces = _rows([message.linear_acceleration for message in messages])
    try:
        return estimate_at_rest(1e-9 * (stamps - stamps[0]), sent, forces)
    except RefusedError as why:
        raise RefusedError(f'{bag}: {why}') from why


def _rows(vectors: Sequence[object]) -> FloatArray:
    """Vectors of messages as (n, 3)."""
    return np.array([[getattr(v, axis) for axis in 'xyz'] for v in vectors], dtype=float)


def _rest(args: argparse.Namespace) -> list[str]:
    if args.seconds < MIN_S:
        raise BadInputError('--seconds', f'must be {MIN_S:g} or more', f'{args.seconds:g}')
    estimate = at_rest(args.bag, args.seconds, args.warnings)
    if args.out is not None:
        _write(args.out, estimate, args.bag)
    bias, drift = (
        ', '.join(f'{v:+.5f}' for v in row) for row in (estimate.gyro_bias, estimate.gyro_drift)
    )
    return [
        f'gyro bias {bias} rad/s, drift {drift} rad/s per s over {estimate.duration_s:.0f} s',
        (
            f'gravity is measured {estimate.acceleration_norm_error:+.3f} m/s² off; level offset '
            f'roll {estimate.level[0]:+.4f} rad, pitch {estimate.level[1]:+.4f} rad'
        ),
    ]


def _write(path: Path, estimate: RestEstimate, bag: Path) -> None:
    """Write all figures, with time and bag, as YAML, over earlier ones. Raises BadInputError."""
    if path.is_file() and not _own(path):
        raise BadInputError(str(path), 'exists, and holds other things', remedy='name another')
    numbers = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(estimate).items()}
    now = datetime.now(tz=timezone.utc).isoformat(timespec='seconds')
    entry = {'measured': now, 'source': str(bag), **numbers}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = yaml.safe_dump({'sensors': {'rest': entry}}, sort_keys=False)
        path.write_text(text, encoding='utf-8')
    except OSError as error:
        raise BadInputError(str(path), f'cannot be written: {error.strerror}') from error


def _own(path: Path) -> bool:
    """Whether a file holds nothing but earlier figures."""
    try:
        tree = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, ValueError, yaml.YAMLError):
        return False
    return isinstance(tree, dict) and set(tree) == {'sensors'}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; exits with the contract's status."""
    parser = OneLineParser(
        prog='sensors', description='Biases, drift and level of an aircraft that stands still.'
    )
    parser.add_argument('what', choices=['rest'], metavar='rest', help='the aircraft stands still')
    parser.add_argument('bag', type=Path, metavar='BAG')
    parser.add_argument('--out', type=Path, metavar='FILE.yaml', help='where to write all figures')
    parser.add_argument(
        '--seconds', type=positive, default=np.inf, metavar='S',
        help=f'only the first so many, {MIN_S:g} or more; default the whole bag',
    )  # fmt: skip
    args = parser.parse_args(arguments, argparse.Namespace(warnings=[]))
    try:
        lines = ended_in_one_line('sensors', lambda: _rest(args))
    finally:  # they may be why it was refused
        sys.stderr.writelines(f'sensors: warning: {warning}\n' for warning in args.warnings)
    say('\n'.join(lines) + '\n')
