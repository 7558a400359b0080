"""A profile: everything that one virtual aircraft is, from one YAML file (and what it extends)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from quad_bridge.virtual.airframe import Airframe, require
from quad_bridge.virtual.configuration import build, read_yaml
from quad_bridge.virtual.effects import Effects
from quad_bridge.virtual.errors import ConfigurationError
from quad_bridge.virtual.firmware import FirmwareSettings
from quad_bridge.virtual.receiver import Receiver
from quad_bridge.virtual.sensors import Sensors

FOLDER = Path(__file__).with_name('profiles')


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
        known = {'roll', 'pitch', 'yaw'}
        require(self.axis in known, f'axis must be roll, pitch or yaw, is {self.axis!r}')


def profile_names() -> tuple[str, ...]:
    """Names of the profiles that come with the package."""
    return tuple(sorted(path.stem for path in FOLDER.glob('*.yaml')))


def load_profile(name_or_path: str | Path) -> Profile:
    """A profile by its name or its file; ConfigurationError names file and key."""
    path = Path(name_or_path)
    if path.suffix not in {'.yaml', '.yml'}:
        path = FOLDER / f'{name_or_path}.yaml'
        if not path.is_file():
            known = ', '.join(profile_names())
            raise ConfigurationError(
                'profile', f'unknown name {str(name_or_path)!r}', remedy=f'known are {known}'
            )
    return build(Profile, read_yaml(path, FOLDER), f'{path}: profile')
