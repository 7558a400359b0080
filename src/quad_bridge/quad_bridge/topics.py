"""The contract's topics and their types, and which node opens which of them.

config/policies.xml follows from it (tools/policies.py), and a test holds it against the nodes.
quad_sysid has it by a link, so nothing of ours is imported here.
"""

from __future__ import annotations

from dataclasses import dataclass

TOPIC_TYPES = {
    '/imu/data': 'sensor_msgs/msg/Imu',
    '/motors/command': 'sensor_msgs/msg/JointState',
    '/motors/state': 'sensor_msgs/msg/JointState',
    '/control/wrench': 'geometry_msgs/msg/WrenchStamped',
    '/setpoint/attitude': 'geometry_msgs/msg/Vector3Stamped',
    '/setpoint/rates': 'geometry_msgs/msg/Vector3Stamped',
    '/odom': 'nav_msgs/msg/Odometry',
    '/rc/in': 'sensor_msgs/msg/Joy',
    '/battery': 'sensor_msgs/msg/BatteryState',
    '/imu/mag': 'sensor_msgs/msg/MagneticField',
    '/baro': 'sensor_msgs/msg/FluidPressure',
    '/excitation/setpoint': 'geometry_msgs/msg/Vector3Stamped',
    '/excitation/applied': 'geometry_msgs/msg/Vector3Stamped',
    '/excitation/segment': 'rcl_interfaces/msg/ParameterEvent',
    '/gains/update': 'rcl_interfaces/msg/ParameterEvent',
    '/gains/active': 'rcl_interfaces/msg/ParameterEvent',
    '/logger/bag': 'rcl_interfaces/msg/ParameterEvent',
    '/robot_description': 'std_msgs/msg/String',
    '/operator/enable': 'std_msgs/msg/Header',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}

LATCHED = frozenset(
    {'/excitation/segment', '/gains/active', '/logger/bag', '/robot_description'}
)
"""Topics published transient local."""


@dataclass(frozen=True)
class Opens:
    """The topics and services that a node publishes, subscribes to, offers and calls."""

    publishes: tuple[str, ...]
    hears: tuple[str, ...]
    offers: tuple[str, ...] = ()
    calls: tuple[str, ...] = ()
    managed: bool = False
    """Whether it is a lifecycle node."""


AIRCRAFT_LOG = '/aircraft/log'
"""An autopilot's own log as the bridge fetches it (ParameterEvent, latched, not recorded): `path`,
`state` (`expected` while it flies, `fetching`, `complete`, `failed`), `offset_s` from its time to
ROS time."""
SET_GAINS = '/serial_bridge/set_gains'
NODES = {
    'serial_bridge': Opens(
        (
            '/imu/data', '/motors/command', '/motors/state', '/control/wrench',
            '/setpoint/attitude', '/setpoint/rates', '/rc/in', '/battery', '/imu/mag', '/baro',
            '/excitation/applied', '/gains/active', AIRCRAFT_LOG, '/robot_description',
            '/diagnostics',
        ),
        (
            '/excitation/setpoint', '/excitation/segment', '/gains/update', '/operator/enable',
            '/logger/bag', '/robot_description',
        ),
        (
            'arm', 'calibrate_at_rest', 'check_polarity', 'fetch_log', 'find_motors', 'motor_test',
            'set_gains',
        ),
        managed=True,
    ),
    'bag_logger': Opens(
        ('/logger/bag', '/diagnostics'), tuple(TOPIC_TYPES), ('start', 'stop'), managed=True
    ),
    'monitor': Opens(
        (),
        (
            '/diagnostics', '/imu/data', '/battery', '/excitation/applied', '/excitation/segment',
            '/logger/bag',
        ),
    ),
    'excitation': Opens(
        ('/excitation/setpoint', '/excitation/segment', '/diagnostics'),
        ('/imu/data', '/rc/in', '/battery', '/diagnostics', '/excitation/segment'),
        ('start', 'stop'),
    ),
    'identification': Opens(
        ('/diagnostics',), ('/logger/bag', AIRCRAFT_LOG), ('identify',), (SET_GAINS,)
    ),
    'quad_tune': Opens((), (), (), (SET_GAINS,)),
}  # fmt: skip
"""Interfaces by the name of the node."""
STREAMS = frozenset(NODES['serial_bridge'].publishes) - LATCHED - {'/diagnostics'}
"""Topics of what comes from the aircraft, serialised without rclpy."""
