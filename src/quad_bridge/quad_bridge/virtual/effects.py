"""The table of physical effects that the virtual aircraft can have beyond the base.

Each has a switch and a strength; all are off by default. Values only: physics.py has the equations
(vibration: sensors.py). One number stands for all three axes.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from quad_bridge.virtual.airframe import Vector, require


@dataclass(frozen=True)
class Effect:
    """The part that all effects share: a switch."""

    enabled: bool = False


@dataclass(frozen=True)
class ThrustCurve(Effect):
    """thrust = full thrust ((1 - curvature) n + curvature n^2), n the lagged command."""

    curvature: float = 0.5


@dataclass(frozen=True)
class BatterySag(Effect):
    """Thrust follows (voltage / reference)^exponent."""

    exponent: float = 1.5
    reference_v: float = 11.1

    def __post_init__(self) -> None:
        """Check bounds."""
        require(self.reference_v > 0, f'reference_v must be positive: {self.reference_v}')


@dataclass(frozen=True)
class CoulombFriction(Effect):
    """Constant torque against the rate's sign, with true sticking."""

    torque_nm: Vector = (0.004, 0.004, 0.004)


@dataclass(frozen=True)
class Stribeck(Effect):
    """Friction coulomb + (static - coulomb) exp(-(rate / speed)^2) against the rate."""

    static_nm: Vector = (0.012, 0.012, 0.012)
    coulomb_nm: Vector = (0.004, 0.004, 0.004)
    speed_rad_s: float = 0.15


@dataclass(frozen=True)
class QuadraticDrag(Effect):
    """Torque -coefficient rate |rate|."""

    coefficient_nm_s2: Vector = (0.006, 0.006, 0.006)


@dataclass(frozen=True)
class PendulumStiffness(Effect):
    """Torque -stiffness sin(angle) about roll and pitch; negative: centre of mass above."""

    stiffness_nm_rad: Vector = (0.15, 0.15, 0.0)


@dataclass(frozen=True)
class CubicStiffness(Effect):
    """Torque -stiffness angle^3."""

    stiffness_nm_rad3: Vector = (3.0, 3.0, 0.0)


@dataclass(frozen=True)
class DeadZone(Effect):
    """The command of an axis does nothing within +-half_width, and is shifted by it outside."""

    half_width: Vector = (0.003, 0.003, 0.003)


@dataclass(frozen=True)
class Backlash(Effect):
    """Play of +-half_width between the command of an axis and its torque."""

    half_width: Vector = (0.004, 0.004, 0.004)


@dataclass(frozen=True)
class Saturation(Effect):
    """The motors' own limits, narrower than what /motors/command shows."""

    lower: float = 0.2
    upper: float = 0.45


@dataclass(frozen=True)
class MotorLag(Effect):
    """Some motors (1..4) are slower than the others."""

    motors: tuple[int, ...] = (1,)
    slow_time_constant_s: float = 0.12

    def __post_init__(self) -> None:
        """Check bounds."""
        require(set(self.motors) <= {1, 2, 3, 4}, f'motors must be out of 1..4: {self.motors}')
        require(self.slow_time_constant_s >= 0.004, 'slow_time_constant_s must be at least 0.004')


@dataclass(frozen=True)
class GyroscopicCoupling(Effect):
    """Rotors' angular momentum, eqs. (4), (5) with opposite signs, plus a constant one."""

    rotor_scale: float = 1.0
    extra_momentum_nm_s: float = 0.0
    """Momentum of a steady spin about body z, positive counter-clockwise from above."""


@dataclass(frozen=True)
class InertiaCoupling(Effect):
    """Euler's term -rate x (I rate) of eqs. (4) to (6); nothing on the rig."""


@dataclass(frozen=True)
class CrossAxisInput(Effect):
    """A fraction of one axis' command also acts on another axis."""

    fraction: float = 0.1
    from_axis: str = 'pitch'
    to_axis: str = 'roll'

    def __post_init__(self) -> None:
        """Check names."""
        for axis in (self.from_axis, self.to_axis):
            require(axis in {'roll', 'pitch', 'yaw'}, f'axis must be roll, pitch, yaw: {axis!r}')


