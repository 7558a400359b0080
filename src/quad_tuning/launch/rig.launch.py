"""Starts an aircraft on the one-axis rig: flight.launch.py and the rig's excitation, waiting.

`ros2 service call /bag_logger/start std_srvs/srv/Trigger`, then `/excitation/start`.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from quad_bridge.nodes.launched import (
    BRIDGE,
    COMMON,
    EXCITATION,
    IDENTIFICATION,
    LOGGER,
    arguments,
)

FLIGHT = {*COMMON, *BRIDGE, *LOGGER, *IDENTIFICATION, 'log'}


def included(package: str, name: str, names: set[str]) -> IncludeLaunchDescription:
    """Hand the arguments of these names on to a launch file."""
    path = Path(get_package_share_directory(package)) / 'launch' / f'{name}.launch.py'
    given = {argument: LaunchConfiguration(argument) for argument in sorted(names)}
    return IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(path)), launch_arguments=given.items()
    )


def generate_launch_description() -> LaunchDescription:
    """Describe flight.launch.py and the excitation node."""
    own = (*BRIDGE, *LOGGER, *IDENTIFICATION, *EXCITATION)
    return LaunchDescription([
        *arguments(*own, log='true'),
        included('quad_tuning', 'flight', FLIGHT),
        included('quad_sysid', 'excitation', {*COMMON, *EXCITATION}),
    ])
