"""Starts what flies along: bridge, logger, identification; `port:=`, `folder:=`.

The logger waits for `~/start`. Gains are only proposed, unless `auto_update:=true`. The excitation
is started by hand: `ros2 launch quad_sysid excitation.launch.py schedule:=schedule_hover`.
"""

from typing import Any

from launch import LaunchContext, LaunchDescription

from quad_bridge.nodes.launched import (
    BRIDGE,
    COMMON,
    IDENTIFICATION,
    LOGGER,
    arguments,
    deferred,
    included,
    node,
    values,
)

HANDED_ON = {*COMMON, *BRIDGE, *LOGGER, 'log', 'record'}


def nodes(context: LaunchContext) -> list[Any]:
    """The identification node."""
    return [node(context, 'quad_sysid', 'identification', values(context, IDENTIFICATION))]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments, bridge.launch.py and the identification node."""
    own = arguments(*BRIDGE, *LOGGER, *IDENTIFICATION, log='true', record='false')
    return LaunchDescription([
        *own,
        included('quad_bridge', 'bridge', HANDED_ON),
        deferred(nodes),
    ])
