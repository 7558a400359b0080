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


def generate_launch_description() -> LaunchDescription:
    """Describe the nodes with the YAML files of their packages."""
    bridge = Path(get_package_share_directory('quad_bridge')) / 'launch' / 'bridge.launch.py'
    config = Path(get_package_share_directory('quad_sysid')) / 'config' / 'identification.yaml'
    shipped = yaml.safe_load(config.read_text(encoding='utf-8'))
    namespace = LaunchConfiguration('namespace')
    return LaunchDescription(
        [
            DeclareLaunchArgument('port', default_value='/dev/ttyACM0'),
            DeclareLaunchArgument('key_file', default_value=''),
            DeclareLaunchArgument('folder', default_value='.'),
            DeclareLaunchArgument('namespace', default_value=''),
            DeclareLaunchArgument('auto_update', default_value='false'),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(bridge)),
                launch_arguments={
                    'port': LaunchConfiguration('port'),
                    'key_file': LaunchConfiguration('key_file'),
                    'folder': LaunchConfiguration('folder'),
                    'namespace': namespace,
                    'log': 'true',
                    'record': 'false',
                }.items(),
            ),
            Node(
                package='quad_sysid',
                executable='identification',
                name='identification',
                namespace=namespace,
                output='screen',
                parameters=[
                    shipped['identification']['ros__parameters'],
                    {
                        'auto_update': ParameterValue(
                            LaunchConfiguration('auto_update'), value_type=bool
                        )
                    },
                ],
            ),
        ]
    )
