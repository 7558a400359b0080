"""Parameters of the aircraft: mass, arm, inertia, motors, battery, mount. Values only.

Defaults are the airframe of Telli and Boumehraz (section 2.1): 1.2 kg, X frame, 4 x 940 g thrust,
3S 4500 mAh; what the paper does not give (inertia, lag, battery resistance) is plausible for that
size. Motors in the order and sense of the contract: 1 rear left, 2 rear right, 3 front right,
4 front left, 1 and 3 clockwise seen from above. Units stand in the keys.
"""

from __future__ import annotations

from dataclasses import dataclass, field

Vector = tuple[float, float, float]


def require(condition: bool, what: str) -> None:
    """Raise ValueError(what) where a configured value breaks its bound."""
    if not condition:
        raise ValueError(what)


@dataclass(frozen=True)
class Motors:
    """Four equal motors with propellers; thrust at full command and nominal voltage."""

    full_thrust_n: float = 9.218  # 940 g
    lag_s: float = 0.045
    """First-order lag of the thrust (of the speed where the thrust curve is on)."""
    torque_per_thrust_m: float = 0.016  # reaction torque per thrust
    full_speed_rad_s: float = 730.0
    rotor_inertia_kg_m2: float = 6.0e-5
    full_current_a: float = 14.0

    def __post_init__(self) -> None:
        """Check bounds."""
        require(self.full_thrust_n > 0, f'full_thrust_n must be positive, is {self.full_thrust_n}')
        require(
            0.004 <= self.lag_s <= 1.0, f'lag_s must lie in 0.004..1 (4 steps), is {self.lag_s}'
        )


@dataclass(frozen=True)
class Battery:
    """Open-circuit voltage over charge, and an inner resistance with the wires'."""

    capacity_ah: float = 4.5
    cells: int = 3
    resistance_ohm: float = 0.025
    start_charge: float = 0.95  # state of charge at the start, 0..1
    idle_current_a: float = 0.4
    charge_points: tuple[float, ...] = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 1.0)
    cell_voltage_v: tuple[float, ...] = (3.0, 3.5, 3.65, 3.74, 3.83, 3.96, 4.06, 4.2)

    def __post_init__(self) -> None:
        """Check bounds."""
        require(self.capacity_ah > 0, f'capacity_ah must be positive, is {self.capacity_ah}')
        require(0 < self.start_charge <= 1, f'start_charge must be in 0..1: {self.start_charge}')
        require(
            len(self.charge_points) == len(self.cell_voltage_v) >= 2,
            'charge_points and cell_voltage_v need one length of at least 2',
        )


@dataclass(frozen=True)
class Surroundings:
    """Effects on the rotation in one mount, per axis roll, pitch, yaw."""

    damping_per_s: Vector  # viscous torque over rate and inertia
    bias_torque_nm: Vector
    torque_noise_nm_rthz: Vector
    """One-sided intensity of the torque noise (turbulence, propeller wash)."""
    torque_noise_bandwidth_hz: float = 0.0  # first-order colouring; 0: white


@dataclass(frozen=True)
class Mounts:
    """The bearing rig with one free axis, and free hover."""

    rig: Surroundings = field(
        default_factory=lambda: Surroundings(
            damping_per_s=(0.4, 0.4, 0.3),
            bias_torque_nm=(0.004, -0.003, 0.001),
            torque_noise_nm_rthz=(2.0e-4, 2.0e-4, 1.0e-4),
        )
    )
    hover: Surroundings = field(
        default_factory=lambda: Surroundings(
            damping_per_s=(0.15, 0.15, 0.1),
            bias_torque_nm=(0.006, -0.005, 0.001),
            torque_noise_nm_rthz=(4.0e-4, 4.0e-4, 1.0e-4),
        )
    )


@dataclass(frozen=True)
class Airframe:
    """The rigid body and what drives it."""

    mass_kg: float = 1.2
    arm_m: float = 0.225  # centre to motor; the lever about roll and pitch is arm sqrt(2)/2
    inertia_kg_m2: Vector = (0.0135, 0.0140, 0.0240)
    linear_drag_per_s: float = 0.3  # translation only, in hover: drag over speed and mass
    motors: Motors = field(default_factory=Motors)
    battery: Battery = field(default_factory=Battery)
    mounts: Mounts = field(default_factory=Mounts)

    def __post_init__(self) -> None:
        """Check bounds."""
        require(self.mass_kg > 0, f'mass_kg must be positive, is {self.mass_kg}')
        require(self.arm_m > 0, f'arm_m must be positive, is {self.arm_m}')
        require(min(self.inertia_kg_m2) > 0, f'inertia_kg_m2 must be > 0: {self.inertia_kg_m2}')
