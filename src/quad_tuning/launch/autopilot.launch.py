"""What flies along with PX4 or ArduPilot: bridge, logger, excitation, identification.

px4.launch.py and ardupilot.launch.py are this with their port and schedule. Neither gains nor an
excitation reach the aircraft unless `gains:=allow` and `excitation:=allow` say so; the excitation
waits for its `~/start`, the logger for its own.
"""

from pathlib import Path

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

BRIDGE = {
    'port': '/dev/ttyACM0', 'baud': '921600', 'key_file': '', 'unsigned': 'false', 'folder': '.',
    'namespace': '', 'gains': 'off', 'excitation': 'off', 'robot_description': '',
}
"""Arguments that are handed on, and their defaults."""


def shipped(name: str) -> dict[str, object]:
    """Return what the YAML of quad_sysid sets for a node, whatever its namespace."""
    path = Path(get_package_share_directory('quad_sysid')) / 'config' / f'{name}.yaml'
    return dict(yaml.safe_load(path.read_text(encoding='utf-8'))[name]['ros__parameters'])


def generate_launch_description() -> LaunchDescription:
    """Describe the nodes with the YAML files of their packages."""
    bridge = Path(get_package_share_directory('quad_bridge')) / 'launch' / 'bridge.launch.py'
    defaults = {**BRIDGE, 'schedule': 'schedule_hover'}
    given = {name: LaunchConfiguration(name) for name in defaults}
    text = {name: ParameterValue(given[name], value_type=str) for name in ('folder', 'schedule')}
    common = {'package': 'quad_sysid', 'namespace': given['namespace'], 'output': 'screen'}
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=value) for name, value in defaults.items()),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(bridge)),
            launch_arguments={**{name: given[name] for name in BRIDGE}, 'log': 'true',
                              'record': 'false'}.items(),
        ),
        Node(executable='excitation', name='excitation',
             parameters=[shipped('excitation'), {'schedule': text['schedule']}], **common),
        Node(executable='identification', name='identification',
             parameters=[shipped('identification'), {'folder': text['folder']}], **common),
    ])
