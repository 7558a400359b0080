"""The whole loop on PX4: `port:=`, `gains:=allow`, `excitation:=allow`; docs/px4.md.

All arguments are those of autopilot.launch.py.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument

from quad_bridge.nodes.launched import included

DEFAULTS = {'port': 'udp://127.0.0.1:14540', 'schedule': 'schedule_hover'}


def generate_launch_description() -> LaunchDescription:
    """Describe autopilot.launch.py with the port and schedule of PX4."""
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=value) for name, value in DEFAULTS.items()),
        included('quad_tuning', 'autopilot', DEFAULTS),
    ])
