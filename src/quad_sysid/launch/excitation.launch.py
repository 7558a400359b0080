"""Launch the excitation node on a schedule: its ~/start service or `autostart:=true` starts it.

`namespace:=left` for one of several aircraft; a `params_file:=` of your own is rooted at
`/left/excitation` then, or at `/**`.
"""

from typing import Any

from launch import LaunchContext, LaunchDescription

from quad_bridge.nodes.launched import EXCITATION, arguments, deferred, node, values


def nodes(context: LaunchContext) -> list[Any]:
    """The excitation node."""
    return [node(context, 'quad_sysid', 'excitation', values(context, EXCITATION))]


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments and the node."""
    return LaunchDescription([*arguments(*EXCITATION), deferred(nodes)])
