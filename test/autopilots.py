"""Stand-ins of other autopilots: one scripted class, and a table of what was seen of each.

They fly nothing: a slow roll goes on and on. What differs between PX4, ArduPilot and Betaflight
is in `Kind`: which messages come unasked and how often, which can be asked for, what is wrong
with their content, how TIMESYNC is answered, and how parameters are encoded. `Autopilot` has
`cycle` and `receive`, as the scripted flight controller has, so that it stands in a `Line` or
behind a `Port`:

    line = Line(Autopilot(PX4))
    line.fly(6.0); line.out
    Autopilot(ARDUPILOT, timesync_s=0.04, only=('ATTITUDE',), boot_us=2**32)
"""

import math
import struct
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from pymavlink.dialects.v20 import ardupilotmega as mav

from quad_bridge.wire import dialect

STEP_US = 4000
ROLL_RAD, TURNS_HZ = 0.3, 0.5
SET_MESSAGE_INTERVAL, ARM_DISARM = 511, 400
ACCEPTED, UNSUPPORTED = 0, 3
INT32, REAL32 = 6, 9
GRAVITY, UNUSED = 9.80665, 65535
INERTIAL = ('HIGHRES_IMU', 'SCALED_IMU', 'ATTITUDE')


@dataclass(frozen=True)
class Kind:
    """What was seen of one autopilot."""

    autopilot: int
    """MAV_AUTOPILOT of its heartbeat."""
    unasked: Mapping[str, float]
    """Messages that it streams by itself, Hz."""
    most_hz: Mapping[str, float] = field(default_factory=dict)
    """Messages that SET_MESSAGE_INTERVAL is obeyed for, and up to which rate."""
    timesync_s: float | None = 0.0002
    """How long the answer to TIMESYNC takes; None: there is none."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """Integers are int, others float."""
    bytewise: bool = False
    """Whether an integer's bytes lie in the float of PARAM_VALUE, or its value."""
    gauss: float = 1.0
    """Factor by which the compass of HIGHRES_IMU is too large."""
    hpa: float = 1.0
    """What its HIGHRES_IMU says for 1 hPa."""
    rates: bool = True
    """Whether its messages have rates; else they are zero."""
    obeys: bool = True
    """Whether it answers commands."""
    timesync_us_bits: int = 63
    """Width of the µs in its answers to TIMESYNC."""
    sticks: tuple[int, ...] = (0, 1, 2, 3)
    """Order of roll, pitch, throttle and yaw in its channels."""


ALL = dict.fromkeys(
    ('HIGHRES_IMU', 'SCALED_IMU', 'ATTITUDE', 'SERVO_OUTPUT_RAW', 'RC_CHANNELS', 'RC_CHANNELS_RAW',
     'MANUAL_CONTROL', 'SCALED_PRESSURE', 'BATTERY_STATUS', 'SYS_STATUS'), 250.0)  # fmt: skip
PX4_PLACES = ((0.15, 0.2), (-0.15, -0.2), (0.15, -0.2), (-0.15, 0.2))  # forward, right
PX4 = Kind(
    autopilot=12,
    # in SIH's default set of streams the IMU is alive, and far too slow
    unasked={'HIGHRES_IMU': 50.0, 'ATTITUDE': 10.0, 'SYS_STATUS': 1.0, 'RC_CHANNELS': 5.0},
    most_hz={name: hz for name, hz in ALL.items() if name != 'RC_CHANNELS_RAW'}
    | {'ESC_STATUS': 50.0},
    parameters={
        'CA_ROTOR_COUNT': 4, **{f'CA_ROTOR{k}_PX': x for k, (x, _) in enumerate(PX4_PLACES)},
        **{f'CA_ROTOR{k}_PY': y for k, (_, y) in enumerate(PX4_PLACES)},
        **{f'CA_ROTOR{k}_KM': 0.05 if k < 2 else -0.05 for k in range(4)},
        **{f'PWM_MAIN_FUNC{k + 1}': 101 + k for k in range(4)},
        **dict.fromkeys(('RC_MAP_ROLL', 'RC_MAP_PITCH', 'RC_MAP_THROTTLE', 'RC_MAP_YAW'), 0)},
    bytewise=True,
    hpa=100.0,
)
ARDUPILOT = Kind(
    autopilot=3,
    unasked={'RAW_IMU': 4.0, 'ATTITUDE': 4.0, 'SCALED_PRESSURE': 4.0, 'RC_CHANNELS': 4.0,
             'RC_CHANNELS_RAW': 4.0, 'SERVO_OUTPUT_RAW': 4.0, 'SYS_STATUS': 4.0},
    most_hz=ALL | {'ESC_TELEMETRY_1_TO_4': 250.0},
    parameters={'FRAME_CLASS': 1, 'FRAME_TYPE': 0, 'MOT_PWM_MIN': 1000, 'MOT_PWM_MAX': 2000,
                'RCMAP_ROLL': 1, 'RCMAP_PITCH': 2, 'RCMAP_THROTTLE': 3, 'RCMAP_YAW': 4,
                **{f'SERVO{k}_FUNCTION': 32 + k if k < 5 else 0 for k in range(1, 17)}},
    gauss=1e6,
)  # fmt: skip
BETAFLIGHT = Kind(
    autopilot=0,  # generic, as many others
    unasked={'ATTITUDE': 10.0, 'RC_CHANNELS_RAW': 5.0, 'SYS_STATUS': 2.0, 'VFR_HUD': 10.0},
    timesync_s=0.04,
    timesync_us_bits=32,
    rates=False,
    obeys=False,
    sticks=(0, 1, 3, 2),
)


