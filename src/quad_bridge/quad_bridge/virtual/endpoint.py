"""The STM32's side of the wire: frames in, frames out, one control cycle at a time. No I/O.

The aircraft is in body FLU and ENU, the wire in FRD and NED (quad_bridge.wire.axes). Device time
is in s since boot; the control cycle k starts at exactly k cycles.
"""

from __future__ import annotations

import hashlib
import math

import numpy as np

from quad_bridge.gains.table import AXES, CONTRACT_NAMES, WIRE_NAMES
from quad_bridge.virtual.aircraft import Aircraft
from quad_bridge.virtual.cycle import COLUMNS
from quad_bridge.virtual.firmware import TABLE, Firmware, Request, limit_flags
from quad_bridge.virtual.gain_store import GainStore
from quad_bridge.virtual.receiver import Channels, Receiver, channels_at
from quad_bridge.wire import Decoder, Encoder
from quad_bridge.wire.axes import flip_attitude, flip_body, flip_control
from quad_bridge.wire.frames import (
    Battery,
    Command,
    CommandAck,
    Cycle,
    Excitation,
    Flag,
    Frame,
    GainsCommand,
    GainsResult,
    Heartbeat,
    ParamRequestList,
    ParamRequestRead,
    ParamSet,
    ParamValue,
    RcChannels,
    SlowSensors,
    StatusText,
    TimeSync,
)
from quad_bridge.wire.signing import Signing

ARM_DISARM, ACCEPTED, NOT_NOW, UNSUPPORTED = 400, 0, 1, 3
"""MAV_CMD_COMPONENT_ARM_DISARM and three MAV_RESULTs."""
UNSAFE = Flag.RC_KILL | Flag.RC_FAILSAFE | Flag.ANGLE_LIMIT
"""Flags of the last cycle with which nothing is armed."""
FILTER_BOUNDS_HZ = (5.0, 200.0)
_OWN = {f'{axis}.{name}' for axis in AXES for name in TABLE}
_FILTERS = ('sensor.gyro_filter_hz', 'sensor.accel_filter_hz')
NAMES = tuple(
    wire
    for wire, contract in CONTRACT_NAMES.items()
    if contract in {*_OWN, *_FILTERS, 'loop.rate_hz'}
)
"""Wire names of the parameters that this firmware has, in the order of their index."""
_REVERTED = {
    int(GainsResult.LINK_LOST): 'link lost: last good gains restored',
    int(GainsResult.NOT_CONFIRMED): 'gains not confirmed: last good restored',
}
_WATCHED = {
    int(Flag.RC_KILL): 'pilot: kill switch',
    int(Flag.RC_FAILSAFE): 'receiver failsafe',
    int(Flag.STALE_SETPOINT): 'excitation stale, dropped',
    int(Flag.EXCITATION_REFUSED): 'excitation refused',
}


