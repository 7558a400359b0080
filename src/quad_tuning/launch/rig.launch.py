"""Starts an aircraft on the one-axis rig: flight.launch.py and the rig's excitation, waiting.

`ros2 service call /bag_logger/start std_srvs/srv/Trigger`, then `/excitation/start`.
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

HANDED_ON = ('port', 'key_file', 'folder', 'namespace', 'auto_update')


def generate_launch_description() -> LaunchDescription:
    """Describe flight.launch.py and the excitation node."""
    flight = Path(get_package_share_directory('quad_tuning')) / 'launch' / 'flight.launch.py'
    config = Path(get_package_share_directory('quad_sysid')) / 'config' / 'excitation.yaml'
    shipped = yaml.safe_load(config.read_text(encoding='utf-8'))
    schedule = ParameterValue(LaunchConfiguration('schedule'), value_type=str)
    return LaunchDescription(
        [
            DeclareLaunchArgument('port', default_value='/dev/ttyACM0'),
            DeclareLaunchArgument('key_file', default_value=''),
            DeclareLaunchArgument('folder', default_value='.'),
            DeclareLaunchArgument('namespace', default_value=''),
            DeclareLaunchArgument('auto_update', default_value='false'),
            DeclareLaunchArgument('schedule', default_value='schedule_rig'),
            DeclareLaunchArgument('autostart', default_value='false'),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(flight)),
                launch_arguments={name: LaunchConfiguration(name) for name in HANDED_ON}.items(),
            ),
            Node(
                package='quad_sysid',
                executable='excitation',
                name='excitation',
                namespace=LaunchConfiguration('namespace'),
                output='screen',
                parameters=[
                    shipped['excitation']['ros__parameters'],
                    {
                        'schedule': schedule,
                        'autostart': ParameterValue(
                            LaunchConfiguration('autostart'), value_type=bool
                        ),
                    },
                ],
            ),
        ]
    )
