"""A PX4 log → ForeignLog: a ULog, by pyulog, or a bag of px4_msgs. PX4 1.9 to 1.16.

The input is the motors' commands where they were logged about as fast as the gyro, else the
controller's torque and thrust. Source of names: PX4's uORB message definitions.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quad_sysid.autopilot_table import PX4, Units
from quad_sysid.contract import AXES, FloatArray
from quad_sysid.craft import LAYOUTS, Craft, of_px4
from quad_sysid.errors import BadInputError
from quad_sysid.files import read_by_library
from quad_sysid.imports.clock import EPOCH_S, Stream
from quad_sysid.imports.dataflash import RESTART_S, restarts
from quad_sysid.imports.experiments import runs_of
from quad_sysid.imports.log import (
    DEMAND_ONLY,
    RPM,
    Experiment,
    ForeignLog,
    Reading,
    Signal,
    changes_of,
    per_torque,
    within,
)
from quad_sysid.imports.mixers import MIRROR, enu, mirrored, ned_angles
from quad_sysid.imports.rosbag import of_one_aircraft
from quad_sysid.imports.table import Change, Table

ARMED = 2
"""arming_state of vehicle_status."""
MULTIROTORS = (2, 3, 13, 14, 15, 29, 35)
"""MAV_TYPE of those that fly by their rotors alone."""
FIRST_MOTOR = 101
"""actuator_function of motor 1."""
FREE = (0.02, 0.98)
"""Commands between which a motor is at none of its ends."""
LINEAR = 0.98
"""R² of motors over torque set-point from which PX4's gains can be stated in our unit."""
FASTER = ('set SDLOG_PROFILE to 25, that is bit 4 (high rate) and bit 3 (system identification) '
          'beside bit 0, and restart')
FASTER_BAG = ('bridge the topics at the full rate (dds_topics.yaml of the uXRCE-DDS client), or '
              f'log on board: {FASTER}')
AUTOTUNE = 'autotune_attitude_control_status'
"""Topic of PX4's autotune: the rate that it asks for besides the pilot's, and its state."""
IN_BAG = re.compile(r'^(?P<place>(?:/[^/.]+)*?)/fmu/(?P<way>in|out)/(?P<topic>\w+?)(?:_v\d+)?\.')
"""A topic of px4_msgs: whose, whether the autopilot hears or says it, and its name on board."""


def _vector(topic: str, field: str, size: int = 3) -> tuple[str, ...]:
    return within(topic, *(f'{field}[{i}]' for i in range(size)))


SIGNALS = (
    Signal('rates', _vector('vehicle_angular_velocity', 'xyz'), 'rad/s',
           'FRD to FLU: pitch and yaw turned', mirrored),
    Signal('rates', _vector('sensor_combined', 'gyro_rad'), 'rad/s',
           'FRD to FLU: pitch and yaw turned', mirrored),
    Signal('angles', _vector('vehicle_attitude', 'q', 4), '1', 'FRD in NED to FLU in ENU',
           ned_angles),
    Signal('acceleration', _vector('vehicle_acceleration', 'xyz'), 'm/s²', 'y and z turned',
           mirrored),
    Signal('acceleration', _vector('sensor_combined', 'accelerometer_m_s2'), 'm/s²',
           'y and z turned', mirrored),
    Signal('attitude_setpoint', _vector('vehicle_attitude_setpoint', 'q_d', 4), '1',
           'FRD in NED to FLU in ENU', ned_angles),
    Signal('rate_setpoint', within('vehicle_rates_setpoint', *AXES), 'rad/s',
           'pitch and yaw turned', mirrored),
    Signal('velocity', within('vehicle_local_position', 'vx', 'vy', 'vz'), 'm/s', 'NED to ENU',
           enu),
    Signal('position', within('vehicle_local_position', 'x', 'y', 'z'), 'm', 'NED to ENU', enu),
    Signal('battery', within('battery_status', 'voltage_v'), 'V', 'as it is'),
)
GPS = ('vehicle_gps_position', 'sensor_gps')
FLOWN = (
    *dict.fromkeys(signal.columns[0].partition('.')[0] for signal in SIGNALS), 'actuator_motors',
    'vehicle_torque_setpoint', 'vehicle_thrust_setpoint', 'actuator_controls_0', 'actuator_armed',
    'vehicle_status', 'esc_status', AUTOTUNE,
)
TOPICS = *FLOWN, *GPS