class Endpoint:
    """The aircraft, its firmware and receiver behind a codec."""

    def __init__(
        self, aircraft: Aircraft, script: Receiver, signing: Signing | None = None
    ) -> None:
        self.aircraft = aircraft
        self.firmware = Firmware(aircraft.profile.firmware, aircraft.gains)
        self._script = script
        self._decoder, self._encoder = Decoder(signing), Encoder(signing=signing)
        sensors = aircraft.profile.sensors
        cut_offs = (sensors.gyro_filter_hz, sensors.accel_filter_hz)
        self._filters = dict(zip(_FILTERS, cut_offs, strict=True))
        values = {name: self._value(CONTRACT_NAMES[name]) for name in NAMES}
        self._store = GainStore(values, self._fits, aircraft_number(aircraft))
        self._stored_version = self._store.version
        self._battery_v = math.nan
        self._flags = 0
        self._low = False

    def receive(self, data: bytes, now_ns: int) -> bytes:
        """Take bytes that arrived at device time `now_ns`; the bytes of what answers them."""
        answers: list[Frame] = []
        for frame in self._decoder.feed(data):
            self._store.heard(now_ns * 1e-9)
            answers += self._answer(frame, now_ns)
        self._put_into_force()
        return b''.join(self._encoder.encode(answer) for answer in answers)

    def cycle(self) -> bytes:
        """Run the coming control cycle; the bytes of what the STM32 sends in it."""
        number = self.aircraft.cycle
        now_s = number * self.aircraft.cycle_s
        reverted = self._store.tick(now_s)
        self._put_into_force()
        channels = channels_at(self._script, now_s)
        given, flags = self.firmware.prepare(channels, self.aircraft.hover_throttle, now_s)
        row = self.aircraft.run(given[np.newaxis])[0]
        flags |= limit_flags(row[COLUMNS['limits'].start])
        self._battery_v = float(row[COLUMNS['battery_v'].start])
        self.firmware.note(self._battery_v, float(row[COLUMNS['limits'].start]))
        frames = [self._cycle_frame(number, given, row, flags)]
        frames += self._events(flags)
        if reverted is not None:
            frames += [reverted, StatusText(2, _REVERTED[reverted.result])]
        frames += self._slow_frames(number, channels, row)
        return b''.join(self._encoder.encode(frame) for frame in frames)

    def _cycle_frame(self, number: int, given: np.ndarray, row: np.ndarray, flags: int) -> Frame:
        parts = {name: row[span].tolist() for name, span in COLUMNS.items()}
        return Cycle(
            time_us=round(number * self.aircraft.cycle_s * 1e6),
            cycle=number % (1 << 32),
            gyro=flip_body(parts['rates']),
            accel=flip_body(parts['acceleration']),
            attitude=flip_attitude(parts['angles']),
            attitude_setpoint=flip_attitude(parts['attitude_setpoint']),
            rate_setpoint=flip_body(parts['rate_setpoint']),
            control=flip_control(parts['wrench']),
            excitation=flip_body(given[2:5].tolist()),
            motors=tuple(parts['motors']),
            flags=flags,
            excitation_seq=self.firmware.sequence,
            injection=int(given[1]),
        )

    def _events(self, flags: int) -> list[Frame]:
        """A text for each flag that came up, and once for a low battery."""
        new = flags & ~self._flags
        self._flags = flags
        texts = [StatusText(4, text) for flag, text in _WATCHED.items() if new & flag]
        if self.firmware.low_battery and not self._low:
            self._low = True
            texts.append(StatusText(2, f'low battery: {self._battery_v:.2f} V'))
        return list(texts)

    def _slow_frames(self, number: int, channels: Channels, row: np.ndarray) -> list[Frame]:
        """Heartbeat 1 Hz, battery 10 Hz, receiver, compass and barometer 50 Hz."""
        rate, frames = self.aircraft.profile.firmware.rate_hz, list[Frame]()
        if number == 0:
            frames.append(StatusText(6, 'virtual STM32: calibrated at rest'))
        if number % round(rate) == 0:
            armed = bool(self._flags & Flag.ARMED)
            frames.append(Heartbeat(armed=armed, system_status=4 if armed else 3))
            frames.append(self._store.state())
        if number % round(rate / 10.0) == 0:
            frames.append(Battery(voltage_v=self._battery_v))
        if number % round(rate / 50.0) == 0:
            trim = float(row[COLUMNS['throttle'].start])
            frames.append(_rc_frame(number * self.aircraft.cycle_s, channels, trim))
            frames.append(
                SlowSensors(
                    time_us=round(number * self.aircraft.cycle_s * 1e6),
                    mag_gauss=flip_body((row[COLUMNS['mag']] * 1e4).tolist()),
                    pressure_hpa=float(row[COLUMNS['pressure_pa'].start]) / 100.0,
                )
            )
        return frames

    def _answer(self, frame: Frame, now_ns: int) -> list[Frame]:
        if isinstance(frame, TimeSync):
            return [TimeSync(now_ns, frame.ts1_ns)] if frame.tc1_ns == 0 else []
        if isinstance(frame, Excitation):
            value = flip_body(frame.value)
            request = Request(frame.injection, value, frame.valid_ms * 1e-3, frame.seq)
            self.firmware.excite(request, now_ns * 1e-9)
            return []
        if isinstance(frame, Command):
            return [self._command(frame)]
        if isinstance(frame, GainsCommand):
            return [self._store.take(frame, now_ns * 1e-9)]
        return self._parameter_answer(frame)

    def _parameter_answer(self, frame: Frame) -> list[Frame]:
        if isinstance(frame, ParamRequestList):
            return [self._parameter(name) for name in NAMES]
        if isinstance(frame, ParamRequestRead):
            known = 0 <= frame.index < len(NAMES)
            return self._known(NAMES[frame.index] if known else frame.name)
        if isinstance(frame, ParamSet):
            if frame.name in NAMES:
                self._store.write(frame.name, frame.value)
            return self._known(frame.name)
        return []

    def _command(self, frame: Command) -> Frame:
        if frame.command != ARM_DISARM or frame.parameters[:1] not in {(0.0,), (1.0,)}:
            return CommandAck(frame.command, UNSUPPORTED)
        wanted = frame.parameters[0] > 0.5
        if wanted and (self._flags & UNSAFE or self.firmware.low_battery):
            return CommandAck(frame.command, NOT_NOW)
        self.firmware.armed = wanted
        return CommandAck(frame.command, ACCEPTED)

    def _known(self, name: str) -> list[Frame]:
        if name in NAMES:
            return [self._parameter(name)]
        return [StatusText(4, f'unknown parameter {name[:16]}')]

    def _parameter(self, name: str) -> Frame:
        """PARAM_VALUE of the wire's `name`: what is in force, or in the copy while one is open."""
        return ParamValue(name, self._store.shown(name), len(NAMES), NAMES.index(name))

    def _value(self, contract: str) -> float:
        """What is in force at boot."""
        value = self.firmware.parameter(contract)
        if value is not None:
            return value
        return self._filters.get(contract, self.aircraft.profile.firmware.rate_hz)

    def _fits(self, wire: str, value: float) -> bool:
        contract, (low, high) = CONTRACT_NAMES[wire], FILTER_BOUNDS_HZ
        if contract in self._filters:
            return low <= value <= high
        return self.firmware.fits(contract, value)

    def _put_into_force(self) -> None:
        """Between two cycles: the whole active set at once; cut-offs change the chip at once."""
        if self._stored_version == self._store.version:
            return
        self._stored_version = self._store.version
        for wire, value in self._store.active.items():
            self.firmware.set_parameter(CONTRACT_NAMES[wire], value)
        cut_offs = {name: self._store.active[WIRE_NAMES[name]] for name in _FILTERS}
        if cut_offs != self._filters:
            self._filters = cut_offs
            self.aircraft.set_filters(*(cut_offs[name] for name in _FILTERS))


def aircraft_number(aircraft: Aircraft) -> int:
    """As the STM32's unique id: the same for the same airframe on any mount, 64 bits."""
    digest = hashlib.blake2b(repr(aircraft.profile.airframe).encode(), digest_size=8).digest()
    return int.from_bytes(digest, 'little')


def _rc_frame(now_s: float, channels: Channels, trim: float) -> Frame:
    """Pulse lengths of the nine channels; no signal strength in failsafe."""
    pulses = [
        round(1000.0 + 1000.0 * value) if i == 2 else round(1500.0 + 500.0 * value)
        for i, value in enumerate(channels.axes(trim))
    ]
    rssi = 0 if channels.failsafe else 200
    return RcChannels(round(now_s * 1000.0) % (1 << 32), tuple(pulses), rssi)
