"""Starts what flies along: bridge, logger, identification; `port:=`, `folder:=`.

The logger waits for `~/start`. Gains are only proposed, unless `auto_update:=true`. The excitation
is started by hand: `ros2 launch quad_sysid excitation.launch.py schedule:=schedule_hover`.
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
    IDENTIFICATION,
    LOGGER,
    arguments,
    deferred,
    node,
    values,
)

HANDED_ON = {*COMMON, *BRIDGE, *LOGGER, 'log', 'record'}


def nodes(context: LaunchContext) -> list[Any]:
    """The identification node."""
    return [node(context, 'quad_sysid', 'identification', values(context, IDENTIFICATION))]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments, bridge.launch.py and the identification node."""
    bridge = Path(get_package_share_directory('quad_bridge')) / 'launch' / 'bridge.launch.py'
    own = arguments(*BRIDGE, *LOGGER, *IDENTIFICATION, log='true', record='false')
    given = {name: LaunchConfiguration(name) for name in sorted(HANDED_ON)}
    return LaunchDescription([
        *own,
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(bridge)), launch_arguments=given.items()
        ),
        deferred(nodes),
    ])
