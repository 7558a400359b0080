"""Frames of the firmware's second line: settings and sensors to it, motors back. No I/O.

The layouts are those of firmware/quad_hil.h and .c, little endian.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

_HEAD, _CRC = struct.Struct('<BBH'), struct.Struct('<H')
_BOOT = struct.Struct('<QHBBBB6f')
_SENSORS = struct.Struct('<QBB15f')
_MOTORS = struct.Struct('<Q4f3I')
START = 0xA5
MOTORS_BYTES = _HEAD.size + _MOTORS.size + _CRC.size


@dataclass(frozen=True)
class Boot:
    """The settings of a flight; angles in rad."""

    aircraft: int
    rate_hz: int
    armed: bool
    may_arm: bool
    samples: int  # number of samples of gyro and accelerometer in a cycle
    lockstep: bool
    stick_angle: float
    stick_yaw_rate: float
    angle_limit: float
    low_battery_v: float
    complementary_s: float
    declination: float
    gains: Sequence[float]  # all parameters in the order of their index

    def frame(self) -> bytes:
        """The bytes of this message."""
        return _framed(
            b'B',
            _BOOT.pack(
                self.aircraft, self.rate_hz, self.armed, self.may_arm, self.samples,
                self.lockstep, self.stick_angle, self.stick_yaw_rate, self.angle_limit,
                self.low_battery_v, self.complementary_s, self.declination,
            )
            + struct.pack(f'<{len(self.gains)}f', *self.gains),
        )  # fmt: skip


@dataclass(frozen=True)
class Motors:
    """The result of a cycle; times in µs of the board's timer, the worst so far."""

    time_us: int
    commands: tuple[float, float, float, float]
    latest_us: int
    longest_us: int
    overruns: int


def sensors(
    time_us: int, pulses_us: Sequence[float], failsafe: bool, slow: Sequence[float],
    samples: npt.NDArray[np.float64],
) -> bytes:  # fmt: skip
    """The inputs of the cycle at time_us.

    `slow` (6): battery V, compass (3) gauss, pressure hPa, temperature °C; `samples` (n, 6) gyro
    rad/s and accelerometer m/s², in the axes of the chips.
    """
    head = _SENSORS.pack(time_us, failsafe, len(samples), *pulses_us, *slow)
    return _framed(b'S', head + samples.astype('<f4').tobytes())


def motors(frame: bytes) -> Motors:
    """A whole motor frame; raises ValueError for another or a damaged one."""
    if len(frame) != MOTORS_BYTES or frame[:2] != b'\xa5M' or _crc(frame[1:-2]) != frame[-2:]:
        raise ValueError(f'no motor frame: {frame[:8].hex()}')
    time_us, *rest = _MOTORS.unpack_from(frame, _HEAD.size)
    return Motors(time_us, (rest[0], rest[1], rest[2], rest[3]), *rest[4:])


def _framed(kind: bytes, payload: bytes) -> bytes:
    frame = _HEAD.pack(START, kind[0], len(payload)) + payload
    return frame + _crc(frame[1:])


def _crc(data: bytes) -> bytes:
    """CRC-16/CCITT-FALSE."""
    return _CRC.pack(binascii.crc_hqx(data, 0xFFFF))