class Autopilot:
    """One of them; attributes may be changed while it runs."""

    outputs_us, sticks_us = (1100, 1200, 1300, 1400), (1500, 1600, 1200, 1450)
    """Pulses to the motors; those of roll, pitch, throttle and yaw."""
    volts, pressure_hpa = 11.7, 1000.0

    def __init__(
        self, kind: Kind, *, boot_us: int = 0, only: tuple[str, ...] | None = None, **changed
    ) -> None:
        """`boot_us` is its time when the test begins, `only` the messages that it has."""
        self.kind = replace(kind, **changed)
        self.boot_us, self.step = boot_us, 0
        self.has = lambda name: only is None or name in only
        self.mav = mav.MAVLink(None, 1, 1)
        self.ears = mav.MAVLink(None)
        self.ears.robust_parsing = True
        self.parameters = dict(self.kind.parameters)
        self.streams: dict[str, float] = {}
        for name, hz in self.kind.unasked.items():
            self.set_rate(name, hz)
        self.asked: dict[str, list[float]] = {}
        """Message to the rates that it was asked for, Hz."""
        self.heard: list[str] = []
        self.armed, self.mode = True, 0
        """`mode` is custom_mode of the heartbeat."""
        self.share = 1.0  # of the rates that the line has left over
        self._late: deque[tuple[int, bytes]] = deque()
        self._owed: dict[str, float] = {}

    def set_rate(self, name: str, hz: float) -> None:
        if self.has(name):
            self.streams[name] = hz

    @property
    def now_us(self) -> int:
        return self.boot_us + STEP_US * self.step

    def pack(self, message) -> bytes:
        self.mav.seq = (self.mav.seq + 1) % 256
        return bytes(message.pack(self.mav))

    def cycle(self) -> bytes:
        """Bytes of the coming step of 4 ms."""
        self.step, out = self.step + 1, b''
        while self._late and self._late[0][0] <= self.step:
            out += self._late.popleft()[1]
        if self.step % 250 == 1:
            out += self.heartbeat()
        for name, hz in self.streams.items():
            owed = self._owed.get(name, 0.0) + self.share * hz * 1e-6 * STEP_US
            self._owed[name] = owed % 1.0
            if owed >= 1.0 - 1e-9:
                self._owed[name] = max(owed - 1.0, 0.0)
                out += self.pack(self.message(name))
        return out

    def heartbeat(self) -> bytes:
        return self.pack(mav.MAVLink_heartbeat_message(
            2, self.kind.autopilot, 128 if self.armed else 0, self.mode, 4, 3))

    def moves(self):
        """Angles, rad, and rates, rad/s, now."""
        turn = 2e-6 * math.pi * TURNS_HZ * self.now_us
        roll, rate = ROLL_RAD * math.sin(turn), ROLL_RAD * math.tau * TURNS_HZ * math.cos(turn)
        return (roll, 0.2, 0.3), (rate, -0.25, 0.125)

    def message(self, name: str):
        us, ms = self.now_us, self.now_us // 1000 % 2**32
        angles, rates = self.moves()
        p, q, r = rates if self.kind.rates else (0.0, 0.0, 0.0)
        b = 0.4 * self.kind.gauss
        rpm, cell_mv = [6000, 6100, 6200, 6300], round(1000 * self.volts / 3)

        def sticks():
            return (*(self.sticks_us[k] for k in self.kind.sticks), 1000, 1000, 1000, 1000)

        made = {
            'HIGHRES_IMU': lambda: mav.MAVLink_highres_imu_message(
                us, 0.0, 0.0, -GRAVITY, p, q, r, 0.5 * b, 0.25 * b, -b,
                self.pressure_hpa * self.kind.hpa, 0, 0, 20.0, 0x0FFF
            ),
            'SCALED_IMU': lambda: mav.MAVLink_scaled_imu_message(
                ms, 0, 0, -1000, *(round(1000 * v) for v in (p, q, r)), 200, 100, -400
            ),
            'RAW_IMU': lambda: mav.MAVLink_raw_imu_message(us, 0, 0, -1000, 1, 1, 1, 200, 100, 4),
            'ATTITUDE': lambda: mav.MAVLink_attitude_message(ms, *angles, p, q, r),
            'SERVO_OUTPUT_RAW': lambda: mav.MAVLink_servo_output_raw_message(
                us % 2**32, 0, *self.outputs_us, 0, 0, 0, 0
            ),
            'RC_CHANNELS': lambda: mav.MAVLink_rc_channels_message(
                ms, 8, *sticks(), *([UNUSED] * 10), 255
            ),
            'RC_CHANNELS_RAW': lambda: mav.MAVLink_rc_channels_raw_message(ms, 0, *sticks(), 255),
            'MANUAL_CONTROL': lambda: mav.MAVLink_manual_control_message(1, 200, 0, -600, -100, 0),
            'VFR_HUD': lambda: mav.MAVLink_vfr_hud_message(0.0, 0.0, 17, 20, 0.0, 0.0),
            'SCALED_PRESSURE': lambda: mav.MAVLink_scaled_pressure_message(ms, 990.0, 0.0, 2000),
            'BATTERY_STATUS': lambda: mav.MAVLink_battery_status_message(
                0, 0, 0, 2000, [cell_mv] * 3 + [UNUSED] * 7, 150, -1, -1, 80
            ),
            'SYS_STATUS': lambda: mav.MAVLink_sys_status_message(
                1, 1, 1, 100, 11_800, 250, 77, 0, 0, 0, 0, 0, 0
            ),
            'ESC_STATUS': lambda: dialect.MAVLink_esc_status_message(
                0, us, rpm, [11.0] * 4, [1.0] * 4
            ),
            'ESC_TELEMETRY_1_TO_4': lambda: mav.MAVLink_esc_telemetry_1_to_4_message(
                [20] * 4, [1100] * 4, [100] * 4, [1] * 4, rpm, [7] * 4
            ),
        }
        return made[name]()

    def receive(self, data: bytes, now_ns: int) -> bytes:
        """The bytes with which it answers, `now_ns` after the test began."""
        out = b''
        for message in self.ears.parse_buffer(data) or []:
            self.heard.append(message.get_type())
            if message.get_type() == 'TIMESYNC' and message.tc1 == 0:
                out += self._timesync(message.ts1, now_ns)
            elif self.kind.obeys:
                out += b''.join(self.pack(answer) for answer in self._answers(message))
        return out

    def _timesync(self, asked_ns: int, now_ns: int) -> bytes:
        taken_s = self.kind.timesync_s
        if taken_s is None:
            return b''
        told_ns = 1000 * self.boot_us + now_ns + round(0.5e9 * taken_s)
        told_ns %= 1000 << self.kind.timesync_us_bits
        answer = self.pack(mav.MAVLink_timesync_message(told_ns, asked_ns))
        if taken_s < 1e-6 * STEP_US:
            return answer
        self._late.append((self.step + round(1e6 * taken_s / STEP_US), answer))
        return b''

    def _answers(self, message):
        kind = message.get_type()
        if kind == 'COMMAND_LONG':
            yield mav.MAVLink_command_ack_message(message.command, self._command(message))
        elif kind == 'PARAM_REQUEST_READ':
            names = [*self.parameters]
            at = message.param_index
            name = names[at] if 0 <= at < len(names) else message.param_id
            if name in self.parameters:
                yield self.value(name)

    def _command(self, message) -> int:
        if message.command == SET_MESSAGE_INTERVAL:
            name = next((n for n in self.kind.most_hz if ID[n] == int(message.param1)), None)
            if name is None or not self.has(name):
                return UNSUPPORTED
            hz = 1e6 / message.param2
            self.asked.setdefault(name, []).append(hz)
            self.set_rate(name, min(hz, self.kind.most_hz[name]))
            return ACCEPTED
        return UNSUPPORTED

    def value(self, name: str):
        """PARAM_VALUE as this autopilot encodes it."""
        value, names = self.parameters[name], [*self.parameters]
        number, kind = float(value), REAL32
        if isinstance(value, int):
            kind = INT32
            if self.kind.bytewise:
                (number,) = struct.unpack('<f', struct.pack('<i', value))
        where = (len(names), names.index(name))
        return mav.MAVLink_param_value_message(name.encode(), number, kind, *where)


ID = {message.msgname: number for number, message in mav.mavlink_map.items()} | {'ESC_STATUS': 291}
