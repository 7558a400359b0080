"""Parameters of the `excitation` node: names, ranges, units, and what they become."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor

from quad_bridge import ros_node
from quad_sysid.errors import BadInputError
from quad_sysid.schedule_file import load_schedule
from quad_sysid.signals.guard import Limits
from quad_sysid.signals.schedule import Schedule

FIRST_AUX = 4

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
OTHERS = ('schedule', 'autostart', 'exit_when_done', 'rate_hz', 'abort_aux')


@dataclass(frozen=True)
class Settings:
    """What the node was started with."""

    schedule: Schedule
    limits: Limits
    ramp_out_s: float
    rate_hz: int
    abort_axis: int | None
    """Index into the axes of /rc/in; None: no switch."""
    autostart: bool
    exit_when_done: bool


def declare(node: Any) -> Settings:
    """Declare and read the parameters; raises BadInputError naming the file or parameter."""
    ros_node.refuse_unknown(node, [*NUMBERS, *OTHERS])
    name = ros_node.text(
        node, 'schedule', 'schedule_rig', 'YAML file, or the name of a shipped schedule'
    )
    autostart = ros_node.flag(node, 'autostart', False, 'start as soon as the guard lets it')
    exit_when_done = ros_node.flag(
        node, 'exit_when_done', False, 'end the process with the schedule (status 0 done, 1 not)'
    )
    rate_hz = ros_node.integer(node, 'rate_hz', 250, (10, 1000), 'set-points per second')
    aux = ros_node.integer(
        node, 'abort_aux', 2, (0, 5), "channel aux 1..5 of the pilot's abort switch; 0: none"
    )
    value = {key: _number(node, key, *spec) for key, spec in NUMBERS.items()}
    schedule = load_schedule(find_schedule(name, _share)).scaled(value['amplitude_scale'])
    limits = Limits(
        mount=schedule.mount,
        angle_rad=math.radians(value['angle_limit_deg']),
        imu_stale_s=value['imu_stale_s'], rc_stale_s=value['rc_stale_s'],
        battery_min_v=value['battery_min_v'], stick_dead_band=value['stick_dead_band'],
        hover_deflection=value['hover_deflection'], abort_threshold=value['abort_threshold'],
    )
    return Settings(
        schedule, limits, value['ramp_out_s'], rate_hz,
        FIRST_AUX + aux - 1 if aux else None, autostart, exit_when_done,
    )


def find_schedule(name: str, share: Callable[[], Path]) -> Path:
    """Path of a schedule: as given, or shipped under that name in the share directory."""
    given = Path(name).expanduser()
    if given.suffix or given.exists():
        return given
    try:
        folder = share() / 'config'
    except PackageNotFoundError as error:
        raise BadInputError(
            'parameter schedule', 'names no file and the package is not installed', repr(name),
            'give the path of a YAML file',
        ) from error
    shipped = folder / f'{name}.yaml'
    if not shipped.exists():
        known = ', '.join(sorted(p.stem for p in folder.glob('schedule_*.yaml')))
        raise BadInputError(
            'parameter schedule', 'is neither a file nor a shipped schedule', repr(name),
            f'shipped are {known}',
        )
    return shipped


def _share() -> Path:
    return Path(get_package_share_directory('quad_sysid'))


def _number(
    node: Any, name: str, default: float, low: float, high: float, description: str
) -> float:
    """Declare a read-only number with its range and return its value."""
    descriptor = ParameterDescriptor(
        description=description, read_only=True,
        floating_point_range=[FloatingPointRange(from_value=low, to_value=high, step=0.0)],
    )
    return float(node.declare_parameter(name, default, descriptor).value)
