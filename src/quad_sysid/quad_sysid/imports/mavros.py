"""A bag of mavros → ForeignLog. mavros turns the autopilot's frames to ours (REP-103) itself.

The outputs to the motors are in the autopilot's own order: the motion shows what they do.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from quad_sysid.bags.orientation import euler_from_quaternion
from quad_sysid.contract import FloatArray
from quad_sysid.craft import RANGE_US
from quad_sysid.errors import BadInputError
from quad_sysid.imports.clock import Stream
from quad_sysid.imports.log import DEMAND_ONLY, ForeignLog, Reading, Signal, within
from quad_sysid.imports.mixers import MIRROR
from quad_sysid.imports.rosbag import of_one_aircraft
from quad_sysid.imports.table import Table

TOPIC = re.compile(r'^(?P<place>(?:/[^/.]+)*?)/mavros/(?P<topic>[^.]+)\.')
"""A topic of mavros: whose, and its name."""
MIN_PULSE = 800.0
"""µs. A channel that never gives more is not a motor's."""
FASTER = ('ask the autopilot for faster messages (service /mavros/set_message_interval), or '
          'import its own log')
NO_GAINS = ("the controller's gains: no closed loop, no gain design (the autopilot's own log has "
            'them)')


def _angles(values: FloatArray) -> FloatArray:
    out = euler_from_quaternion(values)
    out[:, 2] = np.unwrap(out[:, 2])
    return np.asarray(out)


SIGNALS = (
    *(Signal('rates', within(topic, *(f'angular_velocity.{x}' for x in 'xyz')), 'rad/s',
             'as it is, the frame is ours') for topic in ('imu/data_raw', 'imu/data')),
    Signal('angles', within('imu/data', *(f'orientation.{x}' for x in 'xyzw')), '1', 'as it is',
           _angles),
    Signal('acceleration', within('imu/data', *(f'linear_acceleration.{x}' for x in 'xyz')),
           'm/s²', 'as it is'),
    *(Signal('attitude_setpoint', within(topic, *(f'{field}.{x}' for x in 'xyzw')), '1',
             'as it is', _angles) for topic, field in (
        ('setpoint_raw/target_attitude', 'orientation'), ('setpoint_raw/attitude', 'orientation'),
        ('setpoint_attitude/attitude', 'pose.orientation'))),
    *(Signal('rate_setpoint', within(topic, *(f'{field}.{x}' for x in 'xyz')), 'rad/s', 'as it is')
      for topic, field in (('setpoint_raw/target_attitude', 'body_rate'),
                           ('setpoint_raw/attitude', 'body_rate'))),
    Signal('battery', within('battery', 'voltage'), 'V', 'as it is'),
)
TOPICS = {*(signal.columns[0].partition('.')[0] for signal in SIGNALS), 'rc/out',
          'target_actuator_control'}
CONTROLS = within('target_actuator_control', *(f'controls[{i}]' for i in (3, 0, 1, 2)))


def is_bag(topics: Mapping[str, str]) -> bool:
    """Whether a bag with these topics holds what mavros says of an autopilot."""
    names = [match['topic'] for topic in topics if (match := TOPIC.match(f'{topic}.'))]
    return any(name in ('imu/data', 'imu/data_raw') for name in names)


def read(path: Path, messages: Path | None = None) -> ForeignLog:
    """Read a bag of mavros; raises BadInputError where it lacks rates or commands."""
    columns, times, notes = of_one_aircraft(path, TOPIC, TOPICS, messages)
    table = Table(str(path), columns, times, notes=notes)
    reading = Reading(table)
    reading.take(*SIGNALS)
    if 'rates' not in reading.streams:
        raise BadInputError(table.source, 'holds no mavros/imu/data', table.messages, FASTER)
    warnings: list[str] = []
    channels = _channels(table)
    motors = table.stream(*channels) if channels else None
    command = table.stream(*CONTROLS)
    if reading.motors_fast(motors, command):
        low, high = RANGE_US
        reading.take(Signal('motors', channels, 'µs', f'(pulse - {low:g}) / {high - low:g}; U by '
                            'what the motion shows',
                            lambda v: np.clip((v - low) / (high - low), 0.0, 1.0)))
    elif command is not None:
        reading.put(Signal('control', CONTROLS, '-1..1', 'as it is, pitch and yaw turned'),
                    Stream(command.time_s, command.values * [1.0, *MIRROR]))
        warnings.append(DEMAND_ONLY)
    else:
        raise BadInputError(table.source, 'holds no mavros/rc/out and no target_actuator_control',
                            table.messages, f'record /mavros/rc/out; {FASTER}')
    return reading.log('a bag of mavros', SIGNALS, no_gains=NO_GAINS, faster=FASTER,
                       warnings=tuple(warnings))


def _channels(table: Table) -> tuple[str, ...]:
    """The first channels of rc/out that move as motors do."""
    used = [name for i in range(8) if (name := f'rc/out.channels[{i}]') in table.columns
            and np.nanmax(table.columns[name]) > MIN_PULSE]
    count = max((n for n in (4, 6, 8) if n <= len(used)), default=0)
    return tuple(used[:count])
