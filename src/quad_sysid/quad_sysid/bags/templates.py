"""One serialised message of each type: the pattern from which cdr.encode writes many.

Frame and covariances as the contract has them; numbers are placeholders.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from quad_sysid.bags.cdr import BATTERY, IMU, JOINTS, MOTOR_NAMES, VECTOR, WRENCH, typestore

FRAME_ID = 'base_link'


@lru_cache(maxsize=8)
def template(msgtype: str, *, measured_orientation: bool = True) -> bytes:
    """CDR of one message. Without measured orientation its covariance[0] is -1 (REP-145)."""
    types = typestore().types
    stamp = types['builtin_interfaces/msg/Time'](sec=0, nanosec=0)
    header = types['std_msgs/msg/Header'](stamp=stamp, frame_id=FRAME_ID)
    fields = _FIELDS[msgtype](types)
    if msgtype == IMU and not measured_orientation:
        fields['orientation_covariance'][0] = -1.0
    message = types[msgtype](header=header, **fields)
    return bytes(typestore().serialize_cdr(message, msgtype))


def _vector(types: Any) -> Any:
    return types['geometry_msgs/msg/Vector3'](x=0.0, y=0.0, z=0.0)


def _imu(types: Any) -> dict[str, Any]:
    return {
        'orientation': types['geometry_msgs/msg/Quaternion'](x=0.0, y=0.0, z=0.0, w=1.0),
        'orientation_covariance': np.zeros(9),
        'angular_velocity': _vector(types),
        'angular_velocity_covariance': np.zeros(9),
        'linear_acceleration': _vector(types),
        'linear_acceleration_covariance': np.zeros(9),
    }


def _joints(types: Any) -> dict[str, Any]:
    del types
    return {
        'name': list(MOTOR_NAMES), 'position': np.zeros(0), 'velocity': np.zeros(0),
        'effort': np.zeros(4),
    }


def _wrench(types: Any) -> dict[str, Any]:
    wrench = types['geometry_msgs/msg/Wrench'](force=_vector(types), torque=_vector(types))
    return {'wrench': wrench}


def _battery(types: Any) -> dict[str, Any]:
    del types
    unmeasured = ('temperature', 'current', 'charge', 'capacity', 'design_capacity', 'percentage')
    return {
        'voltage': 0.0, **dict.fromkeys(unmeasured, float('nan')),
        'power_supply_status': 0, 'power_supply_health': 0, 'power_supply_technology': 0,
        'present': True, 'cell_voltage': np.zeros(0, dtype=np.float32),
        'cell_temperature': np.zeros(0, dtype=np.float32), 'location': '', 'serial_number': '',
    }


_FIELDS = {
    IMU: _imu,
    JOINTS: _joints,
    WRENCH: _wrench,
    VECTOR: lambda types: {'vector': _vector(types)},
    BATTERY: _battery,
}
