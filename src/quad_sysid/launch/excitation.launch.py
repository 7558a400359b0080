"""Launch the excitation node on a schedule; start it with its ~/start service or autostart."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """One node with the shipped parameters and the arguments on top."""
    config = Path(get_package_share_directory('quad_sysid')) / 'config' / 'excitation.yaml'
    return LaunchDescription(
        [
            DeclareLaunchArgument('schedule', default_value='schedule_rig'),
            DeclareLaunchArgument('autostart', default_value='false'),
            DeclareLaunchArgument('config', default_value=str(config)),
            Node(
                package='quad_sysid',
                executable='excitation',
                name='excitation',
                output='screen',
                parameters=[
                    LaunchConfiguration('config'),
                    {
                        'schedule': LaunchConfiguration('schedule'),
                        'autostart': ParameterValue(
                            LaunchConfiguration('autostart'), value_type=bool
                        ),
                    },
                ],
            ),
        ]
    )
