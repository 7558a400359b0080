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
from launch.substitutions import LaunchConfiguration, TextSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from quad_bridge.errors import BadInputError

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
MEANS = {
    'params_file': 'a file of parameters of these nodes, over which arguments count',
    'namespace': 'where nodes and topics are, for one of several aircraft',
    'use_sim_time': 'stamps by /clock',
    'managed': 'true: a lifecycle manager configures and activates bridge and logger',
    'port': "the aircraft's: a device, /dev/ttyACM*, udp://HOST:PORT, socket://HOST:PORT",
    'baud': 'bit/s of a serial port',
    'key_file': 'key that signs the link, required where the port is on another computer',
    'unsigned': 'true: no key, although everybody on that network may then command',
    'require_enable': 'true: excite and arm only while /operator/enable comes',
    'robot_description': 'where the motors are: a layout, a file with a URDF or its text',
    'sources': "who may change gains: patterns of `source`, ['quad-tune*'] for one",
    'polarity': 'pulses before the first update of gains: auto, manual or off',
    'state_folder': 'the history of gains and the checks of each aircraft',
    'aircraft': 'name of its folder there',
    'correct_sensors': "subtract the gyro's bias at rest from /imu/data",
    'excitation_valid_ms': 'how long the STM32 keeps an excitation that nothing replaces',
    'gains': 'to PX4 or ArduPilot: off, or allow; read docs/px4.md or docs/ardupilot.md first',
    'excitation': 'to PX4 or ArduPilot: off, or allow; read the same pages first',
    'fetch_log': 'fetch the log of PX4 or ArduPilot after each landing',
    'log': 'true: a logger beside the bridge, inside: in its process, false: none',
    'record': 'true: the logger records from the start, false: it waits for its ~/start',
    'folder': 'where the bags are',
    'prefix': 'how their names begin',
    'split_mb': 'a new file in the bag after so many MB; 0: never',
    'split_s': 'or after so many seconds; 0: never',
    'reserve_mb': 'free disk, MB, without which no recording starts',
    'out': "the report's folder; beside the bag, NAME_identified, if not given",
    'axes': '[roll, pitch]; those that the bag excites if not given',
    'auto_update': 'true: new gains are sent to the aircraft, not only proposed',
    'train': 'A:B, s from the first /imu/data; as the bag says if not given',
    'validate': 'A:B, s, likewise',
    'inertia': 'IX,IY,IZ in kg m²: the report then has torques in N m too',
    'schedule': 'what is flown: schedule_rig or another that is shipped, or a file',
    'autostart': 'true: fly the schedule at once, false: wait for ~/start',
    'rate_hz': 'rate of the excitation',
    'amplitude_scale': 'factor on every amplitude of the schedule',
    'angle_limit_deg': 'an angle that ends the excitation',
    'battery_min_v': 'a voltage below which it ends; 0.0: not watched',
    'abort_aux': "auxiliary channel of the pilot's abort switch; 0: none",
    'profile': 'the virtual aircraft: a profile that is shipped, or a file',
    'link': 'name of the link to its pseudo-terminal',
    'lockstep': 'true: simulated time waits for the slowest node',
}
"""What each launch argument means, as `ros2 launch … -s` shows it."""


CHOICES = {'log': ['true', 'inside', 'false']}
"""Arguments that are one of these words: `log:=yes` would fly and record nothing."""


def argument(name: str, default: str) -> Any:
    """Declaration of a launch argument, with what it means."""
    return DeclareLaunchArgument(name, default_value=default, description=MEANS[name],
                                 choices=CHOICES.get(name))


def arguments(*names: str, **defaults: str) -> list[Any]:
    """Declarations of launch arguments; those without a default are not set."""
    defaults_of = dict.fromkeys((*COMMON, *names), '') | defaults
    return [argument(name, default) for name, default in defaults_of.items()]


def values(context: Any, kinds: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters that were given in this launch."""
    configurations = context.launch_configurations
    return {name: typed(configurations[name], kind) for name, kind in kinds.items()
            if configurations.get(name)}


def typed(text: str, kind: Any) -> Any:
    """The value of a parameter whose launch argument is `text`: plain text would count as str."""
    return ParameterValue(TextSubstitution(text=text), value_type=kind)


def node(context: Any, package: str, name: str, defaults: Mapping[str, Any]) -> Any:
    """The node with these parameters over those of the file.

    Raises BadInputError for a file that is not there: launch warns and starts the node without it,
    with other bounds of gains and other guards than were meant.
    """
    arguments = context.launch_configurations
    files = [arguments['params_file']] if arguments['params_file'] else []
    for file in files:
        if not Path(file).is_file():
            raise BadInputError('params_file', 'is no file', file)
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
