"""Frame to MAVLink message and back, one pair of entries per message. No bytes, no state."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from quad_bridge.wire import dialect as d
from quad_bridge.wire.frames import (
    Attitude,
    Battery,
    Command,
    CommandAck,
    Cycle,
    Excitation,
    Frame,
    GainsCommand,
    GainsState,
    Heartbeat,
    Outputs,
    ParamRequestList,
    ParamRequestRead,
    ParamSet,
    ParamValue,
    RcChannels,
    SlowSensors,
    StatusText,
    TimeSync,
    Vector3,
)
from quad_bridge.wire.framing import Packet

REAL32 = 9
"""MAV_PARAM_TYPE_REAL32."""
_ARMED = 128
_ACCEL, _GYRO, _MAG, _PRESSURE = 0x07, 0x38, 0x1C0, 0x200
GRAVITY = 9.80665
_NO_VOLTAGE = 0xFFFF


_CYCLE = d.MAVLink_quad_cycle_message.unpacker
_LAYOUT: dict[int, tuple[Any, int, tuple[tuple[str, int, int], ...]]] = {}


def cycle(payload: bytes) -> Cycle:
    """QUAD_CYCLE straight from its payload: it comes in every cycle."""
    v = _CYCLE.unpack(payload[: _CYCLE.size].ljust(_CYCLE.size, b'\0'))
    return Cycle(
        v[0], v[1], v[2:5], v[5:8], v[8:11], v[11:14], v[14:17], v[17:21], v[21:24], v[24:28],
        v[28], v[29], v[30],
    )  # fmt: skip


def unpacked(packet: Packet) -> Any:
    """The fields of a message of the dialect by name; texts end at their first NUL.

    Zeros that were cut off at the end are put back, unknown extensions are left out.
    """
    layout = _LAYOUT.get(packet.message)
    if layout is None:
        layout = _LAYOUT[packet.message] = _layout(d.mavlink_map[packet.message])
    unpacker, size, places = layout
    values = unpacker.unpack(packet.payload[:size].ljust(size, b'\0'))
    fields = SimpleNamespace(
        sender_system=packet.system, sender_component=packet.component, payload=packet.payload
    )
    for name, first, length in places:
        value = values[first] if length == 1 else values[first : first + length]
        if isinstance(value, bytes):
            value = value.split(b'\0', 1)[0].decode('ascii', 'replace')
        setattr(fields, name, value)
    return fields


def _layout(kind: Any) -> tuple[Any, int, tuple[tuple[str, int, int], ...]]:
    """Unpacker, bytes, and where each field begins among the unpacked values, and how many."""
    places, first = [], 0
    for name, length in zip(kind.ordered_fieldnames, kind.lengths, strict=True):
        places.append((name, first, length))
        first += length
    return kind.unpacker, kind.unpacker.size, tuple(places)


def _heartbeat(m: Any) -> Heartbeat:
    return Heartbeat(
        type=m.type,
        autopilot=m.autopilot,
        armed=bool(m.base_mode & _ARMED),
        system_status=m.system_status,
        custom_mode=m.custom_mode,
        system=m.sender_system,
        component=m.sender_component,
    )


def _rc_channels(m: Any) -> RcChannels:
    count = min(m.chancount, 18)
    raw = tuple(getattr(m, f'chan{i}_raw') for i in range(1, count + 1))
    return RcChannels(m.time_boot_ms, raw, m.rssi)


def _battery(m: Any) -> Battery:
    cells = [v for v in m.voltages if v != _NO_VOLTAGE]
    return Battery(
        voltage_v=sum(cells) / 1000.0 if cells else math.nan,
        current_a=m.current_battery / 100.0 if m.current_battery >= 0 else math.nan,
        remaining=m.battery_remaining / 100.0 if m.battery_remaining >= 0 else math.nan,
    )


def _slow_sensors(m: Any) -> SlowSensors:
    updated = m.fields_updated
    return SlowSensors(
        time_us=m.time_usec,
        mag_gauss=(m.xmag, m.ymag, m.zmag) if updated & _MAG == _MAG else None,
        pressure_hpa=m.abs_pressure if updated & _PRESSURE else None,
        temperature_c=m.temperature,
        gyro=(m.xgyro, m.ygyro, m.zgyro) if updated & _GYRO == _GYRO else None,
        accel=(m.xacc, m.yacc, m.zacc) if updated & _ACCEL == _ACCEL else None,
    )


def _command(m: Any) -> Command:
    values = tuple(getattr(m, f'param{i}') for i in range(1, 8))
    return Command(m.command, values, m.confirmation, m.target_system, m.target_component)


def _text(m: Any) -> StatusText:
    return StatusText(m.severity, ''.join(c if c.isprintable() else '?' for c in m.text))


def _attitude(m: Any) -> Attitude:
    angles, rates = (m.roll, m.pitch, m.yaw), (m.rollspeed, m.pitchspeed, m.yawspeed)
    return Attitude(m.time_boot_ms, angles, rates)


def _scaled_imu(m: Any) -> SlowSensors:
    mag = (m.xmag, m.ymag, m.zmag)
    return SlowSensors(
        time_us=1000 * m.time_boot_ms,
        mag_gauss=_scaled(mag, 1e-3) if any(mag) else None,
        gyro=_scaled((m.xgyro, m.ygyro, m.zgyro), 1e-3),
        accel=_scaled((m.xacc, m.yacc, m.zacc), 1e-3 * GRAVITY),
        name='SCALED_IMU',
    )


def _scaled_pressure(m: Any) -> SlowSensors:
    return SlowSensors(
        time_us=1000 * m.time_boot_ms,
        pressure_hpa=m.press_abs,
        temperature_c=0.01 * m.temperature,
        name='SCALED_PRESSURE',
    )


def _scaled(values: tuple[int, int, int], unit: float) -> Vector3:
    x, y, z = values
    return (x * unit, y * unit, z * unit)


def _outputs(m: Any) -> Outputs:
    return Outputs(m.time_usec, m.port, (m.servo1_raw, m.servo2_raw, m.servo3_raw, m.servo4_raw))


def _system_status(m: Any) -> Battery:
    return Battery(
        math.nan if m.voltage_battery == _NO_VOLTAGE else m.voltage_battery / 1000.0,
        m.current_battery / 100.0 if m.current_battery >= 0 else math.nan,
        m.battery_remaining / 100.0 if m.battery_remaining >= 0 else math.nan,
        name='SYS_STATUS',
    )


FROM_MESSAGE: dict[int, Callable[[Any], Frame]] = {
    d.MAVLINK_MSG_ID_QUAD_CYCLE: lambda m: cycle(m.payload),
    d.MAVLINK_MSG_ID_QUAD_EXCITATION: lambda m: Excitation(
        tuple(m.value), m.injection, m.seq, m.valid_ms, m.target_system, m.target_component
    ),
    d.MAVLINK_MSG_ID_HEARTBEAT: _heartbeat,
    d.MAVLINK_MSG_ID_TIMESYNC: lambda m: TimeSync(m.tc1, m.ts1),
    d.MAVLINK_MSG_ID_PARAM_REQUEST_LIST: lambda m: ParamRequestList(
        m.target_system, m.target_component
    ),
    d.MAVLINK_MSG_ID_PARAM_REQUEST_READ: lambda m: ParamRequestRead(
        m.param_id, m.param_index, m.target_system, m.target_component
    ),
    d.MAVLINK_MSG_ID_PARAM_SET: lambda m: ParamSet(
        m.param_id, m.param_value, m.target_system, m.target_component
    ),
    d.MAVLINK_MSG_ID_PARAM_VALUE: lambda m: ParamValue(
        m.param_id, m.param_value, m.param_count, m.param_index
    ),
    d.MAVLINK_MSG_ID_QUAD_GAINS: lambda m: GainsCommand(
        m.action, m.transaction, m.checksum, m.watch_ms, m.target_system, m.target_component
    ),
    d.MAVLINK_MSG_ID_QUAD_GAINS_STATE: lambda m: GainsState(
        m.aircraft, m.checksum, m.transaction, m.action, m.result, m.phase
    ),
    d.MAVLINK_MSG_ID_RC_CHANNELS: _rc_channels,
    d.MAVLINK_MSG_ID_BATTERY_STATUS: _battery,
    d.MAVLINK_MSG_ID_HIGHRES_IMU: _slow_sensors,
    d.MAVLINK_MSG_ID_COMMAND_LONG: _command,
    d.MAVLINK_MSG_ID_COMMAND_ACK: lambda m: CommandAck(m.command, m.result),
    d.MAVLINK_MSG_ID_STATUSTEXT: _text,
}
"""Message id to the frame's constructor: what the suite's own firmware and the bridge speak."""

FROM_AUTOPILOT: dict[int, Callable[[Any], Frame]] = {
    d.MAVLINK_MSG_ID_ATTITUDE: _attitude,
    d.MAVLINK_MSG_ID_SCALED_IMU: _scaled_imu,
    d.MAVLINK_MSG_ID_SCALED_PRESSURE: _scaled_pressure,
    d.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: _outputs,
    d.MAVLINK_MSG_ID_SYS_STATUS: _system_status,
}
"""The same for what other autopilots send beside; ids in neither table are `Standard`."""


def _to_cycle(f: Cycle) -> Any:
    return d.MAVLink_quad_cycle_message(
        f.time_us,
        f.cycle,
        f.gyro,
        f.accel,
        f.attitude,
        f.attitude_setpoint,
        f.rate_setpoint,
        f.control,
        f.excitation,
        f.motors,
        f.flags,
        f.excitation_seq,
        f.injection,
    )


def _to_heartbeat(f: Heartbeat) -> Any:
    mode = _ARMED if f.armed else 0
    return d.MAVLink_heartbeat_message(
        f.type, f.autopilot, mode, f.custom_mode, f.system_status, 3
    )


def _to_rc_channels(f: RcChannels) -> Any:
    raw = [*f.channels, *([0xFFFF] * (18 - len(f.channels)))]
    message: Any = d.MAVLink_rc_channels_message
    return message(f.time_ms, len(f.channels), *raw, f.rssi)


def _to_battery(f: Battery) -> Any:
    voltage = _NO_VOLTAGE if math.isnan(f.voltage_v) else round(1000.0 * f.voltage_v)
    current = -1 if math.isnan(f.current_a) else round(100.0 * f.current_a)
    remaining = -1 if math.isnan(f.remaining) else round(100.0 * f.remaining)
    cells = [voltage, *([_NO_VOLTAGE] * 9)]
    return d.MAVLink_battery_status_message(0, 1, 1, 0x7FFF, cells, current, -1, -1, remaining)


def _to_slow_sensors(f: SlowSensors) -> Any:
    updated = 0
    mag = gyro = accel = (0.0, 0.0, 0.0)
    pressure = 0.0
    if f.mag_gauss is not None:
        mag, updated = f.mag_gauss, updated | _MAG
    if f.pressure_hpa is not None:
        pressure, updated = f.pressure_hpa, updated | _PRESSURE
    if f.gyro is not None:
        gyro, updated = f.gyro, updated | _GYRO
    if f.accel is not None:
        accel, updated = f.accel, updated | _ACCEL
    return d.MAVLink_highres_imu_message(
        f.time_us, *accel, *gyro, *mag, pressure, 0.0, 0.0, f.temperature_c, updated
    )


def _to_command(f: Command) -> Any:
    values = [*f.parameters, *([0.0] * (7 - len(f.parameters)))]
    return d.MAVLink_command_long_message(
        f.target_system, f.target_component, f.command, f.confirmation, *values
    )


TO_MESSAGE: dict[type, Callable[[Any], Any]] = {
    Cycle: _to_cycle,
    Excitation: lambda f: d.MAVLink_quad_excitation_message(
        f.value, f.valid_ms, f.target_system, f.target_component, f.seq, f.injection
    ),
    Heartbeat: _to_heartbeat,
    TimeSync: lambda f: d.MAVLink_timesync_message(f.tc1_ns, f.ts1_ns),
    ParamRequestList: lambda f: d.MAVLink_param_request_list_message(
        f.target_system, f.target_component
    ),
    ParamRequestRead: lambda f: d.MAVLink_param_request_read_message(
        f.target_system, f.target_component, f.name.encode('ascii'), f.index
    ),
    ParamSet: lambda f: d.MAVLink_param_set_message(
        f.target_system, f.target_component, f.name.encode('ascii'), f.value, REAL32
    ),
    ParamValue: lambda f: d.MAVLink_param_value_message(
        f.name.encode('ascii'), f.value, REAL32, f.count, f.index
    ),
    GainsCommand: lambda f: d.MAVLink_quad_gains_message(
        f.checksum, f.watch_ms, f.target_system, f.target_component, f.transaction, f.action
    ),
    GainsState: lambda f: d.MAVLink_quad_gains_state_message(
        f.aircraft, f.checksum, f.transaction, f.action, f.result, f.phase
    ),
    RcChannels: _to_rc_channels,
    Battery: _to_battery,
    SlowSensors: _to_slow_sensors,
    Command: _to_command,
    CommandAck: lambda f: d.MAVLink_command_ack_message(f.command, f.result),
    StatusText: lambda f: d.MAVLink_statustext_message(
        f.severity, f.text.encode('ascii', 'replace')[:50]
    ),
}
"""Frame class to the message it is sent as."""
