"""Every gain and loop constant, one row each: names, bounds, meaning.

Wire names, gate, node parameters and the virtual aircraft read these rows; tools/gain_tables.py
writes the C table and docs/reference/gains.md from them; a test holds both files against the rows.
The design has them by a link (`quad_tuning/gain_table.py`); the module imports neither package.
Values are SI on topics, in files and on the wire, so there is nothing to convert.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

AXES = ('roll', 'pitch', 'yaw')
LARGEST_FACTOR = 2.0  # of one gain in one step; a configuration may ask for less, not for more
IDLE = 'mixer.idle'
US_PER_DEG_S = math.degrees(1.0) / 1000.0
"""The paper's unit, µs of motor pulse per deg/s (of 1000 µs), as command per rad/s."""


@dataclass(frozen=True)
class Bound:
    """Bounds of the gate: hard limits, and the largest step."""

    lower: float
    upper: float
    max_factor: float = LARGEST_FACTOR  # largest ratio of new to active value and of active to new
    small_step: float = 0.0
    """Absolute change that is always allowed, since a gain near zero has no useful ratio."""

    def one_step(self, now: float) -> tuple[float, float]:
        """Lowest and highest value that one step may set, hard limits aside."""
        factor, small = self.max_factor, self.small_step
        return min(now / factor, now - small), max(now * factor, now + small)


@dataclass(frozen=True)
class Gain:
    """One row. Names of an axis' gain follow the axis: `roll.rate.kp`, `ROLL_RATE_KP`."""

    name: str
    wire: str
    unit: str
    meaning: str
    limits: tuple[float, float] | None
    """Lowest and highest value in the firmware; None where it cannot be set."""
    start: tuple[float, ...] = (0.0,)
    """First value in the firmware: for roll, pitch and yaw, or one for all three."""
    bound: Bound | None = None
    """Default bound; None: only with a bound of the configuration."""
    yaw_bound: Bound | None = None
    """Default bound for yaw where it differs: its torque is some ten times weaker."""
    switch: str = ''  # the gain of the same axis that, at 0, leaves this one without effect


PER_AXIS = (
    Gain('angle.kp', 'ANG_KP', '1/s', 'rate reference per angle error', (0.0, 20.0),
         (3.0, 3.0, 2.0), Bound(0.3, 15.0)),
    Gain('angle.rate_limit', 'ANG_RLIM', 'rad/s', 'largest rate reference', (0.1, 20.0), (4.0,)),
    Gain('rate.kp', 'RATE_KP', 's/rad', 'command per rate error', (0.0, 1.0),
         (1.3 * US_PER_DEG_S, 1.3 * US_PER_DEG_S, 3.0 * US_PER_DEG_S), Bound(0.005, 0.5),
         yaw_bound=Bound(0.005, 1.0)),
    # a step of 0.004 at kp 0.07 is an integral corner at 0.06 rad/s: far below any crossover
    Gain('rate.ki', 'RATE_KI', '1/rad', 'command per integral of the rate error', (0.0, 1.0),
         (0.01 * US_PER_DEG_S, 0.01 * US_PER_DEG_S, 0.02 * US_PER_DEG_S),
         Bound(0.0, 1.0, small_step=0.004)),
    Gain('rate.kd', 'RATE_KD', 's²/rad', 'command per change of the measured rate', (0.0, 0.05),
         (0.023 * US_PER_DEG_S, 0.023 * US_PER_DEG_S, 0.0), Bound(0.0, 0.05, small_step=0.0005)),
    Gain('rate.d_filter_hz', 'RATE_DFHZ', 'Hz', 'first-order filter before rate.kd', (1.0, 120.0),
         (30.0,), Bound(5.0, 100.0)),
    Gain('rate.integrator_limit', 'RATE_ILIM', '1', 'largest command of the integral', (0.0, 1.0),
         (0.1,)),
    Gain('rate.output_limit', 'RATE_ULIM', '1', 'largest command of the axis', (0.01, 1.0),
         (0.3,)),
)  # fmt: skip
"""The cascade C1, C2 of each axis."""