def read(path: Path) -> ForeignLog:
    """Read a .ulg file; raises BadInputError where it is damaged or lacks rates or commands."""
    return _read(_load(path), 'a PX4 log', FASTER)


def read_bag(path: Path, messages: Path | None = None) -> ForeignLog:
    """Read a bag of px4_msgs, which are forward, right, down as PX4 itself."""
    columns, times, notes = of_one_aircraft(path, IN_BAG, FLOWN, messages)
    return _read(Table(str(path), columns, times, notes=notes), 'a bag of px4_msgs', FASTER_BAG)


def is_bag(topics: Mapping[str, str]) -> bool:
    """Whether a bag with these topics and types holds px4_msgs."""
    return any(kind.startswith('px4_msgs/') and IN_BAG.match(f'{topic}.')
               for topic, kind in topics.items())


def _read(table: Table, kind: str, faster: str) -> ForeignLog:
    reading = Reading(table)
    reading.take(*SIGNALS)
    if 'rates' not in reading.streams:
        raise BadInputError(
            table.source, 'holds no vehicle_angular_velocity and no sensor_combined',
            table.messages or 'no topic of use', f'{faster}; then log again',
        )
    crafts, units, warnings = _input(reading)
    gains = partial(_gains, table, units)
    return reading.log(kind, SIGNALS, crafts=crafts, armed=_armed(table),
                       gains=gains(table.header),
                       gain_changes=changes_of(table, PX4.logged, gains),
                       utc_s=_utc_s(table), faster=faster,
                       warnings=(*_vehicle(table), *warnings),
                       experiments=_experiments(table))


def _utc_s(table: Table) -> float | None:
    """Time 0 in UTC, s, by the GPS; None without a fix."""
    gps = next((s for topic in GPS if (s := table.stream(f'{topic}.time_utc_usec'))), None)
    if gps is None or not (fixed := 1e-6 * gps.values[:, 0] > EPOCH_S).any():
        return None
    return float(np.median(1e-6 * gps.values[fixed, 0] - gps.time_s[fixed]))


def _experiments(table: Table) -> tuple[Experiment, ...]:
    """The steps of the autotune, which it adds to the rate set-point of one axis."""
    columns = _vector(AUTOTUNE, 'rate_sp')
    added = table.stream(*columns)
    if added is None:
        return ()
    return runs_of('square', 'rate', Stream(added.time_s, mirrored(added.values)))


