"""Frame to MAVLink message and back: one row each, functions where a field is not just copied.

No bytes, no state.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from quad_bridge.si import GRAVITY_M_S2
from quad_bridge.wire import dialect as d
from quad_bridge.wire import frames as f
from quad_bridge.wire.framing import Packet

Fields = dict[str, Any]
_ARMED = 128
_NOT_MEASURED = 0xFFFF
_CHANNELS = tuple(f'chan{i}_raw' for i in range(1, 19))
_PARAMETERS = tuple(f'param{i}' for i in range(1, 8))
_UPDATED = {'accel': 0x07, 'gyro': 0x38, 'mag_gauss': 0x1C0}
"""Field of SlowSensors to its bits in HIGHRES_IMU's `fields_updated`, in the message's order."""
_PRESSURE = 0x200
_MOST_HPA = 2000.0  # what is more is in Pa: PX4 1.16 sends the pressure so
_TARGET = 'target_system target_component'
_FOLLOWED = 'time_boot_ms type_mask q body_roll_rate,body_pitch_rate,body_yaw_rate thrust'

_ROWS: tuple[tuple[type, Any, str], ...] = (
    (f.Cycle, d.MAVLink_quad_cycle_message,
     ('time_usec cycle gyro accel attitude attitude_setpoint rate_setpoint control excitation '
      'motors flags excitation_seq injection')),
    (f.Excitation, d.MAVLink_quad_excitation_message, f'value injection seq valid_ms {_TARGET}'),
    (f.TimeSync, d.MAVLink_timesync_message, 'tc1 ts1'),
    (f.ParamRequestList, d.MAVLink_param_request_list_message, _TARGET),
    (f.ParamRequestRead, d.MAVLink_param_request_read_message, f'param_id param_index {_TARGET}'),
    (f.ParamSet, d.MAVLink_param_set_message, f'param_id param_value {_TARGET} param_type'),
    (f.ParamValue, d.MAVLink_param_value_message,
     'param_id param_value param_count param_index param_type'),
    (f.GainsCommand, d.MAVLink_quad_gains_message,
     f'action transaction checksum watch_ms {_TARGET}'),
    (f.GainsState, d.MAVLink_quad_gains_state_message,
     'aircraft checksum transaction action result phase'),
    (f.CommandAck, d.MAVLink_command_ack_message, 'command result'),
    (f.StatusText, d.MAVLink_statustext_message, 'severity text'),
    (f.LogRequestList, d.MAVLink_log_request_list_message, f'start end {_TARGET}'),
    (f.LogEntry, d.MAVLink_log_entry_message, 'id num_logs last_log_num time_utc size'),
    (f.LogRequestData, d.MAVLink_log_request_data_message, f'id ofs count {_TARGET}'),
    (f.LogRequestEnd, d.MAVLink_log_request_end_message, _TARGET),
)  # fmt: skip
"""Frame class, message, and the message's fields in the order of the frame's; `a,b` is a tuple."""
_OF_AUTOPILOTS: tuple[tuple[type, Any, str], ...] = (
    (f.Attitude, d.MAVLink_attitude_message,
     'time_boot_ms roll,pitch,yaw rollspeed,pitchspeed,yawspeed'),
    (f.AttitudeTarget, d.MAVLink_attitude_target_message, _FOLLOWED),
    (f.SetAttitudeTarget, d.MAVLink_set_attitude_target_message, f'{_FOLLOWED} {_TARGET}'),
    (f.LandedState, d.MAVLink_extended_sys_state_message, 'landed_state'),
    (f.LocalPosition, d.MAVLink_local_position_ned_message, 'time_boot_ms x,y,z vx,vy,vz'),
    (f.Version, d.MAVLink_autopilot_version_message, 'flight_sw_version board_version uid uid2'),
)  # fmt: skip
"""The same of messages that only other autopilots send, or take."""
COPIED = {kind: (message, names.split()) for kind, message, names in (*_ROWS, *_OF_AUTOPILOTS)}

_LAYOUT: dict[int, tuple[Any, tuple[tuple[str, int, int], ...]]] = {}


def _values(message: Any, payload: bytes) -> tuple[Any, ...]:
    """The numbers of a message in the wire's order, without names; cut off zeros are put back."""
    layout = message.unpacker
    values: tuple[Any, ...] = layout.unpack(payload[: layout.size].ljust(layout.size, b'\0'))
    return values


def cycle(payload: bytes) -> f.Cycle:
    """QUAD_CYCLE."""
    v = _values(d.MAVLink_quad_cycle_message, payload)
    return f.Cycle(
        v[0], v[1], v[2:5], v[5:8], v[8:11], v[11:14], v[14:17], v[17:21], v[21:24], v[24:28],
        v[28], v[29], v[30],
    )  # fmt: skip


def _rc_channels(payload: bytes) -> f.RcChannels:
    time_ms, *pulses, count, rssi = _values(d.MAVLink_rc_channels_message, payload)
    return f.RcChannels(time_ms, tuple(pulses[:count]), rssi)


