"""The whole loop on ArduCopter: `port:=`, `gains:=allow`, `excitation:=allow`; docs/ardupilot.md.

All arguments are those of autopilot.launch.py.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

DEFAULTS = {'port': 'udp://127.0.0.1:14550', 'schedule': 'schedule_system_id'}


def generate_launch_description() -> LaunchDescription:
    """Describe autopilot.launch.py with the port and schedule of ArduCopter."""
    folder = Path(get_package_share_directory('quad_tuning')) / 'launch'
    given = {name: LaunchConfiguration(name) for name in DEFAULTS}
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=value) for name, value in DEFAULTS.items()),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(folder / 'autopilot.launch.py')),
            launch_arguments=given.items(),
        ),
    ])
