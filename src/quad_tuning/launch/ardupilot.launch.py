"""The whole loop on ArduCopter: `port:=`, `gains:=allow`, `excitation:=allow`; docs/ardupilot.md.

All arguments are those of autopilot.launch.py.
"""

from launch import LaunchDescription

from quad_bridge.nodes.launched import argument, included

DEFAULTS = {'port': 'udp://127.0.0.1:14550', 'schedule': 'schedule_system_id'}


def generate_launch_description() -> LaunchDescription:
    """Describe autopilot.launch.py with the port and schedule of ArduCopter."""
    return LaunchDescription([
        *(argument(name, default) for name, default in DEFAULTS.items()),
        included('quad_tuning', 'autopilot', DEFAULTS),
    ])
