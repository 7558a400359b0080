"""One serialised message of each type, which cdr.encode copies.

Frame and covariances as the contract has them; numbers are placeholders.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from quad_sysid.bags.cdr import BATTERY, IMU, JOINTS, MOTOR_NAMES, blank, typestore

UNMEASURED = ('temperature', 'current', 'charge', 'capacity', 'design_capacity', 'percentage')


@lru_cache(maxsize=8)
def template(msgtype: str, *, measured_orientation: bool = True) -> bytes:
    """CDR of one message. Without measured orientation its covariance[0] is -1 (REP-145)."""
    message = blank(msgtype)
    message.header.frame_id = 'base_link'
    if msgtype == IMU:
        message.orientation.w = 1.0
        message.orientation_covariance[0] = 0.0 if measured_orientation else -1.0
    elif msgtype == JOINTS:
        message.name, message.effort = list(MOTOR_NAMES), np.zeros(4)
    elif msgtype == BATTERY:
        message.present = True
        for name in UNMEASURED:
            setattr(message, name, float('nan'))
    return bytes(typestore().serialize_cdr(message, msgtype))
