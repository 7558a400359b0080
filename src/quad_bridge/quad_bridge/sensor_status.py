"""What the bridge says of the sensors in /diagnostics: biases, and what shakes. Pure sentences."""

from __future__ import annotations

from quad_bridge.sensor_keeper import SensorKeeper
from quad_bridge.sensors.correction import STATUS
from quad_bridge.sensors.rest import FloatArray
from quad_bridge.sensors.vibration import Vibration, strongest
from quad_bridge.status import OK, WARN, Status

STANDS_OUT = 0.3
"""Share of the power from which a line is more than noise."""
FILTER_HZ = 42.0
"""Where the STM32 has not said it."""


def sensors_status(keeper: SensorKeeper) -> Status:
    """Which offsets are subtracted, from which stamp on, and what they were estimated from."""
    values: dict[str, object] = dict(keeper.current.told())
    found = keeper.rest
    if found is not None:
        values |= {
            'gyro drift (rad/s per s)': _three(found.gyro_drift),
            'gyro noise (rad/s RMS)': _three(found.gyro_noise),
            'gravity measured off by (m/s²)': f'{found.acceleration_norm_error:+.4f}',
            'level offset roll, pitch (rad)': f'{found.level[0]:+.5f} {found.level[1]:+.5f}',
            'stood (s)': f'{found.duration_s:.1f}',
        }
    path = keeper.path
    values['kept in'] = 'nowhere: the aircraft is not known' if path is None else path
    if keeper.fault:
        return Status(STATUS, WARN, keeper.fault, values)
    return Status(STATUS, WARN if keeper.warned else OK, keeper.words, values)


def vibration_entries(rate_hz: float, samples: FloatArray, filter_hz: float) -> list[Status]:
    """The strongest lines in rates (rad/s) and accelerations (m/s²), columns of (n, 6)."""
    return [
        vibration_status(name, unit, strongest(part, rate_hz, filter_hz))
        for name, unit, part in (
            ('vibration of the rates', 'rad/s', samples[:, :3]),
            ('vibration of the accelerations', 'm/s²', samples[:, 3:]),
        )
    ]


def vibration_status(name: str, unit: str, found: Vibration | None) -> Status:
    """What the spectrum says; a line that the filter lets through is a warning."""
    if found is None:
        return Status(name, OK, 'not enough of /imu/data yet')
    values = {
        'peak (Hz)': f'{found.frequency_hz:.1f}',
        f'amplitude ({unit})': f'{found.amplitude:.4g}',
        'axis': found.axis,
        'share of what shakes (%)': f'{100 * found.share:.0f}',
        'gain of the filter there': f'{found.filter_gain:.2f}',
    }
    if found.share < STANDS_OUT:
        return Status(name, OK, 'no line stands out', values)
    text = f'{found.frequency_hz:.1f} Hz on {found.axis}, {found.amplitude:.3g} {unit}'
    if found.covered:
        return Status(name, OK, f'{text}; the filter covers it', values)
    return Status(name, WARN, f'{text}; the filter does not cover it', values)


def _three(values: tuple[float, float, float]) -> str:
    return ' '.join(f'{v:+.3g}' for v in values)
