"""The firmware around the control cycle: parameters with bounds, arming, excitation, flags.

Pure state, no I/O and no clock of its own: device time comes as an argument. The cycle's
arithmetic stands in control.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from quad_bridge.gains.table import AXES, OPTIONAL, PER_AXIS, US_PER_DEG_S
from quad_bridge.virtual.airframe import Vector, require
from quad_bridge.virtual.control import (
    ADDED,
    ANGLE_LIMITED,
    ARMED,
    INJECTION,
    INPUTS,
    SATURATED,
    STICK_PITCH,
    STICK_ROLL,
    STICK_YAW,
    THROTTLE,
)
from quad_bridge.virtual.gain_columns import (
    ANGLE_KP,
    COLUMNS,
    D_FILTER_HZ,
    INTEGRATOR_LIMIT,
    KD,
    KI,
    KP,
    LQR_ANGLE,
    LQR_DAMPING,
    LQR_DELAY_S,
    LQR_DRIVE,
    LQR_GAIN,
    LQR_INTEGRAL,
    LQR_LAG_S,
    LQR_OBSERVER,
    LQR_RATE,
    LQR_SHARE,
    OUTPUT_LIMIT,
    RATE_LIMIT,
    SAG_EXPONENT,
    SAG_VOLTS,
)
from quad_bridge.virtual.receiver import Channels
from quad_bridge.wire.frames import Flag

FloatArray = npt.NDArray[np.float64]

_COLUMNS = {
    'angle.kp': ANGLE_KP,
    'angle.rate_limit': RATE_LIMIT,
    'rate.kp': KP,
    'rate.ki': KI,
    'rate.kd': KD,
    'rate.d_filter_hz': D_FILTER_HZ,
    'rate.integrator_limit': INTEGRATOR_LIMIT,
    'rate.output_limit': OUTPUT_LIMIT,
    'lqr.share': LQR_SHARE,
    'lqr.k_angle': LQR_ANGLE,
    'lqr.k_rate': LQR_RATE,
    'lqr.k_drive': LQR_DRIVE,
    'lqr.k_integral': LQR_INTEGRAL,
    'lqr.gain': LQR_GAIN,
    'lqr.lag_s': LQR_LAG_S,
    'lqr.delay_s': LQR_DELAY_S,
    'lqr.damping': LQR_DAMPING,
    'lqr.observer': LQR_OBSERVER,
    'sag.exponent': SAG_EXPONENT,
    'sag.reference_v': SAG_VOLTS,
}
TABLE = {row.name: (_COLUMNS[row.name], *(row.limits or ())) for row in (*PER_AXIS, *OPTIONAL)}
"""Parameter of an axis (contract's name behind the axis): gain column, lowest, highest."""

DEAD_MAN_S = 0.5
"""An excitation that nothing replaces ends after this long, whatever validity it came with."""

INJECTION_LIMITS = {1: math.radians(30.0), 2: 5.0, 3: 0.3}
"""Largest excitation that is accepted: attitude rad, rate rad/s, control."""


@dataclass(frozen=True)
class Gains:
    """C1 and C2 at boot; per axis or one number for all. The paper's values and its units."""

    angle_kp_per_s: Vector = (3.0, 3.0, 2.0)
    rate_kp_us_per_deg_s: Vector = (1.3, 1.3, 3.0)
    rate_ki_us_per_deg: Vector = (0.01, 0.01, 0.02)
    rate_kd_us_s_per_deg_s: Vector = (0.023, 0.023, 0.0)
    rate_limit_rad_s: Vector = (4.0, 4.0, 4.0)
    output_limit: Vector = (0.3, 0.3, 0.3)
    integrator_limit: Vector = (0.1, 0.1, 0.1)
    d_filter_hz: Vector = (30.0, 30.0, 30.0)

    def __post_init__(self) -> None:
        """Check bounds."""
        require(min(self.d_filter_hz) > 0, f'd_filter_hz must be positive: {self.d_filter_hz}')

    def table(self) -> FloatArray:
        """(3, COLUMNS) SI gains as in gain_columns.py; state feedback and schedule off."""
        columns = np.zeros((3, COLUMNS))
        columns[:, ANGLE_KP] = self.angle_kp_per_s
        columns[:, KP] = np.array(self.rate_kp_us_per_deg_s) * US_PER_DEG_S
        columns[:, KI] = np.array(self.rate_ki_us_per_deg) * US_PER_DEG_S
        columns[:, KD] = np.array(self.rate_kd_us_s_per_deg_s) * US_PER_DEG_S
        columns[:, RATE_LIMIT] = self.rate_limit_rad_s
        columns[:, OUTPUT_LIMIT] = self.output_limit
        columns[:, INTEGRATOR_LIMIT] = self.integrator_limit
        columns[:, D_FILTER_HZ] = self.d_filter_hz
        return columns


@dataclass(frozen=True)
class FirmwareSettings:
    """What is compiled into the firmware, as it were."""

    rate_hz: float = 250.0
    physics_steps_per_cycle: int = 4
    delay_cycles: int = 2
    """From computing a command to its acting on the motors."""
    auto_arm: bool = True
    stick_angle_deg: float = 30.0
    stick_yaw_rate_deg_s: float = 90.0
    angle_limit_deg: float = 30.0
    """Beyond it the flag ANGLE_LIMIT is set and excitation refused."""
    low_battery_v: float = 9.9
    gains: Gains = field(default_factory=Gains)

    def __post_init__(self) -> None:
        """Check bounds."""
        require(50.0 <= self.rate_hz <= 1000.0, f'rate_hz must lie in 50..1000: {self.rate_hz}')
        require(0 <= self.delay_cycles <= 4, f'delay_cycles must be 0..4: {self.delay_cycles}')
        steps = self.physics_steps_per_cycle
        fine = steps * self.rate_hz >= 1000.0
        require(fine, f'physics_steps_per_cycle {steps} gives less than 1 kHz of physics')
        require(steps <= 100, f'physics_steps_per_cycle must be at most 100: {steps}')


@dataclass(frozen=True)
class Request:
    """An excitation as asked for, body FLU; `injection` 0 none, 1 attitude, 2 rate, 3 control."""

    injection: int
    value: Vector
    valid_s: float
    sequence: int = 0


class Firmware:
    """State between cycles: gains, arming, the excitation in force."""

    def __init__(self, settings: FirmwareSettings, gains: FloatArray) -> None:
        self.settings = settings
        self.armed = settings.auto_arm
        self._gains = gains
        self._request: Request | None = None
        self._since_s = 0.0
        self._stale = False
        self._refused = False
        self._low_battery = False
        self._tilted = False

    def parameter(self, name: str) -> float | None:
        """The value of a gain by the contract's name (`roll.rate.kp`), None where unknown."""
        axis, _, rest = name.partition('.')
        if axis not in AXES or rest not in TABLE:
            return None
        return float(self._gains[AXES.index(axis), TABLE[rest][0]])

    def fits(self, name: str, value: float) -> bool:
        """Whether a gain of the contract's name may have this value: finite and in bounds."""
        axis, _, rest = name.partition('.')
        if axis not in AXES or rest not in TABLE:
            return False
        _, lowest, highest = TABLE[rest]
        # the bound itself may round up in float32
        return math.isfinite(value) and lowest <= value <= highest * (1.0 + 1e-6)

    def set_parameter(self, name: str, value: float) -> None:
        """Put a gain into force, as float32, if it fits."""
        if self.fits(name, value):
            axis, _, rest = name.partition('.')
            self._gains[AXES.index(axis), TABLE[rest][0]] = float(np.float32(value))

    def excite(self, request: Request, now_s: float) -> None:
        """Take a new excitation set-point; injection 0 ends the excitation."""
        self._stale = self._refused = False
        self._request = request if request.injection != 0 else None
        self._since_s = now_s
        limit = INJECTION_LIMITS.get(request.injection, -1.0)
        if self._request is not None and not all(abs(v) <= limit for v in request.value):
            self._request, self._refused = None, True

    def note(self, battery_v: float, limits: float) -> None:
        """Take over what the last cycle measured: voltage, and control.py's limit bits."""
        self._low_battery = battery_v < self.settings.low_battery_v
        self._tilted = limits >= ANGLE_LIMITED

    @property
    def low_battery(self) -> bool:
        """Whether the last cycle's voltage was below the limit."""
        return self._low_battery

    def prepare(self, channels: Channels, trim: float, now_s: float) -> tuple[FloatArray, int]:
        """The inputs of the coming cycle (INPUTS,) and its flags but SATURATED, ANGLE_LIMIT."""
        given, flags = np.zeros(INPUTS), 0
        killed = channels.kill
        turning = self.armed and not killed
        self._expire(now_s)
        if self._request is not None and (
            not turning or channels.failsafe or self._low_battery or self._tilted
        ):
            self._request, self._refused = None, True
        given[ARMED] = float(turning)
        given[THROTTLE] = trim if channels.throttle is None else channels.throttle
        if not channels.failsafe:
            given[STICK_ROLL] = channels.roll
            given[STICK_PITCH] = channels.pitch
            given[STICK_YAW] = channels.yaw
        if self._request is not None:
            given[INJECTION] = self._request.injection
            given[ADDED : ADDED + 3] = self._request.value
            flags |= Flag.EXCITATION
        flags |= Flag.ARMED if turning else 0
        flags |= Flag.RC_KILL if killed else 0
        flags |= Flag.RC_FAILSAFE if channels.failsafe else 0
        flags |= Flag.STALE_SETPOINT if self._stale else 0
        flags |= Flag.EXCITATION_REFUSED if self._refused else 0
        return given, int(flags)

    @property
    def sequence(self) -> int:
        """Sequence number of the set-point in force, 0 without one."""
        return 0 if self._request is None else self._request.sequence

    def _expire(self, now_s: float) -> None:
        request = self._request
        if request is not None and now_s - self._since_s > min(request.valid_s, DEAD_MAN_S):
            self._request, self._stale = None, True


def limit_flags(limits: float) -> int:
    """The wire's flags of the bits that a control cycle returned."""
    bits = round(limits)
    saturated = Flag.SATURATED if bits & int(SATURATED) else 0
    return int(saturated | (Flag.ANGLE_LIMIT if bits & int(ANGLE_LIMITED) else 0))