SHARED = (
    Gain('sensor.gyro_filter_hz', 'GYRO_FILT_HZ', 'Hz', 'cut-off of the gyro (2nd order)',
         (5.0, 200.0), (42.0,)),
    Gain('sensor.accel_filter_hz', 'ACC_FILT_HZ', 'Hz', 'cut-off of the accelerometer',
         (5.0, 200.0), (42.0,)),
    Gain('loop.rate_hz', 'LOOP_RATE_HZ', 'Hz', 'control cycles per second', None, (250.0,)),
)  # fmt: skip
"""Gains that all axes share."""

OPTIONAL = (
    # 0, a quarter, half, the whole: each with its watch
    Gain('lqr.share', 'LQR_SHARE', '1', 'state feedback 1, cascade 0', (0.0, 1.0),
         bound=Bound(0.0, 1.0, small_step=0.25)),
    Gain('lqr.k_angle', 'LQR_KANG', '1/rad', 'command per angle error', (0.0, 5.0),
         bound=Bound(0.005, 3.0), switch='lqr.share'),
    Gain('lqr.k_rate', 'LQR_KRATE', 's/rad', 'command per rate', (0.0, 1.0),
         bound=Bound(0.005, 0.5), switch='lqr.share'),
    Gain('lqr.k_drive', 'LQR_KDRIVE', 's²/rad', 'command per angular acceleration', (0.0, 0.1),
         bound=Bound(0.0, 0.05, small_step=0.0005), switch='lqr.share'),
    Gain('lqr.k_integral', 'LQR_KINT', '1/(rad s)', 'command per integral of the angle error',
         (0.0, 10.0), bound=Bound(0.0, 5.0, small_step=0.01), switch='lqr.share'),
    Gain('lqr.gain', 'LQR_GAIN', 'rad/s²', "model's angular acceleration per command",
         (0.0, 5000.0), bound=Bound(5.0, 5000.0), switch='lqr.share'),
    Gain('lqr.lag_s', 'LQR_LAG', 's', "model's lag of the motors", (0.0, 0.5),
         bound=Bound(0.001, 0.3), switch='lqr.share'),
    Gain('lqr.delay_s', 'LQR_DELAY', 's', "model's delay", (0.0, 0.06),
         bound=Bound(0.0, 0.06, small_step=0.002), switch='lqr.share'),
    Gain('lqr.damping', 'LQR_DAMP', '1/s', "model's damping of the rate", (-20.0, 50.0),
         bound=Bound(-5.0, 20.0, small_step=2.0), switch='lqr.share'),
    Gain('lqr.observer', 'LQR_OBS', '1', "share of a rate's innovation that is believed",
         (0.0, 1.0), bound=Bound(0.005, 1.0), switch='lqr.share'),
    # a pack moves by some 15 %: a step of the power by a half is one of the command by 7 %
    Gain('sag.exponent', 'SAG_EXP', '1', 'commands times (reference / voltage) to this power',
         (0.0, 3.0), bound=Bound(0.0, 2.5, small_step=0.5)),
    Gain('sag.reference_v', 'SAG_VREF', 'V', 'voltage at which commands stay as they are',
         (0.0, 100.0), bound=Bound(3.0, 60.0), switch='sag.exponent'),
)  # fmt: skip
"""Optional gains of each axis: a state feedback, a schedule on the battery's voltage. Both are off
at 0."""

NOTCH_HZ = Bound(0.0, 400.0, small_step=400.0)
"""A notch is placed at a peak, so no factor of its last frequency bounds it."""

OF_AIRCRAFT = (
    Gain(IDLE, 'MIX_IDLE', '1', 'smallest command of a motor in flight', (0.0, 0.3), (0.05,)),
    Gain('mixer.airmode', 'MIX_AIRMODE', '1',
         'stabilised at zero throttle in the air from 0.5 on', (0.0, 1.0)),
    Gain('sensor.notch_1_hz', 'NOTCH_1_HZ', 'Hz', 'first notch on the gyro, off at 0',
         (0.0, 400.0), bound=NOTCH_HZ),
    Gain('sensor.notch_1_bandwidth_hz', 'NOTCH_1_BW', 'Hz', 'its width at -3 dB', (1.0, 200.0),
         (20.0,), Bound(2.0, 100.0), switch='sensor.notch_1_hz'),
    Gain('sensor.notch_2_hz', 'NOTCH_2_HZ', 'Hz', 'second notch on the gyro, off at 0',
         (0.0, 400.0), bound=NOTCH_HZ),
    Gain('sensor.notch_2_bandwidth_hz', 'NOTCH_2_BW', 'Hz', 'its width at -3 dB', (1.0, 200.0),
         (20.0,), Bound(2.0, 100.0), switch='sensor.notch_2_hz'),
    Gain('rate.d_notch_hz', 'D_NOTCH_HZ', 'Hz', 'notch before rate.kd of all axes, off at 0',
         (0.0, 110.0), bound=Bound(0.0, 110.0, small_step=110.0)),
    Gain('rate.d_notch_bandwidth_hz', 'D_NOTCH_BW', 'Hz', 'its width at -3 dB', (1.0, 100.0),
         (20.0,), Bound(2.0, 100.0), switch='rate.d_notch_hz'),
)  # fmt: skip
"""Optional gains that all axes share. A firmware with the first one gives up yaw before throttle
and throttle before roll and pitch; one without it clips each motor."""

