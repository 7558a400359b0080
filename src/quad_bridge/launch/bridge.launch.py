"""Starts the serial bridge and, where asked for, the logger: `port:=`, `log:=true`."""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Describe both nodes with the YAML files of this package."""
    config = get_package_share_directory('quad_bridge') + '/config'
    return LaunchDescription(
        [
            DeclareLaunchArgument('port', default_value='/dev/ttyACM0'),
            DeclareLaunchArgument('log', default_value='false'),
            DeclareLaunchArgument('folder', default_value='.'),
            Node(
                package='quad_bridge',
                executable='serial_bridge',
                name='serial_bridge',
                output='screen',
                parameters=[
                    f'{config}/serial_bridge.yaml',
                    {'port': LaunchConfiguration('port')},
                ],
            ),
            Node(
                package='quad_bridge',
                executable='bag_logger',
                name='bag_logger',
                output='screen',
                condition=IfCondition(LaunchConfiguration('log')),
                parameters=[
                    f'{config}/bag_logger.yaml',
                    {'folder': LaunchConfiguration('folder'), 'autostart': True},
                ],
            ),
        ]
    )
