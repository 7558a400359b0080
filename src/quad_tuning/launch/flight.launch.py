"""Starts what flies along: bridge, logger, identification; `port:=`, `folder:=`.

The logger waits for `~/start`. Gains are only proposed, unless `auto_update:=true`. The excitation
is started by hand: `ros2 launch quad_sysid excitation.launch.py schedule:=schedule_hover`.
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

BRIDGE = {'port': '/dev/ttyACM0', 'key_file': '', 'folder': '.', 'namespace': ''}
"""Arguments that are handed on, and their defaults."""


def generate_launch_description() -> LaunchDescription:
    """Describe the nodes with the YAML files of their packages."""
    bridge = Path(get_package_share_directory('quad_bridge')) / 'launch' / 'bridge.launch.py'
    config = Path(get_package_share_directory('quad_sysid')) / 'config' / 'identification.yaml'
    shipped = yaml.safe_load(config.read_text(encoding='utf-8'))
    defaults = {**BRIDGE, 'auto_update': 'false'}
    handed_on = {name: LaunchConfiguration(name) for name in BRIDGE}
    update = ParameterValue(LaunchConfiguration('auto_update'), value_type=bool)
    folder = ParameterValue(handed_on['folder'], value_type=str)
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=value) for name, value in defaults.items()),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(bridge)),
            launch_arguments={**handed_on, 'log': 'true', 'record': 'false'}.items(),
        ),
        Node(package='quad_sysid', executable='identification', name='identification',
             namespace=handed_on['namespace'], output='screen',
             parameters=[shipped['identification']['ros__parameters'],
                         {'auto_update': update, 'folder': folder}]),
    ])
