"""A node in a launch file: what matters of its parameters are arguments, a file may hold all.

What is given as an argument counts over what stands in `params_file:=`, and that over the node's
own defaults. No topics here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, List  # noqa: UP035  (launch knows no other lists)

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

TEXTS = List[str]  # noqa: UP006
COMMON = ('params_file', 'namespace')
"""Arguments of every launch file."""
BRIDGE: dict[str, Any] = {
    'port': str, 'baud': int, 'key_file': str, 'unsigned': bool, 'require_enable': bool,
    'robot_description': str, 'sources': TEXTS, 'polarity': str, 'state_folder': str,
    'aircraft': str, 'correct_sensors': bool, 'excitation_valid_ms': int, 'managed': bool,
    'use_sim_time': bool, 'gains': str, 'excitation': str, 'fetch_log': bool,
}  # fmt: skip
LOGGER: dict[str, Any] = {
    'folder': str, 'prefix': str, 'robot_description': str, 'split_mb': int, 'split_s': int,
    'reserve_mb': int, 'managed': bool, 'use_sim_time': bool,
}  # fmt: skip
IDENTIFICATION: dict[str, Any] = {
    'folder': str, 'out': str, 'axes': TEXTS, 'auto_update': bool, 'train': str,
    'validate': str, 'inertia': str, 'use_sim_time': bool,
}  # fmt: skip
EXCITATION: dict[str, Any] = {
    'schedule': str, 'autostart': bool, 'rate_hz': int, 'amplitude_scale': float,
    'angle_limit_deg': float, 'battery_min_v': float, 'abort_aux': int, 'use_sim_time': bool,
}  # fmt: skip
"""Parameters that are launch arguments, and their types."""


def arguments(*names: str, **defaults: str) -> list[Any]:
    """Declarations of launch arguments; those without a default are not set."""
    arguments = dict.fromkeys((*COMMON, *names), '') | defaults
    return [DeclareLaunchArgument(name, default_value=value) for name, value in arguments.items()]


def values(context: Any, kinds: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters that were given in this launch."""
    arguments = context.launch_configurations
    return {name: ParameterValue(arguments[name], value_type=kind) for name, kind in kinds.items()
            if arguments.get(name)}  # fmt: skip


def node(context: Any, package: str, name: str, defaults: Mapping[str, Any]) -> Any:
    """The node with these parameters over those of the file."""
    arguments = context.launch_configurations
    files = [arguments['params_file']] if arguments['params_file'] else []
    return Node(
        package=package, executable=name, name=name, namespace=arguments['namespace'],
        output='screen', parameters=[*files, *([dict(defaults)] if defaults else [])],
    )  # fmt: skip


def included(package: str, name: str, names: Iterable[str]) -> Any:
    """A launch file of a package, with the arguments of these names handed on."""
    path = Path(get_package_share_directory(package)) / 'launch' / f'{name}.launch.py'
    arguments = {argument: LaunchConfiguration(argument) for argument in sorted(names)}
    return IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(path)), launch_arguments=arguments.items()
    )


def deferred(make: Any) -> Any:
    """The actions of `make(context)`, which is called once the launch arguments are known."""
    return OpaqueFunction(function=make)
