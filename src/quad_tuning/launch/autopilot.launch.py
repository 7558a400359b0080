"""What flies along with PX4 or ArduPilot: bridge, logger, excitation, identification.

px4.launch.py and ardupilot.launch.py are this with their port and schedule. Neither gains nor an
excitation reach the aircraft unless `gains:=allow` and `excitation:=allow` say so; the excitation
waits for its `~/start`, the logger for its own.
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

HANDED_ON = {*COMMON, *BRIDGE, *LOGGER, *IDENTIFICATION, 'log', 'record'}


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments, flight.launch.py and the excitation node."""
    own = arguments(*BRIDGE, *LOGGER, *IDENTIFICATION, *EXCITATION, log='true', record='false')
    return LaunchDescription([
        *own,
        included('quad_tuning', 'flight', HANDED_ON),
        included('quad_sysid', 'excitation', {*COMMON, *EXCITATION}),
    ])
