"""The firmware's settings in a profile. The firmware itself is C: firmware/."""

from __future__ import annotations

from dataclasses import dataclass, field

from quad_bridge.gains.table import AXES, US_PER_DEG_S
from quad_bridge.virtual.airframe import Vector, require

_IN_US = {'rate.kp', 'rate.ki', 'rate.kd'}


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

    def values(self) -> dict[str, float]:
        """The contract's names and SI values; state feedback and schedule stay off."""
        return {
            f'{axis}.{name}': US_PER_DEG_S * row[i] if name in _IN_US else row[i]
            for name, row in (
                ('angle.kp', self.angle_kp_per_s),
                ('angle.rate_limit', self.rate_limit_rad_s),
                ('rate.kp', self.rate_kp_us_per_deg_s),
                ('rate.ki', self.rate_ki_us_per_deg),
                ('rate.kd', self.rate_kd_us_s_per_deg_s),
                ('rate.d_filter_hz', self.d_filter_hz),
                ('rate.integrator_limit', self.integrator_limit),
                ('rate.output_limit', self.output_limit),
            )
            for i, axis in enumerate(AXES)
        }


@dataclass(frozen=True)
class FirmwareSettings:
    """What the firmware is started with, and how the physics goes on between its cycles."""

    rate_hz: float = 250.0
    physics_steps_per_cycle: int = 4
    delay_cycles: int = 2  # from computing a command to its acting on the motors
    auto_arm: bool = True
    stick_angle_deg: float = 30.0
    stick_yaw_rate_deg_s: float = 90.0
    angle_limit_deg: float = 30.0  # beyond it the flag ANGLE_LIMIT is set and excitation refused
    low_battery_v: float = 9.9
    gains: Gains = field(default_factory=Gains)

    def __post_init__(self) -> None:
        """Check bounds."""
        require(50.0 <= self.rate_hz <= 1000.0, f'rate_hz must lie in 50..1000: {self.rate_hz}')
        require(self.rate_hz == int(self.rate_hz), f'rate_hz must be whole: {self.rate_hz}')
        require(0 <= self.delay_cycles <= 4, f'delay_cycles must be 0..4: {self.delay_cycles}')
        steps = self.physics_steps_per_cycle
        fine = steps * self.rate_hz >= 1000.0
        require(fine, f'physics_steps_per_cycle {steps} gives less than 1 kHz of physics')
        require(steps <= 20, f'physics_steps_per_cycle must be at most 20: {steps}')