@dataclass(frozen=True)
class Resonance(Effect):
    """A lightly damped mode in the drive: adds peak * drive at its frequency."""

    frequency_hz: float = 6.0
    damping_ratio: float = 0.05
    peak: Vector = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class PeriodicDisturbance(Effect):
    """A sinusoidal torque; the phase is drawn from the seed."""

    frequency_hz: float = 2.3
    amplitude_nm: Vector = (0.01, 0.01, 0.01)


@dataclass(frozen=True)
class StepEvent(Effect):
    """After `time_s` the drive is scaled by 1 + gain_change and a torque is added."""

    time_s: float = 30.0
    gain_change: Vector = (0.0, 0.0, 0.0)
    torque_nm: Vector = (0.01, 0.01, 0.01)


@dataclass(frozen=True)
class Ground(Effect):
    """A ground to take off from and to land on, and its cushion of air; in hover only.

    Thrust is multiplied by 1 / (1 - (radius / 4 height)^2) (Cheeseman and Bennett, 1955) with the
    rotors' height; radius 0: no cushion. What stands on it does not turn.
    """

    height_m: float = 0.0
    """Height of the ground in the world; the flight begins at 0."""
    rotor_radius_m: float = 0.127
    rotor_height_m: float = 0.12  # above the ground, standing

    def __post_init__(self) -> None:
        """Check bounds."""
        require(self.height_m <= 0.0, f'height_m must not be above the start: {self.height_m}')
        require(0.0 <= self.rotor_radius_m < 2.0 * self.rotor_height_m,
                'rotor_radius_m must lie in 0..2 rotor_height_m')  # fmt: skip


@dataclass(frozen=True)
class Vibration(Effect):
    """Lines in the gyro before its filter, rad/s each."""

    frequency_hz: tuple[float, ...] = (47.0, 94.0)
    amplitude_rad_s: tuple[float, ...] = (0.05, 0.02)

    def __post_init__(self) -> None:
        """Check lengths."""
        require(
            len(self.frequency_hz) == len(self.amplitude_rad_s),
            'frequency_hz and amplitude_rad_s need one length',
        )


@dataclass(frozen=True)
class AirDrag(Effect):
    """Force -coefficient v |v| of the body in the air, by body axis; in hover only."""

    coefficient_n_s2_m2: Vector = (0.25, 0.25, 0.4)


@dataclass(frozen=True)
class RotorDrag(Effect):
    """Force -coefficient v of each rotor in its plane, proportional to its speed; in hover only.

    The coefficient is that at full speed.
    """

    coefficient_n_s_m: float = 0.15


@dataclass(frozen=True)
class Effects:
    """All effects; `Effects()` has none."""

    thrust_curve: ThrustCurve = field(default_factory=ThrustCurve)
    battery_sag: BatterySag = field(default_factory=BatterySag)
    coulomb_friction: CoulombFriction = field(default_factory=CoulombFriction)
    stribeck: Stribeck = field(default_factory=Stribeck)
    quadratic_drag: QuadraticDrag = field(default_factory=QuadraticDrag)
    pendulum_stiffness: PendulumStiffness = field(default_factory=PendulumStiffness)
    cubic_stiffness: CubicStiffness = field(default_factory=CubicStiffness)
    dead_zone: DeadZone = field(default_factory=DeadZone)
    backlash: Backlash = field(default_factory=Backlash)
    saturation: Saturation = field(default_factory=Saturation)
    motor_lag: MotorLag = field(default_factory=MotorLag)
    gyroscopic_coupling: GyroscopicCoupling = field(default_factory=GyroscopicCoupling)
    inertia_coupling: InertiaCoupling = field(default_factory=InertiaCoupling)
    cross_axis_input: CrossAxisInput = field(default_factory=CrossAxisInput)
    resonance: Resonance = field(default_factory=Resonance)
    periodic_disturbance: PeriodicDisturbance = field(default_factory=PeriodicDisturbance)
    step_event: StepEvent = field(default_factory=StepEvent)
    ground: Ground = field(default_factory=Ground)
    vibration: Vibration = field(default_factory=Vibration)
    air_drag: AirDrag = field(default_factory=AirDrag)
    rotor_drag: RotorDrag = field(default_factory=RotorDrag)
