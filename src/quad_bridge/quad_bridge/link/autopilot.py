"""An autopilot with standard messages only: their use, their rates, and what is missing. Pure.

Two tables: which message feeds which topic, the better one first, and how often a topic is wanted.
Of several messages with the same content one feeds the topic: the best that arrives. Rates are
compared with the wanted ones, whoever asked for the streams first, and raised by
MAV_CMD_SET_MESSAGE_INTERVAL. Stamps are stamping.py's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from quad_bridge.wire import frames as f
from quad_bridge.wire.dialect import mavlink_map

SET_MESSAGE_INTERVAL = 511
ROUND_NS = 1_000_000_000  # interval at which the rates are checked
PAUSE_NS = (2_000_000_000, 60_000_000_000)
"""Pause between two requests for a message; doubled, up to the second, while nothing changes."""
ENOUGH = 0.8  # share of the wanted rate that need not be raised
ALIVE_NS = 1_000_000_000  # a message that is silent for so long counts as absent
MAX_DURATION_NS = 10_000_000_000  # or for three of its own intervals, up to this
FRAME_BYTES = 12  # overhead of a message
LINE_SHARE = 0.8  # share of a serial line's capacity that telemetry may use
MIN_HZ = 10.0  # no stream is requested at less than that to spare the line
ANGLES_NS = 300_000_000  # older angles are not those of a message without any
MOVED_RAD = 0.01  # angles that change by more while all rates are exactly zero
INERTIAL, MOTORS, ROTORS = '/imu/data', '/motors/command', '/motors/state'
STICKS, COMPASS, PRESSURE, BATTERY = '/rc/in', '/imu/mag', '/baro', '/battery'

IDS = {
    'SCALED_IMU': 26, 'SCALED_PRESSURE': 29, 'ATTITUDE': 30, 'RC_CHANNELS_RAW': 35,
    'SERVO_OUTPUT_RAW': 36, 'RC_CHANNELS': 65, 'HIGHRES_IMU': 105, 'BATTERY_STATUS': 147,
    'SYS_STATUS': 1, 'RPM': 226, 'ESC_STATUS': 291, 'ESC_TELEMETRY_1_TO_4': 11030,
    'ESC_TELEMETRY_5_TO_8': 11031, 'ESC_TELEMETRY_9_TO_12': 11032, 'ATTITUDE_TARGET': 83,
    'LOCAL_POSITION_NED': 32, 'EXTENDED_SYS_STATE': 245, 'MANUAL_CONTROL': 69,
}  # fmt: skip
TELEMETRY = ('ESC_TELEMETRY_1_TO_4', 'ESC_TELEMETRY_5_TO_8', 'ESC_TELEMETRY_9_TO_12')
"""Messages for four ESCs each: they are one source together, under the name of the first."""
SOURCES = {
    INERTIAL: ('HIGHRES_IMU', 'SCALED_IMU', 'ATTITUDE'),
    MOTORS: ('SERVO_OUTPUT_RAW',),
    ROTORS: ('ESC_STATUS', TELEMETRY[0], 'RPM'),
    STICKS: ('RC_CHANNELS', 'RC_CHANNELS_RAW', 'MANUAL_CONTROL'),
    COMPASS: ('HIGHRES_IMU', 'SCALED_IMU'),
    PRESSURE: ('HIGHRES_IMU', 'SCALED_PRESSURE'),
    BATTERY: ('BATTERY_STATUS', 'SYS_STATUS'),
}
"""Topics that standard messages can feed, the better one first."""
TARGET_HZ = {
    INERTIAL: 250.0, MOTORS: 250.0, ROTORS: 250.0, STICKS: 50.0, COMPASS: 50.0, PRESSURE: 50.0,
    BATTERY: 10.0,
}  # fmt: skip
OPTIONAL = (ROTORS,)  # topics without which nothing is missing: few autopilots measure them
NEVER = ('/control/wrench', '/setpoint/attitude', '/setpoint/rates', '/excitation/applied')
"""Topics that need QUAD_CYCLE."""
AUTOPILOTS = {3: 'ArduPilot', 12: 'PX4'}  # MAV_AUTOPILOT
GENERIC = 0  # MAV_AUTOPILOT
BETAFLIGHT = {'ATTITUDE', 'RC_CHANNELS_RAW', 'VFR_HUD'}
"""Messages of Betaflight, which calls itself generic; its ATTITUDE has no rates at all."""


def fitted(targets: Mapping[str, float], budget: float) -> dict[str, float]:
    """Rates that a line of `budget` bytes per second carries: the fast ones give way first."""
    rates = dict(targets)
    while load(rates) > budget and max(rates.values(), default=0.0) > MIN_HZ:
        top = max(rates.values())
        rates = {n: max(0.9 * hz, MIN_HZ) if hz > 0.95 * top else hz for n, hz in rates.items()}
    return rates


def load(rates: Mapping[str, float]) -> float:
    """Bytes per second of messages at these rates."""
    return sum(hz * (FRAME_BYTES + mavlink_map[IDS[n]].unpacker.size) for n, hz in rates.items())


def name_of(peer: f.Heartbeat) -> str:
    """The autopilot's name by its heartbeat; empty for one that does not say."""
    return AUTOPILOTS.get(peer.autopilot, '')


