"""Starts the serial bridge and, where asked for, the logger: `port:=`, `log:=true`.

`namespace:=left` puts both, and all their topics, into a namespace: two aircraft on one machine.
"""

from pathlib import Path

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def shipped(name: str) -> dict[str, object]:
    """Return what the YAML of this package sets for a node, whatever its namespace."""
    path = Path(get_package_share_directory('quad_bridge')) / 'config' / f'{name}.yaml'
    return dict(yaml.safe_load(path.read_text(encoding='utf-8'))[name]['ros__parameters'])


def text(argument: str) -> ParameterValue:
    """Return a launch argument as a string, whatever it looks like."""
    return ParameterValue(LaunchConfiguration(argument), value_type=str)


def generate_launch_description() -> LaunchDescription:
    """Describe both nodes with the YAML files of this package."""
    common = {'package': 'quad_bridge', 'output': 'screen'}
    namespace = LaunchConfiguration('namespace')
    managed = ParameterValue(LaunchConfiguration('managed'), value_type=bool)
    return LaunchDescription(
        [
            DeclareLaunchArgument('port', default_value='/dev/ttyACM0'),
            DeclareLaunchArgument('key_file', default_value=''),
            DeclareLaunchArgument('unsigned', default_value='false'),
            DeclareLaunchArgument('robot_description', default_value=''),
            DeclareLaunchArgument('baud', default_value='921600'),
            DeclareLaunchArgument('gains', default_value='off'),
            DeclareLaunchArgument('excitation', default_value='off'),
            DeclareLaunchArgument('log', default_value='false'),
            DeclareLaunchArgument('record', default_value='true'),
            DeclareLaunchArgument('folder', default_value='.'),
            DeclareLaunchArgument('namespace', default_value=''),
            DeclareLaunchArgument('managed', default_value='false'),
            Node(
                executable='serial_bridge',
                name='serial_bridge',
                namespace=namespace,
                parameters=[
                    shipped('serial_bridge'),
                    {
                        'port': text('port'),
                        'key_file': text('key_file'),
                        'unsigned': ParameterValue(
                            LaunchConfiguration('unsigned'), value_type=bool
                        ),
                        'robot_description': text('robot_description'),
                        'baud': ParameterValue(LaunchConfiguration('baud'), value_type=int),
                        'gains': text('gains'),
                        'excitation': text('excitation'),
                        'managed': managed,
                    },
                ],
                **common,
            ),
            Node(
                executable='bag_logger',
                name='bag_logger',
                namespace=namespace,
                condition=IfCondition(LaunchConfiguration('log')),
                parameters=[
                    shipped('bag_logger'),
                    {
                        'folder': text('folder'),
                        'autostart': ParameterValue(
                            LaunchConfiguration('record'), value_type=bool
                        ),
                        'managed': managed,
                    },
                ],
                **common,
            ),
        ]
    )
