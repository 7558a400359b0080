"""Starts the serial bridge and, where asked for, the logger: `port:=`, `log:=true`.

`log:=inside` has the logger write in the bridge's process, at less CPU. `namespace:=left` puts
both, and all their topics, into a namespace: two aircraft on one machine. `params_file:=` sets any
parameter; `ros2 launch quad_bridge bridge.launch.py -s` lists those that are arguments too.
"""

from typing import Any

from launch import LaunchContext, LaunchDescription

from quad_bridge.nodes.launched import BRIDGE, LOGGER, arguments, deferred, node, typed, values


def nodes(context: LaunchContext) -> list[Any]:
    """Bridge and logger, which records at once unless `record:=false`."""
    arguments = context.launch_configurations
    record = typed(arguments['record'], bool)
    bridge, logger = values(context, BRIDGE), values(context, LOGGER) | {'autostart': record}
    if arguments['log'] == 'inside':
        bridge |= {'log': 'inside', **{f'bag_logger.{key}': logger[key] for key in logger}}
    nodes = [node(context, 'quad_bridge', 'serial_bridge', bridge)]
    if arguments['log'] == 'true':
        nodes.append(node(context, 'quad_bridge', 'bag_logger', logger))
    return nodes


def generate_launch_description() -> LaunchDescription:
    """Describe the arguments and both nodes."""
    return LaunchDescription([*arguments(*BRIDGE, *LOGGER, log='false', record='true'),
                              deferred(nodes)])  # fmt: skip