def _highres_imu(payload: bytes) -> f.SlowSensors:
    v = _values(d.MAVLink_highres_imu_message, payload)
    updated = v[14]
    accel, gyro, mag = (
        v[first : first + 3] if updated & bits == bits else None
        for first, bits in zip((1, 4, 7), _UPDATED.values(), strict=True)
    )
    pressure = v[10] if updated & _PRESSURE else None
    if pressure is not None and pressure > _MOST_HPA:
        pressure *= 0.01
    return f.SlowSensors(v[0], mag, pressure, v[13], gyro, accel)


OFTEN: dict[int, Callable[[bytes], f.Frame]] = {
    d.MAVLINK_MSG_ID_QUAD_CYCLE: cycle,
    d.MAVLINK_MSG_ID_RC_CHANNELS: _rc_channels,
    d.MAVLINK_MSG_ID_HIGHRES_IMU: _highres_imu,
}
"""Message id to the frame's constructor from the payload: what comes most often."""


def unpacked(packet: Packet) -> Fields:
    """The fields of a message of the dialect, and its sender; texts end at their first NUL.

    Zeros that were cut off at the end are put back, unknown extensions are left out.
    """
    if packet.message not in _LAYOUT:
        kind, places, first = d.mavlink_map[packet.message], [], 0
        for name, length in zip(kind.ordered_fieldnames, kind.lengths, strict=True):
            places.append((name, first, length))
            first += length
        _LAYOUT[packet.message] = kind.unpacker, tuple(places)
    unpacker, layout = _LAYOUT[packet.message]
    values = unpacker.unpack(packet.payload[: unpacker.size].ljust(unpacker.size, b'\0'))
    fields = {'system': packet.system, 'component': packet.component}
    for name, first, length in layout:
        value = values[first] if length == 1 else values[first : first + length]
        if isinstance(value, bytes):
            text = value.split(b'\0', 1)[0].decode('ascii', 'replace')
            value = ''.join(c if c.isprintable() else '?' for c in text)
        fields[name] = value
    return fields


def _battery(m: Fields) -> f.Battery:
    cells = [v for v in m.get('voltages', (m.get('voltage_battery'),)) if v != _NOT_MEASURED]
    current, remaining = m['current_battery'], m['battery_remaining']
    return f.Battery(
        sum(cells) / 1000.0 if cells else math.nan,
        current / 100.0 if current >= 0 else math.nan,
        remaining / 100.0 if remaining >= 0 else math.nan,
        'BATTERY_STATUS' if 'voltages' in m else 'SYS_STATUS',
        m.get('id', 0),
    )


def _scaled_imu(m: Fields) -> f.SlowSensors:
    mag = _columns(m, ('xmag', 'ymag', 'zmag'), 1e-3)
    return f.SlowSensors(
        time_us=1000 * m['time_boot_ms'],
        mag_gauss=mag if any(mag) else None,
        gyro=_columns(m, ('xgyro', 'ygyro', 'zgyro'), 1e-3),
        accel=_columns(m, ('xacc', 'yacc', 'zacc'), 1e-3 * GRAVITY_M_S2),
        name='SCALED_IMU',
    )


def _esc_telemetry(first: int) -> Callable[[Fields], f.RotorSpeeds]:
    """ESC_TELEMETRY_*; an ESC from which no packet has come measures nothing."""
    name = f'ESC_TELEMETRY_{first + 1}_TO_{first + 4}'

    def speeds(m: Fields) -> f.RotorSpeeds:
        pairs = zip(m['rpm'], m['count'], strict=True)
        rpm = tuple(float(v) if packets else math.nan for v, packets in pairs)
        return f.RotorSpeeds(first, rpm, name=name)

    return speeds


def _columns(m: Fields, names: tuple[str, ...], unit: float) -> f.Vector3:
    x, y, z = (m[name] * unit for name in names)
    return x, y, z


FROM_MESSAGE: dict[int, Callable[[Fields], f.Frame]] = {
    d.MAVLINK_MSG_ID_HEARTBEAT: lambda m: f.Heartbeat(
        m['type'], m['autopilot'], bool(m['base_mode'] & _ARMED), m['system_status'],
        m['custom_mode'], m['system'], m['component'],
    ),
    d.MAVLINK_MSG_ID_BATTERY_STATUS: _battery,
    d.MAVLINK_MSG_ID_COMMAND_LONG: lambda m: f.Command(
        m['command'], tuple(m[n] for n in _PARAMETERS), m['confirmation'], m['target_system'],
        m['target_component'],
    ),
}  # fmt: skip
"""Message id to the frame's constructor: what our own firmware and the bridge speak besides."""


def _copies(frame: Callable[..., f.Frame], names: str) -> Callable[[Fields], f.Frame]:
    fields = [name.split(',') for name in names.split()]
    return lambda m: frame(*[m[first] if not rest else tuple(m[name] for name in (first, *rest))
                             for first, *rest in fields])  # fmt: skip


FROM_MESSAGE |= {message.id: _copies(kind, names) for kind, message, names in _ROWS
                 if message.id not in OFTEN}  # fmt: skip