CLIMB = (
    Gain('climb.height.kp', 'CLIMB_HGT_KP', '1/s', 'climb reference per height error', (0.0, 5.0),
         (1.0,), Bound(0.1, 3.0)),
    Gain('climb.height.rate_limit', 'CLIMB_HGT_VLIM', 'm/s', 'largest climb reference',
         (0.1, 5.0), (1.0,)),
    Gain('climb.height.ceiling', 'CLIMB_HGT_CEIL', 'm', 'largest height above the take-off',
         (1.0, 500.0), (30.0,)),
    Gain('climb.rate.kp', 'CLIMB_RATE_KP', 's/m', 'command per error of the climb', (0.0, 1.0),
         (0.1,), Bound(0.005, 0.5)),
    Gain('climb.rate.ki', 'CLIMB_RATE_KI', '1/m', 'command per integral of that error',
         (0.0, 1.0), (0.05,), Bound(0.0, 0.5, small_step=0.01)),
    Gain('climb.rate.kd', 'CLIMB_RATE_KD', 's²/m', 'command per measured vertical acceleration',
         (0.0, 0.2), (0.01,), Bound(0.0, 0.1, small_step=0.005)),
    Gain('climb.rate.integrator_limit', 'CLIMB_RATE_ILIM', '1', 'largest command of the integral',
         (0.0, 0.5), (0.2,)),
    Gain('climb.rate.output_limit', 'CLIMB_RATE_ULIM', '1', 'largest command beside the trim',
         (0.01, 0.6), (0.3,)),
    Gain('climb.hover', 'CLIMB_HOVER', '1', 'throttle that carries the aircraft, at take-off',
         (0.1, 0.8), (0.35,)),
    Gain('climb.filter_s', 'CLIMB_FILTER_S', 's', "time constant of the barometer's correction",
         (0.3, 10.0), (2.0,)),
)  # fmt: skip
"""The height mode, where a firmware has one: C1 from height to climb, C2 from climb to U1."""

STICKS = ('roll', 'pitch', 'throttle', 'yaw')
PULSE_US = (800.0, 2200.0)
"""Valid pulses of a receiver, or for a speed controller."""


def _channel(name: str, wire: str, number: int, *, needed: bool) -> Gain:
    none = '' if needed else ', 0: none'
    words = f"the receiver's channel for it{none}"
    return Gain(f'receiver.{name}_channel', f'RC_{wire}_CH', '1', words,
                (float(needed), 9.0), (float(number),))  # fmt: skip


def _ends(stick: str) -> tuple[Gain, ...]:
    """A stick's pulses; the throttle has no middle."""
    names = [('min', 1000.0), ('centre', 1500.0), ('max', 2000.0)]
    if stick == 'throttle':
        names.pop(1)
    return tuple(
        Gain(f'receiver.{stick}_{end}_us', f'RC_{stick[:5].upper()}_{end[:3].upper()}', 'µs',
             'its pulse ' + ('in the middle' if end == 'centre' else f'at {end[:3]}imum'),
             PULSE_US, (start,))
        for end, start in names
    )  # fmt: skip


def _three(name: str, wire: str, unit: str, meaning: str, limits: tuple[float, float],
           start: float = 0.0) -> tuple[Gain, ...]:  # fmt: skip
    return tuple(
        Gain(f'{name}_{axis}', f'{wire}_{axis.upper()}', unit, meaning, limits, (start,))
        for axis in 'xyz'
    )


