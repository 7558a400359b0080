"""What flies along with PX4 or ArduPilot: bridge, logger, excitation, identification.

px4.launch.py and ardupilot.launch.py are this with their port and schedule. Neither gains nor an
excitation reach the aircraft unless `gains:=allow` and `excitation:=allow` say so; the excitation
waits for its `~/start`, the logger for its own.
"""

from typing import Any

from launch import LaunchContext, LaunchDescription

from quad_bridge.nodes.launched import (
    BRIDGE,
    COMMON,
    EXCITATION,
    IDENTIFICATION,
    LOGGER,
    arguments,
    deferred,
    included,
    node,
    values,
)

HANDED_ON = {*COMMON, *BRIDGE, *LOGGER, *IDENTIFICATION, 'log', 'record'}


def nodes(context: LaunchContext) -> list[Any]:
    """The excitation node."""
    return [node(context, 'quad_sysid', 'excitation', values(context, EXCITATION))]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments, flight.launch.py and the excitation node."""
    own = arguments(*BRIDGE, *LOGGER, *IDENTIFICATION, *EXCITATION, log='true', record='false')
    return LaunchDescription([
        *own,
        included('quad_tuning', 'flight', HANDED_ON),
        deferred(nodes),
    ])