@dataclass(frozen=True)
class Inertial:
    """Data for /imu/data, FRD, rad/s, m/s², rad; None where unknown."""

    time_us: int
    gyro: f.Vector3 | None
    accel: f.Vector3 | None
    attitude: f.Vector3 | None
    grain_us: int = 1  # resolution of the time: 1000 where it is in ms, with 32 bits


@dataclass
class _Stream:
    """One message's arrivals, and what was asked for."""

    count: int = 0  # since the last look
    rate_hz: float = math.nan  # at the last look
    requests: int = 0  # requests since the rate was last high enough
    next_ask_ns: int = 0
    pause_ns: int = PAUSE_NS[0]
    reached: bool = False  # whether the wanted rate has been reached before


class Autopilot:
    """The messages that arrive, those that feed the topics, and those to request."""

    def __init__(self, budget: float = math.inf) -> None:
        """`budget`: bytes per second that the line carries for it."""
        self.budget = budget
        self.also_hz: Mapping[str, float] = {}  # messages wanted beside those of the topics
        self._log_comes = False
        self._streams: dict[str, _Stream] = {}
        self._sources: dict[tuple[str, str], tuple[int, int]] = {}
        """Topic and message to when its content last came, and how long it counts as alive."""
        self._angles: f.Vector3 | None = None
        self._zeros: dict[str, f.Vector3] = {}
        """Messages with rates of exactly zero to the angles at which these began."""
        self._without_rates: set[str] = set()
        self._rpm: dict[int, float] = {}
        self._look_ns = self._checked_ns = 0
        self._battery: int | None = None
        self._turns = False  # whether any rate has ever been other than zero
        self.generic = False  # whether its heartbeat bears no name
        self.lowered: set[str] = set()  # messages whose rate was reached and lowered by another

    def clear(self) -> None:
        """Forget the autopilot, but neither who it is nor what is wanted of it."""
        generic, also_hz = self.generic, self.also_hz
        self.__init__(self.budget)  # type: ignore[misc]
        self.generic, self.also_hz = generic, also_hz

    @property
    def betaflight(self) -> bool:
        """Whether it is Betaflight, by what it sends."""
        return self.generic and not self._turns and set(self._streams) >= BETAFLIGHT

    def restarted(self) -> None:
        """The autopilot has started anew, with its own rates: nobody has lowered them."""
        self.lowered.clear()
        for stream in self._streams.values():
            stream.reached, stream.next_ask_ns, stream.pause_ns = False, 0, PAUSE_NS[0]

    def log_comes(self, *, now: bool) -> None:
        """Whether its log is being fetched: all streams give way to that, through no fault."""
        if self._log_comes and not now:
            self.restarted()
            self._look_ns = self._checked_ns = 0
        self._log_comes = now

    def note(self, name: str) -> None:
        """Take the arrival of a message of that name."""
        self._streams.setdefault(name, _Stream()).count += 1

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all received messages, sorted."""
        streams = self._streams.items()
        return tuple(sorted(name for name, s in streams if s.count or s.rate_hz > 0.0))

    def feeds(self, topic: str, name: str, now_ns: int) -> bool:
        """Take a message's content for a topic; False where a better message brings it."""
        last_ns, _ = self._sources.get((topic, name), (now_ns, 0))
        lasting_ns = max(ALIVE_NS, min(3 * (now_ns - last_ns), MAX_DURATION_NS))
        self._sources[topic, name] = now_ns, lasting_ns
        return self._source(topic, now_ns) == name

    def inertial(self, frame: f.Attitude | f.SlowSensors, now_ns: int) -> Inertial | None:
        """Data for /imu/data from `frame`; None: nothing, or a better message is received."""
        self.note('ATTITUDE' if isinstance(frame, f.Attitude) else frame.name)
        if isinstance(frame, f.Attitude):
            self._angles = frame.angles
            rates = self._measured('ATTITUDE', frame.rates)
            if not self.feeds(INERTIAL, 'ATTITUDE', now_ns):
                return None
            return Inertial(1000 * frame.time_ms, rates, None, frame.angles, 1000)
        gyro = self._measured(frame.name, frame.gyro)
        if gyro is None or not self.feeds(INERTIAL, frame.name, now_ns):
            return None
        last_ns, _ = self._sources.get((INERTIAL, 'ATTITUDE'), (0, 0))
        grain_us = 1 if frame.name == 'HIGHRES_IMU' else 1000
        angles = self._angles if now_ns - last_ns <= ANGLES_NS else None
        return Inertial(frame.time_us, gyro, frame.accel, angles, grain_us)

    def slow(self, frame: f.SlowSensors, now_ns: int) -> list[tuple[str, f.SlowSensors]]:
        """Topic and frame of what this message feeds beside /imu/data."""
        parts = []
        if frame.mag_gauss is not None and self.feeds(COMPASS, frame.name, now_ns):
            parts.append((COMPASS, replace(frame, pressure_hpa=None)))
        if frame.pressure_hpa is not None and self.feeds(PRESSURE, frame.name, now_ns):
            parts.append((PRESSURE, replace(frame, mag_gauss=None)))
        return parts

    def sticks(
        self, frame: f.RcChannels, now_ns: int, channels: tuple[float, ...] = ()
    ) -> f.RcChannels | None:
        """The pilot's channels: roll, pitch, throttle, yaw …; None where others bring them.

        `channels` of these four, from 1, as the receiver sends them, where the autopilot says it.
        Betaflight sends them in its own order, yaw before throttle.
        """
        self.note(frame.name)
        has_channels = frame.port == 0 and bool(frame.channels)
        if not has_channels or not self.feeds(STICKS, frame.name, now_ns):
            return None
        if self.betaflight:
            channels = (1, 2, 4, 3)
        numbers = range(1, len(frame.channels) + 1)
        known = len({*channels}) == len(channels) and {*channels} <= {*numbers}
        if frame.name == 'MANUAL_CONTROL' or not known:
            return frame
        order = dict.fromkeys((*channels, *numbers))
        return replace(frame, channels=tuple(frame.channels[int(k) - 1] for k in order))

    def battery(self, frame: f.Battery, now_ns: int) -> bool:
        """Whether this one counts: of several batteries the one with the lowest number."""
        self.note(frame.name)
        if frame.name == 'BATTERY_STATUS':
            first = frame.number if self._battery is None else self._battery
            self._battery = min(frame.number, first)
            if frame.number != self._battery:
                return False
        return self.feeds(BATTERY, frame.name, now_ns)

    def outputs(self, frame: f.Outputs, now_ns: int) -> bool:
        """Whether these are the motors' pulses: those of the first port."""
        self.note('SERVO_OUTPUT_RAW')
        return frame.port == 0 and self.feeds(MOTORS, 'SERVO_OUTPUT_RAW', now_ns)

    def rotors(self, frame: f.RotorSpeeds, now_ns: int) -> f.RotorSpeeds | None:
        """All ESCs' speeds, once the last of the messages that bring them has come."""
        self.note(frame.name)
        source = TELEMETRY[0] if frame.name in TELEMETRY else frame.name
        measured = not all(math.isnan(v) for v in frame.rpm)
        if not measured or not self.feeds(ROTORS, source, now_ns):
            return None
        is_complete = frame.first + len(frame.rpm) > max(self._rpm, default=-1)
        self._rpm |= dict(enumerate(frame.rpm, frame.first))
        rpm = tuple(self._rpm.get(k, math.nan) for k in range(max(self._rpm) + 1))
        return replace(frame, first=0, rpm=rpm) if is_complete else None

    def due(self, now_ns: int) -> list[f.Command]:
        """Messages to request now: those that come too rarely, or not at all."""
        if now_ns < self._look_ns or self._log_comes:
            return []
        passed_s = 1e-9 * (now_ns - self._checked_ns) if self._checked_ns else math.inf
        self._look_ns, self._checked_ns = now_ns + ROUND_NS, now_ns
        for stream in self._streams.values():
            stream.rate_hz, stream.count = stream.count / passed_s, 0
        commands = []
        for name, target_hz in self._targets(now_ns).items():
            stream = self._streams.setdefault(name, _Stream())
            if stream.rate_hz >= ENOUGH * target_hz:
                stream.pause_ns, stream.requests, stream.reached = PAUSE_NS[0], 0, True
                stream.next_ask_ns = 0
            elif now_ns >= stream.next_ask_ns:
                if stream.reached and stream.rate_hz > 0.0:
                    self.lowered.add(name)
                stream.next_ask_ns = now_ns + stream.pause_ns
                stream.pause_ns = min(2 * stream.pause_ns, PAUSE_NS[1])
                stream.requests += 1
                interval_us = float(round(1e6 / target_hz))
                commands.append(f.Command(SET_MESSAGE_INTERVAL, (float(IDS[name]), interval_us)))
        return commands

    def rates(self, now_ns: int) -> dict[str, tuple[float, float]]:
        """Messages that feed a topic, with their rate and the wanted one, Hz."""
        targets = self._targets(now_ns)
        return {
            name: (stream.rate_hz, targets[name])
            for name, stream in sorted(self._streams.items())
            if name in targets and stream.rate_hz > 0.0
        }

    def slow_ones(self, now_ns: int) -> list[str]:
        """Messages that come more rarely than wanted although they were asked for."""
        return [] if self._log_comes else [
            name
            for name, (rate_hz, target_hz) in self.rates(now_ns).items()
            if rate_hz < ENOUGH * target_hz and self._streams[name].requests > 1
        ]

    @property
    def without_rates(self) -> bool:
        """Whether the rates are unknown, since they are exactly zero while the angles move."""
        return bool(self._without_rates)

    def missing(self, now_ns: int) -> list[str]:
        """Topics of the contract that stay empty."""
        topics = [topic for topic in SOURCES if self._source(topic, now_ns) is None]
        never = NEVER[:1] if self.also_hz else NEVER  # the others come from ATTITUDE_TARGET
        return [*(topic for topic in topics if topic not in OPTIONAL), *never]

    def _alive(self, topic: str, name: str, now_ns: int) -> bool:
        last_ns, lasting_ns = self._sources.get((topic, name), (0, -1))
        return lasting_ns >= 0 and now_ns - last_ns <= lasting_ns

    def _source(self, topic: str, now_ns: int) -> str | None:
        """The best message that brings the content of a topic now."""
        return next((n for n in SOURCES[topic] if self._alive(topic, n, now_ns)), None)

    def _targets(self, now_ns: int) -> dict[str, float]:
        """Message to wanted rate: of each topic the source and the better ones.

        Where nothing comes, one more after each request that brought nothing.
        """
        targets = {'ATTITUDE': TARGET_HZ[INERTIAL]}  # beside another source it has the angles
        for topic, names in SOURCES.items():
            source = self._source(topic, now_ns)
            for name in names:
                also = TELEMETRY if name == TELEMETRY[0] and source == name else (name,)
                targets |= {n: max(TARGET_HZ[topic], targets.get(n, 0.0)) for n in also}
                stream = self._streams.get(name)
                requested = stream is not None and (stream.requests or stream.rate_hz > 0.0)
                if name == source or (source is None and not requested):
                    break
        targets |= {name: hz for name, hz in self.also_hz.items() if name not in targets}
        return fitted(targets, self.budget)

    def _measured(self, name: str, rates: f.Vector3 | None) -> f.Vector3 | None:
        """Rates, or None where they are exactly zero although the angles have moved."""
        if rates is None:
            return None
        if any(rates):
            self._turns = True
            self._zeros.pop(name, None)
            self._without_rates.discard(name)
        elif self._angles is not None:
            first = self._zeros.setdefault(name, self._angles)
            turns = zip(self._angles, first, strict=True)
            if max(abs(math.remainder(a - b, math.tau)) for a, b in turns) > MOVED_RAD:
                self._without_rates.add(name)
        return None if name in self._without_rates else rates
