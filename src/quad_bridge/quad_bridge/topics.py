"""The contract's topics and their types: what the logger records and how it must subscribe."""

from __future__ import annotations

TOPIC_TYPES = {
    '/imu/data': 'sensor_msgs/msg/Imu',
    '/motors/command': 'sensor_msgs/msg/JointState',
    '/motors/state': 'sensor_msgs/msg/JointState',
    '/control/wrench': 'geometry_msgs/msg/WrenchStamped',
    '/setpoint/attitude': 'geometry_msgs/msg/Vector3Stamped',
    '/setpoint/rates': 'geometry_msgs/msg/Vector3Stamped',
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
    '/operator/enable': 'std_msgs/msg/Bool',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}

LATCHED = frozenset(
    {'/excitation/segment', '/gains/active', '/logger/bag', '/robot_description'}
)
"""Topics published transient local."""