def _load(path: Path) -> Table:
    with read_by_library(path, 'is not a whole ULog', 'copy it again from the aircraft'):
        from pyulog import ULog

        log: Any = ULog(str(path), list(TOPICS), disable_str_exceptions=True)
    if not log.data_list and log.file_corruption:
        raise BadInputError(str(path), 'is cut off or damaged before its first data',
                            f'{path.stat().st_size} bytes', 'copy it again from the aircraft')
    columns: dict[str, FloatArray] = {}
    times: dict[str, FloatArray] = {}
    anew = 0
    for data in {data.name: data for data in reversed(log.data_list)}.values():
        fields = data.data
        if 'q_d[0]' in fields:  # all zeros where the controller runs without a set-point
            is_set = np.abs(fields['q_d[0]']) + np.abs(fields['q_d[3]']) > 0.0
            fields = {name: values[is_set] for name, values in fields.items()}
        stamps = np.asarray(fields.get('timestamp_sample', fields['timestamp']), dtype=float)
        if not (stamps > 0).all():
            stamps = np.asarray(fields['timestamp'], dtype=float)
        columns |= {f'{data.name}.{name}': np.asarray(values, dtype=float)
                    for name, values in fields.items()}
        times |= dict.fromkeys(within(data.name, *fields), stamps * 1e-6)
        anew = max(anew, len(restarts({'': np.arange(stamps.size)}, {'': stamps * 1e-6})))
    for name, stamps in times.items() if anew else ():
        steps_back = np.flatnonzero(np.diff(stamps) < -RESTART_S)
        rows = slice(int(steps_back[0]) + 1 if steps_back.size else None)
        columns[name], times[name] = columns[name][rows], stamps[rows]
    parameters = {
        str(name): float(value) for name, value in log.initial_parameters.items()
        if isinstance(value, int | float)
    }
    notes = [f'its clock begins anew {anew} times: what was logged before is read'] * bool(anew)
    if log.file_corruption:
        notes.append('parts of the log are damaged and left out: copy it again')
    elif _cut(path.read_bytes()):
        notes.append('the log ends within a message, as one that was cut off: copy it again if '
                     'there is more of it')
    changed = tuple(Change(1e-6 * stamp, str(name), float(value))
                    for stamp, name, value in log.changed_parameters
                    if isinstance(value, int | float))
    return Table(str(path), columns, times, header=parameters, changed=changed,
                 notes=tuple(notes))


def _cut(ulog: bytes) -> bool:
    """Whether a ULog ends within a message, which the library reads up to there without a word."""
    place = 16  # behind the header; each message begins with its length and its kind
    while place + 3 <= len(ulog):
        place += 3 + int.from_bytes(ulog[place : place + 2], 'little')
    return place != len(ulog)


def _armed(table: Table) -> Stream | None:
    armed = table.stream('actuator_armed.armed')
    if armed is not None:
        return armed
    state = table.stream('vehicle_status.arming_state')
    return None if state is None else Stream(state.time_s, 1.0 * (state.values == ARMED))


def _input(reading: Reading) -> tuple[tuple[Craft, ...], Units | None, list[str]]:
    """Take the commands: the craft of the motors, the gains' units if known, warnings."""
    table = reading.table
    old = within('actuator_controls_0', *(f'control[{i}]' for i in (3, 0, 1, 2)))
    new = (*_vector('vehicle_torque_setpoint', 'xyz'), 'vehicle_thrust_setpoint.xyz[2]')
    torque = _torque(table, old, new)
    count = int(table.header.get('CA_ROTOR_COUNT', 0)) or LAYOUTS['px4_quad_x'].count
    columns = _vector('actuator_motors', 'control', count)
    motors = table.stream(*columns)
    if motors is not None and reading.motors_fast(motors, torque):
        crafts, how = _craft(table, count)
        # on the ground, at take-off and at landing motors stand at an end, where nothing is linear
        free = ((motors.values > FREE[0]) & (motors.values < FREE[1])).all(axis=1)
        scale = None if torque is None or not crafts else _scale(
            Stream(motors.time_s[free], crafts[0].control(motors.values[free])), torque
        )
        if scale is not None:
            how = f'{how}; {per_torque(scale)}'
        reading.take(Signal('motors', columns, '0..1', how))
        _speeds(reading, count)
        note = ("PX4's gains are not carried over: its torque set-point was not logged beside the "
                'motors, or does not follow from them')
        return crafts, scale, [] if scale else [note]
    if torque is None:
        raise BadInputError(table.source, 'holds no actuator_motors, vehicle_torque_setpoint or '
                            'actuator_controls_0', table.messages,
                            f'{FASTER}; then log again')
    reading.put(Signal(
        'control', old if old[0] in table.columns else new, '-1..1',
        "as it is, pitch and yaw turned; U is in the unit of PX4's torque set-point",
    ), torque)
    return (), (1.0, 1.0, 1.0), [DEMAND_ONLY]


