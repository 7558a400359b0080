"""An autopilot with standard messages only: their use, and the topics that are missing. Pure.

Two tables: which message feeds which topic, and how often it is asked for
(MAV_CMD_SET_MESSAGE_INTERVAL). Stamps are the link's affair.
"""

from __future__ import annotations

from dataclasses import dataclass

from quad_bridge.wire.frames import Attitude, Battery, Command, Outputs, SlowSensors, Vector3

SET_MESSAGE_INTERVAL = 511
ASK_AGAIN_NS = 5_000_000_000
ALIVE_NS = 1_000_000_000  # a message that has not come for so long does not come

INTERVALS_US = {
    'HIGHRES_IMU': (105, 4000),
    'SCALED_IMU': (26, 4000),
    'ATTITUDE': (30, 4000),
    'SERVO_OUTPUT_RAW': (36, 4000),
    'RC_CHANNELS': (65, 20_000),
    'SCALED_PRESSURE': (29, 20_000),
    'BATTERY_STATUS': (147, 100_000),
}
"""Name: id and wanted interval, µs."""
SOURCES = {
    '/imu/data': ('HIGHRES_IMU', 'SCALED_IMU', 'ATTITUDE'),
    '/motors/command': ('SERVO_OUTPUT_RAW',),
    '/rc/in': ('RC_CHANNELS',),
    '/imu/mag': ('HIGHRES_IMU', 'SCALED_IMU'),
    '/baro': ('HIGHRES_IMU', 'SCALED_PRESSURE'),
    '/battery': ('BATTERY_STATUS', 'SYS_STATUS'),
}
"""Topics that standard messages can feed, the better one first."""
NEVER = ('/control/wrench', '/setpoint/attitude', '/setpoint/rates', '/excitation/applied')
"""Topics that need QUAD_CYCLE."""


@dataclass(frozen=True)
class Inertial:
    """Data for /imu/data, FRD, rad/s, m/s², rad; None where unknown."""

    time_us: int
    gyro: Vector3
    accel: Vector3 | None
    attitude: Vector3 | None


class Autopilot:
    """Arrival times of messages; chooses among those with the same content."""

    def __init__(self) -> None:
        self._seen: dict[str, int] = {}
        self._angles: Vector3 | None = None
        self._next_ask_ns = 0
        self.asked = 0  # intervals asked for so far

    def clear(self) -> None:
        """Forget the autopilot."""
        self.__init__()  # type: ignore[misc]

    def note(self, name: str, now_ns: int) -> None:
        """Take the arrival of a message of that name."""
        self._seen[name] = now_ns

    def alive(self, name: str, now_ns: int) -> bool:
        """Whether it is still being received."""
        return now_ns - self._seen.get(name, -ALIVE_NS - 1) <= ALIVE_NS

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all received messages, sorted."""
        return tuple(sorted(self._seen))

    def inertial(self, frame: Attitude | SlowSensors, now_ns: int) -> Inertial | None:
        """Data for /imu/data from `frame`; None: nothing, or a better message is received."""
        if isinstance(frame, Attitude):
            self.note('ATTITUDE', now_ns)
            self._angles = frame.angles
            if self.alive('HIGHRES_IMU', now_ns) or self.alive('SCALED_IMU', now_ns):
                return None
            return Inertial(1000 * frame.time_ms, frame.rates, None, frame.angles)
        self.note(frame.name, now_ns)
        better = frame.name != 'HIGHRES_IMU' and self.alive('HIGHRES_IMU', now_ns)
        if frame.gyro is None or better:
            return None
        angles = self._angles if self.alive('ATTITUDE', now_ns) else None
        return Inertial(frame.time_us, frame.gyro, frame.accel, angles)

    def battery(self, frame: Battery, now_ns: int) -> bool:
        """Whether this one counts: SYS_STATUS only where no BATTERY_STATUS comes."""
        self.note(frame.name, now_ns)
        return frame.name == 'BATTERY_STATUS' or not self.alive('BATTERY_STATUS', now_ns)

    def outputs(self, frame: Outputs, now_ns: int) -> bool:
        """Whether these are the motors' pulses: those of the first port."""
        self.note('SERVO_OUTPUT_RAW', now_ns)
        return frame.port == 0

    def due(self, now_ns: int) -> list[Command]:
        """Messages to request now: those not being received."""
        if now_ns < self._next_ask_ns:
            return []
        self._next_ask_ns = now_ns + ASK_AGAIN_NS
        wanted = [(n, v) for n, v in INTERVALS_US.items() if not self.alive(n, now_ns)]
        self.asked += len(wanted)
        return [Command(SET_MESSAGE_INTERVAL, (float(i), float(us))) for _, (i, us) in wanted]

    def missing(self, now_ns: int) -> list[str]:
        """Topics of the contract that stay empty."""
        silent = [
            topic
            for topic, names in SOURCES.items()
            if not any(self.alive(name, now_ns) for name in names)
        ]
        return [*silent, *NEVER]