FROM_AUTOPILOT: dict[int, Callable[[Fields], f.Frame]] = {
    d.MAVLINK_MSG_ID_SCALED_IMU: _scaled_imu,
    d.MAVLINK_MSG_ID_SCALED_PRESSURE: lambda m: f.SlowSensors(
        1000 * m['time_boot_ms'], pressure_hpa=m['press_abs'],
        temperature_c=0.01 * m['temperature'], name='SCALED_PRESSURE',
    ),
    d.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: lambda m: f.Outputs(
        m['time_usec'], m['port'], tuple(m[f'servo{i}_raw'] for i in range(1, 17))
    ),
    d.MAVLINK_MSG_ID_RC_CHANNELS_RAW: lambda m: f.RcChannels(
        m['time_boot_ms'], tuple(m[n] for n in _CHANNELS[:8]), m['rssi'], m['port'],
        'RC_CHANNELS_RAW',
    ),
    d.MAVLINK_MSG_ID_MANUAL_CONTROL: lambda m: f.RcChannels(
        None, tuple(1500 + m[n] // 2 for n in 'yxzr'), name='MANUAL_CONTROL'
    ),
    d.MAVLINK_MSG_ID_SYS_STATUS: _battery,
    d.MAVLINK_MSG_ID_ESC_STATUS: lambda m: f.RotorSpeeds(
        m['index'], tuple(abs(float(v)) for v in m['rpm']), m['time_usec']
    ),
    d.MAVLINK_MSG_ID_ESC_TELEMETRY_1_TO_4: _esc_telemetry(0),
    d.MAVLINK_MSG_ID_ESC_TELEMETRY_5_TO_8: _esc_telemetry(4),
    d.MAVLINK_MSG_ID_ESC_TELEMETRY_9_TO_12: _esc_telemetry(8),
    **{message.id: _copies(kind, names) for kind, message, names in _OF_AUTOPILOTS},
    d.MAVLINK_MSG_ID_LOG_DATA: lambda m: f.LogData(
        m['id'], m['ofs'], bytes(m['data'][: m['count']])
    ),
    d.MAVLINK_MSG_ID_RPM: lambda m: f.RotorSpeeds(
        0, tuple(v if v >= 0.0 else math.nan for v in (m['rpm1'], m['rpm2'])), name='RPM'
    ),
}  # fmt: skip
"""Decoders of messages that only other autopilots send; ids in no table are `Standard`."""


def _to_heartbeat(frame: f.Heartbeat) -> Any:
    mode = _ARMED if frame.armed else 0
    return d.MAVLink_heartbeat_message(
        frame.type, frame.autopilot, mode, frame.custom_mode, frame.system_status, 3
    )


def _to_rc_channels(frame: f.RcChannels) -> Any:
    raw = [*frame.channels, *([_NOT_MEASURED] * (18 - len(frame.channels)))]
    message: Any = d.MAVLink_rc_channels_message
    return message(frame.time_ms, len(frame.channels), *raw, frame.rssi)


def _to_battery(frame: f.Battery) -> Any:
    voltage = _NOT_MEASURED if math.isnan(frame.voltage_v) else round(1000.0 * frame.voltage_v)
    current = -1 if math.isnan(frame.current_a) else round(100.0 * frame.current_a)
    remaining = -1 if math.isnan(frame.remaining) else round(100.0 * frame.remaining)
    cells = [voltage, *([_NOT_MEASURED] * 9)]
    return d.MAVLink_battery_status_message(0, 1, 1, 0x7FFF, cells, current, -1, -1, remaining)


def _to_slow_sensors(frame: f.SlowSensors) -> Any:
    updated = 0 if frame.pressure_hpa is None else _PRESSURE
    values: list[float] = []
    for name, bits in _UPDATED.items():
        vector = getattr(frame, name)
        updated |= 0 if vector is None else bits
        values += vector or (0.0, 0.0, 0.0)
    message: Any = d.MAVLink_highres_imu_message
    return message(
        frame.time_us, *values, frame.pressure_hpa or 0.0, 0.0, 0.0, frame.temperature_c, updated
    )


def _to_command(frame: f.Command) -> Any:
    values = [*frame.parameters, *([0.0] * (7 - len(frame.parameters)))]
    return d.MAVLink_command_long_message(
        frame.target_system, frame.target_component, frame.command, frame.confirmation, *values
    )


_TO_MESSAGE: dict[type, Callable[[Any], Any]] = {
    f.Heartbeat: _to_heartbeat,
    f.RcChannels: _to_rc_channels,
    f.Battery: _to_battery,
    f.SlowSensors: _to_slow_sensors,
    f.Command: _to_command,
}


def message_of(frame: f.Frame) -> Any:
    """The message that a frame is sent as. Raises KeyError where it has none of its own."""
    build = _TO_MESSAGE.get(type(frame))
    if build is not None:
        return build(frame)
    message, names = COPIED[type(frame)]
    values: Fields = {}
    for name, value in zip(names, vars(frame).values(), strict=True):
        if ',' in name:
            values |= zip(name.split(','), value, strict=True)
        else:
            values[name] = value.encode('ascii') if isinstance(value, str) else value
    return message(**values)
