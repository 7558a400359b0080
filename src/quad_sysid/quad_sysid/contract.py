"""What the contract fixes: axes, topics, the mixer. Plain tables and array maths, nothing else.

Source: the project's contract of topics, bags and commands (docs/reference/topics.md).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

AXES = ('roll', 'pitch', 'yaw')

TOPIC_TYPES = {
    '/imu/data': 'sensor_msgs/msg/Imu',
    '/motors/command': 'sensor_msgs/msg/JointState',
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
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}

MIXER: FloatArray = np.array(
    [
        [1.0, 1.0, 1.0, 1.0],
        [1.0, -1.0, 1.0, -1.0],
        [1.0, -1.0, -1.0, 1.0],
        [1.0, 1.0, -1.0, -1.0],
    ]
)
"""(4, 4): motor commands m1..m4 = MIXER @ (U1, U2, U3, U4), normalised."""

MIXER_INVERSE: FloatArray = MIXER.T / 4.0
"""(4, 4): (U1..U4) = MIXER_INVERSE @ (m1..m4); MIXER is orthogonal up to the factor 4."""

MIXER.setflags(write=False)
MIXER_INVERSE.setflags(write=False)


def motors_from_wrench(wrench: FloatArray) -> FloatArray:
    """Motor commands (n, 4) in 0..1 from controller outputs U1..U4 (n, 4)."""
    motors: FloatArray = np.clip(wrench @ MIXER.T, 0.0, 1.0)
    return motors


def control_from_motors(motors: FloatArray) -> FloatArray:
    """The plant's input U1..U4 (n, 4) from motor commands (n, 4), normalised."""
    control: FloatArray = motors @ MIXER_INVERSE.T
    return control
