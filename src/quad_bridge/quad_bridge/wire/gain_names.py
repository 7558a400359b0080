"""Names of gains and loop constants: the contract's (topics, files) and the wire's (16 bytes).

Values are SI on both sides (contract, Gains), so there is nothing to convert.
"""

from __future__ import annotations

AXES = ('roll', 'pitch', 'yaw')

_PER_AXIS = {
    'angle.kp': 'ANG_KP',
    'angle.rate_limit': 'ANG_RLIM',
    'rate.kp': 'RATE_KP',
    'rate.ki': 'RATE_KI',
    'rate.kd': 'RATE_KD',
    'rate.d_filter_hz': 'RATE_DFHZ',
    'rate.integrator_limit': 'RATE_ILIM',
    'rate.output_limit': 'RATE_ULIM',
}

_STATE_FEEDBACK = {
    'lqr.share': 'LQR_SHARE',
    'lqr.k_angle': 'LQR_KANG',
    'lqr.k_rate': 'LQR_KRATE',
    'lqr.k_drive': 'LQR_KDRIVE',
    'lqr.k_integral': 'LQR_KINT',
    'lqr.gain': 'LQR_GAIN',
    'lqr.lag_s': 'LQR_LAG',
    'lqr.delay_s': 'LQR_DELAY',
    'lqr.damping': 'LQR_DAMP',
    'lqr.observer': 'LQR_OBS',
}
"""A second control mode that a firmware may have; none of these names, no such mode."""

_SCHEDULE = {'sag.exponent': 'SAG_EXP', 'sag.reference_v': 'SAG_VREF'}
"""Commands times (reference / voltage) to this power; exponent 0: off."""

_SHARED = {
    'sensor.gyro_filter_hz': 'GYRO_FILT_HZ',
    'sensor.accel_filter_hz': 'ACC_FILT_HZ',
    'loop.rate_hz': 'LOOP_RATE_HZ',
}

WIRE_NAMES: dict[str, str] = {
    **{
        f'{axis}.{name}': f'{axis.upper()}_{wire}'
        for axis in AXES
        for name, wire in _PER_AXIS.items()
    },
    **_SHARED,
    **{
        f'{axis}.{name}': f'{axis.upper()}_{wire}'
        for axis in AXES
        for name, wire in {**_STATE_FEEDBACK, **_SCHEDULE}.items()
    },
}
"""Contract name to wire name.

angle.kp 1/s; rate.kp, ki, kd normalised command per rad/s, per rad, per rad/s²;
angle.rate_limit rad/s; rate.output_limit and rate.integrator_limit normalised command; *_hz Hz.
lqr.share 0 (cascade) to 1; lqr.k_* normalised command per rad, rad/s, rad/s², rad s; lqr.gain
rad/s² per command, lag_s and delay_s s, damping 1/s, observer the share of a rate's innovation.
sag.exponent 1, sag.reference_v V.
"""

CONTRACT_NAMES: dict[str, str] = {wire: name for name, wire in WIRE_NAMES.items()}
"""Wire name to contract name."""

READ_ONLY = frozenset({'loop.rate_hz'})
"""Contract names that the STM32 reports and nobody sets."""
