"""Launch the excitation node on a schedule; start it with its ~/start service or autostart.

`namespace:=left` for one of several aircraft; a `config:=` of your own is rooted at
`/left/excitation` then, or at `/**`.
"""

from pathlib import Path

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """One node with the shipped parameters and the arguments on top."""
    config = Path(get_package_share_directory('quad_sysid')) / 'config' / 'excitation.yaml'
    shipped = yaml.safe_load(config.read_text(encoding='utf-8'))['excitation']['ros__parameters']
    schedule = ParameterValue(LaunchConfiguration('schedule'), value_type=str)
    return LaunchDescription(
        [
            DeclareLaunchArgument('schedule', default_value='schedule_rig'),
            DeclareLaunchArgument('autostart', default_value='false'),
            DeclareLaunchArgument('namespace', default_value=''),
            DeclareLaunchArgument('config', default_value=str(config)),
            Node(
                package='quad_sysid',
                executable='excitation',
                name='excitation',
                namespace=LaunchConfiguration('namespace'),
                output='screen',
                parameters=[
                    shipped,
                    LaunchConfiguration('config'),
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
