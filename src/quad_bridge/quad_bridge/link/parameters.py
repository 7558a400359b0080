"""Parameters of another autopilot that say how craft and sticks lie, asked for by name. Pure.

PX4 and ArduPilot have a thousand parameters; a few dozen are read, some at a time, each asked for
again where no answer comes. A name that the firmware does not know gets no answer either: it is
asked for rarely from then on, because the line may have been silent for a while. What the values
mean is not known here.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

from quad_bridge.wire.frames import REAL32, Heartbeat, ParamRequestRead, ParamValue

AT_ONCE = 8  # requests on their way: a telemetry radio must not be flooded
AGAIN_NS, TRIES = 400_000_000, 3  # longer than an answer over a telemetry radio usually takes
LATE_NS = 2_000_000_000  # between two tries once the first have failed
PX4, ARDUPILOT = 12, 3  # MAV_AUTOPILOT
_INTEGERS = {1: 'B', 2: 'b', 3: 'H', 4: 'h', 5: 'I', 6: 'i'}  # MAV_PARAM_TYPE to its layout
_PX4_ROTOR = ('PX', 'PY', 'PZ', 'AZ', 'KM')
_PX4_MOST, _PX4_OUTPUTS = 12, 16
PX4_FIRST_MOTOR = 101  # output function Motor 1
_COUNT = 'CA_ROTOR_COUNT'
_MAPS = {PX4: 'RC_MAP_', ARDUPILOT: 'RCMAP_'}
_STICKS = ('ROLL', 'PITCH', 'THROTTLE', 'YAW')
_ARDUPILOT = (
    *(f'RCMAP_{stick}' for stick in _STICKS),
    'FRAME_CLASS', 'FRAME_TYPE', 'MOT_PWM_MIN', 'MOT_PWM_MAX',
    *(f'SERVO{k}_FUNCTION' for k in range(1, 17)),
)  # fmt: skip


def number(value: ParamValue, *, bytewise: bool) -> float:
    """The value of a parameter: an integer's bytes lie in the float (PX4), or it is the float."""
    layout = _INTEGERS.get(value.kind)
    if not bytewise or layout is None:
        return value.value
    return float(struct.unpack_from(f'<{layout}', struct.pack('<f', value.value))[0])


def encoded(value: float, kind: int, *, bytewise: bool) -> float:
    """The number that PARAM_SET carries for a value of this kind; `number` turns it back."""
    layout = _INTEGERS.get(kind)
    if layout is None:
        return value
    if not bytewise:
        return float(round(value))
    packed = struct.pack(f'<{layout}', round(value)).ljust(4, b'\0')
    return float(struct.unpack('<f', packed)[0])


class Parameters:
    """Requests the parameters of one autopilot; `complete` once all have arrived or expired."""

    def __init__(self, peer: Heartbeat) -> None:
        self.values: dict[str, float] = {}
        self._bytewise = peer.autopilot == PX4
        self._autopilot = peer.autopilot
        self._requested: dict[str, tuple[int, int]] = {}  # name to tries and when it is due again

    @property
    def channels(self) -> tuple[float, ...]:
        """The receiver's channels of roll, pitch, throttle, yaw, from 1; 0 where not known."""
        name = _MAPS.get(self._autopilot, '')
        return tuple(self.values.get(name + stick, 0.0) for stick in _STICKS)

    @property
    def complete(self) -> bool:
        """Whether no request is open."""
        return not any(self._open(name) for name in self._names())

    def take(self, value: ParamValue) -> None:
        """Store a value, whoever requested it."""
        is_known_kind = value.kind == REAL32 or value.kind in _INTEGERS
        if not is_known_kind or value.name not in self._names():
            return
        decoded = number(value, bytewise=self._bytewise)
        if not math.isfinite(decoded):  # an integer's may be, as it is on PX4's wire
            return
        if self.complete and value.name in self._requested and value.name not in self.values:
            self._requested.clear()  # it answers now: the others may do so too
        self.values[value.name] = decoded

    def due(self, now_ns: int) -> list[ParamRequestRead]:
        """The requests to send now."""
        waiting = [name for name in self._names() if self._open(name)]
        waiting = waiting or [name for name in self._names() if name not in self.values
                              and now_ns >= self._requested[name][1]]
        requests = []
        for name in waiting[:AT_ONCE]:
            tries, again_ns = self._requested.get(name, (0, 0))
            if now_ns >= again_ns:
                pause_ns = AGAIN_NS if tries < TRIES else LATE_NS
                self._requested[name] = tries + 1, now_ns + pause_ns
                if tries != TRIES:
                    requests.append(ParamRequestRead(name))
        return requests

    def _open(self, name: str) -> bool:
        return name not in self.values and self._requested.get(name, (0, 0))[0] <= TRIES

    def _names(self) -> tuple[str, ...]:
        if self._autopilot == PX4:
            return px4_names(self.values)
        return ardupilot_names(self.values) if self._autopilot == ARDUPILOT else ()


def ardupilot_names(values: Mapping[str, float]) -> tuple[str, ...]:
    """Names of ArduPilot's parameters that are needed, by the values known so far.

    Without a range in MOT_PWM_* the motors' pulses are those of the throttle's stick.
    """
    if 0.0 < values.get('MOT_PWM_MIN', 1.0) < values.get('MOT_PWM_MAX', math.inf):
        return _ARDUPILOT
    stick = int(values.get('RCMAP_THROTTLE', 3.0))
    return (*_ARDUPILOT, f'RC{stick}_MIN', f'RC{stick}_MAX')


def px4_names(values: Mapping[str, float]) -> tuple[str, ...]:
    """Names of PX4's geometry parameters that are needed, by the values known so far."""
    count = min(max(int(values.get(_COUNT, 0)), 0), _PX4_MOST)
    if not count:
        return (_COUNT,)
    rotors = (f'CA_ROTOR{k}_{part}' for k in range(count) for part in _PX4_ROTOR)
    outputs = [f'PWM_MAIN_FUNC{k}' for k in range(1, _PX4_OUTPUTS + 1)]
    motors = range(PX4_FIRST_MOTOR, PX4_FIRST_MOTOR + count)
    if {values.get(name) for name in outputs} >= set(motors):
        outputs = []  # every motor has its output
    elif not all(name in values for name in outputs[:count]):
        outputs = outputs[:count]
    return (_COUNT, *rotors, *outputs, *(f'RC_MAP_{stick}' for stick in _STICKS))
