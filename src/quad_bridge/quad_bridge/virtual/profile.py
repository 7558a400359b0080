"""A profile: everything that one virtual aircraft is, from one YAML file (and what it extends)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from quad_bridge.gains.table import AXES, SETTABLE
from quad_bridge.virtual.airframe import Airframe, require
from quad_bridge.virtual.configuration import build, read_yaml
from quad_bridge.virtual.effects import Effects
from quad_bridge.virtual.errors import ConfigurationError
from quad_bridge.virtual.receiver import Receiver
from quad_bridge.virtual.sensors import Sensors

FOLDER = Path(__file__).with_name('profiles')


@dataclass(frozen=True)
class FirmwareSettings:
    """Start values of the firmware, and the steps of the physics between its cycles."""

    rate_hz: float = 250.0
    physics_steps_per_cycle: int = 4
    delay_cycles: int = 2  # from computing a command to its acting on the motors
    auto_arm: bool = True
    stick_angle_deg: float = 30.0
    stick_yaw_rate_deg_s: float = 90.0
    angle_limit_deg: float = 30.0  # beyond it the flag ANGLE_LIMIT is set and excitation refused
    low_battery_v: float = 9.9
    gains: Mapping[str, float] = field(default_factory=dict)
    """Gains by the contract's names, SI; the others start as gains/table.py says."""

    def __post_init__(self) -> None:
        """Check bounds."""
        require(50.0 <= self.rate_hz <= 1000.0, f'rate_hz must lie in 50..1000: {self.rate_hz}')
        require(self.rate_hz == int(self.rate_hz), f'rate_hz must be whole: {self.rate_hz}')
        require(0 <= self.delay_cycles <= 4, f'delay_cycles must be 0..4: {self.delay_cycles}')
        steps = self.physics_steps_per_cycle
        is_fast = steps * self.rate_hz >= 1000.0
        require(is_fast, f'physics_steps_per_cycle {steps} gives less than 1 kHz of physics')
        require(steps <= 20, f'physics_steps_per_cycle must be at most 20: {steps}')
        unknown = sorted(self.gains.keys() - set(SETTABLE))
        require(not unknown, f'gains: unknown {", ".join(unknown)}')


@dataclass(frozen=True)
class Pilot:
    """Holds the height in hover with a little throttle, slowly; not on the rig."""

    climb_kp_per_m: float = 0.02
    climb_kd_s_per_m: float = 0.03


@dataclass(frozen=True)
class Profile:
    """One virtual aircraft; `Profile()` is the profile `plain`."""

    mount: str = 'rig'  # `rig` or `hover`
    axis: str = 'roll'  # the free axis on the rig
    airframe: Airframe = field(default_factory=Airframe)
    effects: Effects = field(default_factory=Effects)
    sensors: Sensors = field(default_factory=Sensors)
    firmware: FirmwareSettings = field(default_factory=FirmwareSettings)
    receiver: Receiver = field(default_factory=Receiver)
    pilot: Pilot = field(default_factory=Pilot)

    def __post_init__(self) -> None:
        """Check names."""
        require(self.mount in {'rig', 'hover'}, f'mount must be rig or hover, is {self.mount!r}')
        require(self.axis in AXES, f'axis must be roll, pitch or yaw, is {self.axis!r}')


def profile_names() -> tuple[str, ...]:
    """Names of the profiles that come with the package."""
    return tuple(sorted(path.stem for path in FOLDER.glob('*.yaml')))


def load_profile(name_or_path: str | Path) -> Profile:
    """A profile by its name or its file; ConfigurationError names file and key."""
    path = Path(name_or_path)
    if path.suffix not in {'.yaml', '.yml'}:
        path = FOLDER / f'{name_or_path}.yaml'
        if not path.is_file():
            names = ', '.join(profile_names())
            raise ConfigurationError(
                'profile', f'unknown name {str(name_or_path)!r}', remedy=f'known are {names}'
            )
    return build(Profile, read_yaml(path, FOLDER), f'{path}: profile')
