"""Frame to MAVLink message and back, one pair of entries per message. No bytes, no state."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from quad_bridge.wire import dialect as d
from quad_bridge.wire.frames import (
    Battery,
    Command,
    CommandAck,
    Cycle,
    Excitation,
    Frame,
    GainsCommand,
    GainsState,
    Heartbeat,
    ParamRequestList,
    ParamRequestRead,
    ParamSet,
    ParamValue,
    RcChannels,
    SlowSensors,
    Standard,
    StatusText,
    TimeSync,
)

REAL32 = 9
"""MAV_PARAM_TYPE_REAL32."""
_ARMED = 128
_INERTIAL, _MAG, _PRESSURE = 0x3F, 0x1C0, 0x200
_NO_VOLTAGE = 0xFFFF


def _cycle(m: Any) -> Cycle:
    return Cycle(
        m.time_usec,
        m.cycle,
        tuple(m.gyro),
        tuple(m.accel),
        tuple(m.attitude),
        tuple(m.attitude_setpoint),
        tuple(m.rate_setpoint),
        tuple(m.control),
        tuple(m.excitation),
        tuple(m.motors),
        m.flags,
        m.excitation_seq,
        m.injection,
    )


def _heartbeat(m: Any) -> Heartbeat:
    return Heartbeat(
        type=m.type,
        autopilot=m.autopilot,
        armed=bool(m.base_mode & _ARMED),
        system_status=m.system_status,
        custom_mode=m.custom_mode,
        system=m.get_srcSystem(),
        component=m.get_srcComponent(),
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
        has_inertial=bool(updated & _INERTIAL),
    )


def _command(m: Any) -> Command:
    values = tuple(getattr(m, f'param{i}') for i in range(1, 8))
    return Command(m.command, values, m.confirmation, m.target_system, m.target_component)


def standard(m: Any) -> Standard:
    """A standard message that has no frame of its own."""
    return Standard(m.get_type(), m.get_srcSystem(), m.get_srcComponent())


FROM_MESSAGE: dict[int, Callable[[Any], Frame]] = {
    d.MAVLINK_MSG_ID_QUAD_CYCLE: _cycle,
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
    d.MAVLINK_MSG_ID_STATUSTEXT: lambda m: StatusText(m.severity, m.text),
}
"""Message id to the frame's constructor; ids of the dialect that are missing are `Standard`."""


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
    mag, pressure = (0.0, 0.0, 0.0), 0.0
    if f.mag_gauss is not None:
        mag, updated = f.mag_gauss, updated | _MAG
    if f.pressure_hpa is not None:
        pressure, updated = f.pressure_hpa, updated | _PRESSURE
    still = (0.0,) * 6
    return d.MAVLink_highres_imu_message(
        f.time_us, *still, *mag, pressure, 0.0, 0.0, f.temperature_c, updated
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
