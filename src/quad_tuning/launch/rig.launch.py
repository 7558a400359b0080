"""Starts an aircraft on the one-axis rig: flight.launch.py and the rig's excitation, waiting.

`ros2 service call /bag_logger/start std_srvs/srv/Trigger`, then `/excitation/start`.
"""

from launch import LaunchDescription

from quad_bridge.nodes.launched import (
    BRIDGE,
    COMMON,
    EXCITATION,
    IDENTIFICATION,
    LOGGER,
    arguments,
    included,
)

FLIGHT = {*COMMON, *BRIDGE, *LOGGER, *IDENTIFICATION, 'log'}


def generate_launch_description() -> LaunchDescription:
    """Describe flight.launch.py and the excitation node."""
    own = (*BRIDGE, *LOGGER, *IDENTIFICATION, *EXCITATION)
    return LaunchDescription([
        *arguments(*own, log='true'),
        included('quad_tuning', 'flight', FLIGHT),
        included('quad_sysid', 'excitation', {*COMMON, *EXCITATION}),
    ])