SET_UP = (
    _channel('roll', 'ROLL', 1, needed=True),
    _channel('pitch', 'PITCH', 2, needed=True),
    _channel('throttle', 'THROT', 3, needed=True),
    _channel('yaw', 'YAW', 4, needed=True),
    _channel('kill', 'KILL', 5, needed=True),
    _channel('arm', 'ARM', 6, needed=False),
    _channel('hold', 'HOLD', 0, needed=False),
    *(row for stick in STICKS for row in _ends(stick)),
    Gain('receiver.deadband_us', 'RC_DEADBAND', 'µs', 'around the middle, without effect',
         (0.0, 100.0)),
    *(Gain(f'motors.output_{k}', f'MOT_OUTPUT_{k}', '1', 'the output that drives this motor',
           (1.0, 4.0), (float(k),)) for k in range(1, 5)),
    Gain('motors.pulse_min_us', 'MOT_PULSE_MIN', 'µs', 'pulse of a motor that stands', PULSE_US,
         (1000.0,)),
    Gain('motors.pulse_max_us', 'MOT_PULSE_MAX', 'µs', 'pulse of full throttle', PULSE_US,
         (2000.0,)),
    *(Gain(f'board.{axis}', f'BOARD_{axis.upper()}', 'rad',
           'how the board is turned in the body, yaw first', (-3.1416, 3.1416)) for axis in AXES),
    *_three('accel.offset', 'ACC_OFF', 'm/s²', 'reading at zero acceleration, axis of the board',
            (-5.0, 5.0)),
    *_three('accel.scale', 'ACC_SCALE', '1', 'factor after the offset', (0.8, 1.2), 1.0),
    *_three('compass.offset', 'MAG_OFF', 'gauss', 'reading in zero field, axis of the board',
            (-5.0, 5.0)),
    Gain('battery.divider', 'BAT_DIVIDER', '1', 'pack voltage over that at the pin', (1.0, 40.0),
         (11.0,)),
)  # fmt: skip
"""Optional values of the aircraft's construction: `setup` asks for them. They have no bound, so no
update of gains changes them, and the firmware accepts none while it is armed."""


def _all() -> dict[str, tuple[str, Gain]]:
    """Contract name to wire name and row, in the order of the index on the wire."""
    rows = {}
    groups = (*OF_AIRCRAFT, *CLIMB, *SET_UP)
    for gains, axes in ((PER_AXIS, AXES), (SHARED, ('',)), (OPTIONAL, AXES), (groups, ('',))):
        for axis in axes:
            for row in gains:
                name = f'{axis}.{row.name}' if axis else row.name
                rows[name] = (f'{axis.upper()}_{row.wire}' if axis else row.wire, row)
    return rows


ROWS: dict[str, Gain] = {name: row for name, (_, row) in _all().items()}
"""Contract name to its row."""
WIRE_NAMES: dict[str, str] = {name: wire for name, (wire, _) in _all().items()}
CONTRACT_NAMES: dict[str, str] = {wire: name for name, wire in WIRE_NAMES.items()}
SETTABLE = tuple(name for name, row in ROWS.items() if row.limits is not None)
"""Contract names of what can be set at all."""
DEFAULT_BOUNDS: dict[str, Bound] = {
    name: row.yaw_bound if row.yaw_bound is not None and name.startswith('yaw.') else row.bound
    for name, row in ROWS.items()
    if row.bound is not None
}
"""Default bounds, for gains that the configuration does not list."""


def split(name: str) -> tuple[str, str]:
    """Axis ('' for a gain of the whole aircraft) and the name after it."""
    axis, _, rest = name.partition('.')
    return (axis, rest) if axis in AXES else ('', name)


def switch_of(name: str) -> str:
    """Contract name of the gain that switches this one off at 0; '' where there is none."""
    axis, _ = split(name)
    switch = ROWS[name].switch
    return f'{axis}.{switch}' if axis and switch else switch


def with_mixing(active: Mapping[str, float]) -> dict[str, float | str]:
    """The active gains with what the aircraft does with commands that its motors cannot give.

    A firmware with `mixer.idle` fits them to the motors; an older one clips each by itself.
    """
    return {**active, 'mixer.desaturation': 'yaw_first' if IDLE in active else 'clip'}
