"""The messages on the wire, as frozen values: one dataclass for each that the suite uses.

Units and axes are the wire's: SI, body FRD, attitude relative to NED (axes.py turns them). No
bytes here (codec.py), no ROS.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag

Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
REAL32 = 9  # MAV_PARAM_TYPE: a parameter's float; 1 to 8 are integers


class Flag(IntFlag):
    """State of the controller in one cycle (enum QUAD_FLAG)."""

    NONE = 0
    ARMED = 1
    SATURATED = 2
    EXCITATION = 4
    RC_KILL = 8
    RC_FAILSAFE = 16
    STALE_SETPOINT = 32
    EXCITATION_REFUSED = 64
    ANGLE_LIMIT = 128
    OVERRUN = 256
    MOTOR_TEST = 512
    HOLD = 1024
    LANDED = 2048

    def __rand__(self, bits: int) -> int:  # type: ignore[override]
        """Bits of a frame as a plain number: an enum of them takes microseconds each cycle."""
        return bits & self._value_


class Injection(IntEnum):
    """Point at which an excitation is added (enum QUAD_INJECTION), by the contract's names."""

    NONE = 0
    ATTITUDE = 1
    RATE = 2
    CONTROL = 3
    THRUST = 4


class GainsAction(IntEnum):
    """An action on the staged set (enum QUAD_GAINS_ACTION); each is idempotent."""

    QUERY = 0
    OPEN = 1
    COMMIT = 2
    CONFIRM = 3
    REVERT = 4


class GainsPhase(IntEnum):
    """Phase of the STM32's set of parameters (enum QUAD_GAINS_PHASE)."""

    IDLE = 0
    STAGING = 1
    WATCH = 2


class GainsResult(IntEnum):
    """The result of an action (enum QUAD_GAINS_RESULT); 3 and 4 are sent unasked."""

    OK = 0
    WRONG_ID = 1
    CHECKSUM = 2
    LINK_LOST = 3
    NOT_CONFIRMED = 4
    NOT_FLOWN = 5
    ARMED = 6


@dataclass(frozen=True)
class Cycle:
    """All data of one control cycle."""

    time_us: int  # start of the cycle, µs since boot
    cycle: int  # cycles since boot, 32 bits
    gyro: Vector3  # p q r, rad/s, FRD, filtered, bias removed
    accel: Vector3  # specific force, m/s², FRD: at rest and level (0, 0, -9.81)
    attitude: Vector3  # roll, pitch, yaw, rad, FRD relative to NED
    attitude_setpoint: Vector3  # reference that C1 used, rad, excitation included
    rate_setpoint: Vector3  # reference that C2 used, rad/s, FRD, excitation included
    control: Vector4
    """U1 (collective, positive up), U2..U4 (torque demand about x y z, FRD), normalised."""
    excitation: Vector3  # what was added, per axis, FRD, in the unit of `injection`
    motors: Vector4  # commands of motors 1 to 4, 0..1, after mixer and limits
    flags: int  # bits of `Flag`; a plain int, for speed
    excitation_seq: int = 0  # sequence number (8 bits) of the excitation set-point in use
    injection: int = 0  # an `Injection`


@dataclass(frozen=True)
class Excitation:
    """Excitation that the STM32 adds until it is replaced or `valid_ms` old."""

    value: Vector3  # per axis, FRD, rad, rad/s or normalised command
    injection: int
    seq: int  # 8 bits, wraps
    valid_ms: int = 100
    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True)
class Heartbeat:
    """HEARTBEAT; `system` and `component` are the sender's (the encoder puts in its own)."""

    type: int = 2  # MAV_TYPE: 2 quadrotor, 18 onboard controller (the bridge)
    autopilot: int = 0  # MAV_AUTOPILOT: 0 generic, 8 none (the bridge)
    armed: bool = False
    system_status: int = 4  # MAV_STATE: 3 standby, 4 active, 5 critical
    custom_mode: int = 0
    system: int = 0
    component: int = 0


@dataclass(frozen=True)
class TimeSync:
    """TIMESYNC: a question has tc1 = 0; the answer holds the answerer's time in tc1, ns."""

    tc1_ns: int
    ts1_ns: int  # the asker's time, mirrored in the answer, ns


@dataclass(frozen=True)
class ParamRequestList:
    """Asks for all parameters."""

    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True)
class ParamRequestRead:
    """Asks for one parameter by name, or by index where `index` >= 0."""

    name: str
    index: int = -1
    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True)
class ParamSet:
    """Writes one parameter (float32 on the wire); answered by a ParamValue."""

    name: str
    value: float
    target_system: int = 0
    target_component: int = 0
    kind: int = REAL32


@dataclass(frozen=True)
class ParamValue:
    """The value that the flight controller uses now."""

    name: str
    value: float  # as on the wire: PX4 puts the bytes of an integer into it
    count: int
    index: int
    kind: int = REAL32


@dataclass(frozen=True)
class GainsCommand:
    """One action on the staged set of parameters; answered by a GainsState."""

    action: int  # a `GainsAction`
    transaction: int  # 1..255
    checksum: int = 0  # COMMIT: of the whole copy (`checksum` in gains/protocol.py)
    watch_ms: int = 0  # COMMIT: revert without CONFIRM after this long, ms
    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True)
class GainsState:
    """The answer to a GainsCommand; unasked once a second and after the STM32's own revert."""

    aircraft: int  # unique number of the controller, 64 bits
    checksum: int  # CRC of all active parameters (`checksum` in gains/protocol.py)
    transaction: int
    action: int  # a `GainsAction`; QUERY where unasked
    result: int  # a `GainsResult`
    phase: int  # a `GainsPhase`