def _torque(table: Table, old: tuple[str, ...], new: tuple[str, ...]) -> Stream | None:
    """U1..U4 in PX4's own normalised unit, FLU, from the columns before 1.13 or since then."""
    stream = table.stream(*old)
    if stream is not None:
        return Stream(stream.time_s, stream.values * [1.0, *MIRROR])
    torque, thrust = table.stream(*new[:3]), table.stream(new[3])
    if torque is None or thrust is None:
        return None
    up = -np.interp(torque.time_s, thrust.time_s, thrust.values[:, 0])
    return Stream(torque.time_s, np.column_stack([up, torque.values * MIRROR]))


def _craft(table: Table, count: int) -> tuple[tuple[Craft, ...], str]:
    """The craft by the log's parameters; none where only the motion can say it."""
    crafts = of_px4(table.header)
    if isinstance(crafts, Craft):
        return (crafts,), 'as they are, in their places by the CA_ROTOR parameters'
    if count == 4 and 'CA_ROTOR_COUNT' not in table.header:  # before 1.13
        return (LAYOUTS['px4_quad_x'],), "as they are, in PX4's order of the Quad X"
    return (), f'as they are; {crafts}: their places by what the motion shows'


def _speeds(reading: Reading, count: int) -> None:
    """Take the speeds that the speed controllers report, each by the motor it drives."""
    table, size = reading.table, 0
    while f'esc_status.esc[{size}].esc_rpm' in table.columns:
        size += 1
    rpm = table.stream(*(f'esc_status.esc[{i}].esc_rpm' for i in range(size))) if size else None
    if rpm is None or not np.nanmax(np.abs(rpm.values)) > 0.0:
        return
    values = np.full((len(rpm.time_s), count), np.nan)
    for i in range(min(size, 8)):  # entries of esc_status
        named = table.columns.get(f'esc_status.esc[{i}].actuator_function', np.zeros(1))
        motor = int(named[-1]) - FIRST_MOTOR if named[-1] >= FIRST_MOTOR else i
        if 0 <= motor < count:
            values[:, motor] = np.abs(rpm.values[:, i]) * RPM
    reading.put(Signal('speeds', ('esc_status.esc_rpm',), 'rpm', 'to rad/s, positive in flight'),
                Stream(rpm.time_s, values))


def _scale(control: Stream, torque: Stream) -> Units | None:
    """U2..U4 per PX4's torque, from the log itself; None where they are not proportional."""
    index = np.clip(np.searchsorted(torque.time_s, control.time_s), 0, len(torque.time_s) - 1)
    x, y = torque.values[index, 1:], control.values[:, 1:]
    is_finite = np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=1)
    x, y = x[is_finite], y[is_finite]
    power, total = (x**2).sum(axis=0), (y**2).sum(axis=0)
    if not (power * total > 0.0).all():
        return None
    slope = (x * y).sum(axis=0) / power
    residual = ((y - slope * x) ** 2).sum(axis=0)
    roll, pitch, yaw = slope.tolist()
    return (roll, pitch, yaw) if (1.0 - residual / total >= LINEAR).all() else None


def _gains(table: Table, units: Units | None, parameters: Mapping[str, float]
           ) -> dict[str, float]:
    """The contract's names; only the filters of the rates where nobody knows the `units`."""
    gains = PX4.gains(parameters, units or (1.0, 1.0, 1.0))
    filtered = 'vehicle_angular_velocity.xyz[0]' in table.columns
    return {name: value for name, value in gains.items()
            if (filtered if name.startswith('sensor.') else units is not None)}


def _vehicle(table: Table) -> tuple[str, ...]:
    kind = table.header.get('MAV_TYPE')
    if kind is None or int(kind) in MULTIROTORS:
        return ()
    return ((f'MAV_TYPE is {int(kind)}, no multirotor: wings and tilting rotors are not in the '
             'model; be careful'),)
