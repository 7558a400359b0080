"""What the contract fixes: axes, topics, the mixer. Plain tables and array maths, nothing else.

Source: the project's contract of topics, bags and commands (docs/reference/topics.md).
"""

from __future__ import annotations

from quad_sysid.craft import AXES, FloatArray, X

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
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}

MIXER, MIXER_INVERSE = X.mixer, X.inverse
"""(4, 4) each: m1..m4 = MIXER @ (U1..U4) of the X frame, and back; another craft has its own."""
motors_from_wrench, control_from_motors = X.commands, X.control
IDLE = 'mixer.idle'
"""Name in /gains/active of the smallest command of a motor in flight."""

__all__ = [
    'AXES',
    'IDLE',
    'MIXER',
    'MIXER_INVERSE',
    'TOPIC_TYPES',
    'FloatArray',
    'control_from_motors',
    'motors_from_wrench',
]
