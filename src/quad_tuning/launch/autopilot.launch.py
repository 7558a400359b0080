"""What flies along with PX4 or ArduPilot: bridge, logger, excitation, identification.

px4.launch.py and ardupilot.launch.py are this with their port and schedule. Neither gains nor an
excitation reach the aircraft unless `gains:=allow` and `excitation:=allow` say so; the excitation
waits for its `~/start`, the logger for its own.
"""

from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
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
    deferred,
    node,
    values,
)

HANDED_ON = {*COMMON, *BRIDGE, *LOGGER, *IDENTIFICATION, 'log', 'record'}


def nodes(context: LaunchContext) -> list[Any]:
    """The excitation node."""
    return [node(context, 'quad_sysid', 'excitation', values(context, EXCITATION))]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments, flight.launch.py and the excitation node."""
    flight = Path(get_package_share_directory('quad_tuning')) / 'launch' / 'flight.launch.py'
    own = arguments(*BRIDGE, *LOGGER, *IDENTIFICATION, *EXCITATION, log='true', record='false')
    given = {name: LaunchConfiguration(name) for name in sorted(HANDED_ON)}
    return LaunchDescription([
        *own,
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(flight)), launch_arguments=given.items()
        ),
        deferred(nodes),
    ])
