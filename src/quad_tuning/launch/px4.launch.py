"""The whole loop on PX4: `port:=`, `gains:=allow`, `excitation:=allow`; docs/px4.md.

All arguments are those of autopilot.launch.py.
"""

from launch import LaunchDescription

from quad_bridge.nodes.launched import argument, included

DEFAULTS = {'port': 'udp://127.0.0.1:14540', 'schedule': 'schedule_hover'}


def generate_launch_description() -> LaunchDescription:
    """Describe autopilot.launch.py with the port and schedule of PX4."""
    return LaunchDescription([
        *(argument(name, default) for name, default in DEFAULTS.items()),
        included('quad_tuning', 'autopilot', DEFAULTS),
    ])
