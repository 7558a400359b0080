"""Starts an aircraft on the one-axis rig: flight.launch.py and the rig's excitation, waiting.

`ros2 service call /bag_logger/start std_srvs/srv/Trigger`, then `/excitation/start`.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

FLIGHT = {'port': '/dev/ttyACM0', 'key_file': '', 'folder': '.', 'namespace': '',
          'auto_update': 'false'}
EXCITATION = {'schedule': 'schedule_rig', 'autostart': 'false', 'namespace': ''}
"""Arguments of what is included, and their defaults."""


def included(package: str, name: str, arguments: dict[str, str]) -> IncludeLaunchDescription:
    """Hand the arguments on to a launch file."""
    path = Path(get_package_share_directory(package)) / 'launch' / f'{name}.launch.py'
    given = {argument: LaunchConfiguration(argument) for argument in arguments}
    return IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(path)), launch_arguments=given.items()
    )


def generate_launch_description() -> LaunchDescription:
    """Describe flight.launch.py and the excitation node."""
    defaults = FLIGHT | EXCITATION
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=value) for name, value in defaults.items()),
        included('quad_tuning', 'flight', FLIGHT),
        included('quad_sysid', 'excitation', EXCITATION),
    ])
