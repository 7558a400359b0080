"""Settings of the `excitation` node: parameters with ranges and units, and the schedule's file.

No ROS: the node declares the parameters.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import yaml

from quad_sysid.errors import BadInputError
from quad_sysid.signals.guard import Limits
from quad_sysid.signals.schedule import Schedule, parse_schedule

ABORT_AUX = 3
"""Default of abort_aux: docs/connect.md has the channels, 1 and 2 kill and arm."""

NUMBERS = {
    'angle_limit_deg': (25.0, 1.0, 60.0, 'angle at which the excitation ends, degrees'),
    'imu_stale_s': (0.2, 0.02, 2.0, 'age of /imu/data at which it ends, s'),
    'rc_stale_s': (1.0, 0.1, 10.0, 'age of /rc/in at which it ends, once heard, s'),
    'battery_min_v': (0.0, 0.0, 100.0, 'pack voltage below which it ends, V; 0: not checked'),
    'stick_dead_band': (0.1, 0.0, 1.0, 'rig: stick deflection that ends it, 0..1'),
    'hover_deflection': (0.6, 0.0, 1.0, 'hover: stick deflection that ends it, 0..1'),
    'abort_threshold': (0.5, -1.0, 1.0, 'value of the abort switch that ends it, -1..1'),
    'ramp_out_s': (0.5, 0.0, 5.0, 'time to take the excitation back after an abort, s'),
    'amplitude_scale': (1.0, 0.05, 1.0, 'factor on all amplitudes of the schedule'),
}
"""Name → default, lowest, highest, description."""


@dataclass(frozen=True)
class Settings:
    """Settings of the node."""

    schedule: Schedule
    limits: Limits
    ramp_out_s: float
    rate_hz: int
    abort_axis: int | None
    """Index into the axes of /rc/in; None: no switch."""
    autostart: bool
    exit_when_done: bool


def settings_from(
    schedule: Path, numbers: Mapping[str, float], aux: int, rate_hz: int,
    *, autostart: bool, exit_when_done: bool,
) -> Settings:
    """Settings from the parameters; raises BadInputError for a wrong schedule."""
    loaded = load_schedule(schedule).scaled(numbers['amplitude_scale'])
    same = {field.name: numbers[field.name] for field in fields(Limits) if field.name in numbers}
    limits = Limits(mount=loaded.mount, angle_rad=math.radians(numbers['angle_limit_deg']),
                    abort_switch=bool(aux), **same)
    return Settings(loaded, limits, numbers['ramp_out_s'], rate_hz,
                    aux + 3 if aux else None,  # AUX1 is the fifth channel, of index 4
                    autostart, exit_when_done)


def find_schedule(name: str, share: Callable[[], Path]) -> Path:
    """Path of a schedule: `name` itself, or the file of that name in the share directory."""
    path = Path(name).expanduser()
    if path.suffix or path.exists():
        return path
    try:
        folder = share() / 'config'
    except KeyError as error:
        raise BadInputError(
            'parameter schedule', 'names no file and the package is not installed', repr(name),
            'give the path of a YAML file',
        ) from error
    shipped = folder / f'{name}.yaml'
    if not shipped.exists():
        names = ', '.join(sorted(p.stem for p in folder.glob('schedule_*.yaml')))
        raise BadInputError(
            'parameter schedule', 'is neither a file nor a shipped schedule', repr(name),
            f'shipped are {names}',
        )
    return shipped


class _Loader(yaml.SafeLoader):
    """Reads 1e6 as a number, as YAML 1.2 does; PyYAML follows 1.1, which wants 1.0e+6."""


_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float', re.compile(r'[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$'),
    list('-+0123456789'),
)


def load_schedule(path: str | Path) -> Schedule:
    """Read and check a schedule; raises BadInputError naming file, segment and key."""
    source = str(path)
    try:
        content = yaml.load(Path(path).read_text(encoding='utf-8'), _Loader)  # noqa: S506  safe
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise BadInputError(source, f'cannot be read ({reason})',
                            remedy='give a schedule in YAML') from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # also endless digits, brackets
        mark = getattr(error, 'problem_mark', None)
        place = f'{source}, line {mark.line + 1}' if mark else source
        raise BadInputError(place, 'is not YAML', remedy='mend the syntax') from error
    return parse_schedule(content, source)