@dataclass(frozen=True)
class RcChannels:
    """RC_CHANNELS: pulse lengths in µs, receiver order; `channels` holds `count` <= 18 of them.

    RC_CHANNELS_RAW holds eight of a `port`, counted from 0. MANUAL_CONTROL, of a pilot with a
    joystick at a ground station, has four sticks and no time; they are given as pulses.
    """

    time_ms: int | None
    channels: tuple[int, ...]
    rssi: int = 255
    port: int = 0
    name: str = 'RC_CHANNELS'  # the message that it came in


@dataclass(frozen=True)
class Battery:
    """BATTERY_STATUS reduced to the pack: V, A, 0..1; NaN where not measured."""

    voltage_v: float
    current_a: float = float('nan')
    remaining: float = float('nan')
    name: str = 'BATTERY_STATUS'  # the message that it came in; SYS_STATUS has it too
    number: int = 0  # index of the battery, where there are several


@dataclass(frozen=True)
class SlowSensors:
    """HIGHRES_IMU, SCALED_IMU, SCALED_PRESSURE; None where not updated.

    Magnetometer in gauss, FRD, barometer in hPa; boards of ours send nothing else in it.
    """

    time_us: int
    mag_gauss: Vector3 | None = None
    pressure_hpa: float | None = None
    temperature_c: float = 0.0
    gyro: Vector3 | None = None  # rad/s, FRD; only other autopilots fill it
    accel: Vector3 | None = None  # m/s², FRD; only other autopilots fill it
    name: str = 'HIGHRES_IMU'  # the message that it came in


@dataclass(frozen=True)
class Command:
    """COMMAND_LONG."""

    command: int
    parameters: tuple[float, ...] = ()  # up to seven
    confirmation: int = 0
    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True)
class CommandAck:
    """COMMAND_ACK; result 0 is accepted."""

    command: int
    result: int


@dataclass(frozen=True)
class StatusText:
    """STATUSTEXT: severity as syslog (0 emergency .. 7 debug), text up to 50 bytes."""

    severity: int
    text: str


@dataclass(frozen=True)
class Attitude:
    """ATTITUDE of another autopilot: roll, pitch, yaw, rad, FRD relative to NED; rates, rad/s."""

    time_ms: int
    angles: Vector3
    rates: Vector3 | None  # None where they cannot be


@dataclass(frozen=True)
class Outputs:
    """SERVO_OUTPUT_RAW of another autopilot: the pulses of a port, µs, 0 where there is none."""

    time_us: int  # 32 bits: wraps after 71.6 minutes
    port: int
    pulses: tuple[int, ...]


@dataclass(frozen=True)
class RotorSpeeds:
    """ESC_STATUS, ESC_TELEMETRY_*, RPM of another autopilot; NaN where an ESC measures none."""

    first: int  # number of the first of these ESCs, from 0
    rpm: tuple[float, ...]  # magnitudes
    time_us: int | None = None  # None: the message bears no time
    name: str = 'ESC_STATUS'  # the message that it came in


@dataclass(frozen=True)
class AttitudeTarget:
    """ATTITUDE_TARGET: what another autopilot's loops follow; FRD relative to NED."""

    time_ms: int
    mask: int  # bits of the fields to ignore
    q: Vector4  # w x y z
    rates: Vector3  # rad/s
    thrust: float  # 0..1


@dataclass(frozen=True)
class SetAttitudeTarget:
    """SET_ATTITUDE_TARGET: attitude or rates, and thrust; FRD relative to NED."""

    time_ms: int
    mask: int
    q: Vector4  # w x y z
    rates: Vector3  # rad/s
    thrust: float
    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True)
class LocalPosition:
    """LOCAL_POSITION_NED, m and m/s."""

    time_ms: int
    place: Vector3
    speed: Vector3


@dataclass(frozen=True)
class LandedState:
    """EXTENDED_SYS_STATE: 1 on the ground, 2 in the air, 3 taking off, 4 landing, 0 unknown."""

    landed: int


@dataclass(frozen=True)
class Version:
    """AUTOPILOT_VERSION: the firmware's version and the board's unique number."""

    firmware: int  # major, minor, patch, kind: a byte each
    board: int
    uid: int
    uid2: tuple[int, ...] = ()


@dataclass(frozen=True)
class LogRequestList:
    """Asks for the list of an autopilot's own logs."""

    start: int = 0
    end: int = 0xFFFF
    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True)
class LogEntry:
    """One of these logs; `size` in bytes may be about right only."""

    number: int
    count: int  # number of all logs
    last: int
    time_utc_s: int  # 0 where it is not known
    size: int


@dataclass(frozen=True)
class LogRequestData:
    """Asks for a part of a log."""

    number: int
    offset: int
    count: int
    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True)
class LogData:
    """90 bytes of a log at most; fewer end it."""

    number: int
    offset: int
    data: bytes


@dataclass(frozen=True)
class LogRequestEnd:
    """Ends the transfer of logs."""

    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True)
class Standard:
    """A standard message that the suite knows by name but does not use."""

    name: str


Frame = (
    Cycle | Excitation | Heartbeat | TimeSync | ParamRequestList | ParamRequestRead | ParamSet
    | ParamValue | GainsCommand | GainsState | RcChannels | Battery | SlowSensors | Command
    | CommandAck | StatusText | Attitude | Outputs | RotorSpeeds | AttitudeTarget
    | SetAttitudeTarget | LocalPosition | LandedState | Version | LogRequestList | LogEntry
    | LogRequestData | LogData | LogRequestEnd | Standard
)  # fmt: skip
