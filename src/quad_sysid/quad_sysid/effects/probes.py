"""Groups of signals that a residual may depend on, as torques of unit size over the record.

Curves (hat functions over a signal's range), gains that vary with a signal, and memory (the
command behind further lags and modes). Numbers only; judged in scan.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from quad_sysid.contract import FloatArray
from quad_sysid.greybox.data import AxisData

HATS = 6
LAGS_S = (0.01, 0.03, 0.1, 0.3, 1.0)
MODES_HZ = (0.5, 1.0, 2.0, 4.0, 7.0, 12.0, 20.0)
MODE_DAMPING = 0.15


@dataclass(frozen=True)
class Probe:
    """One torque, signal (n,) in rad/s²."""

    signal: FloatArray


def probes_of(
    data: AxisData, theta: FloatArray, rate: FloatArray, angle: FloatArray | None
) -> dict[str, list[Probe]]:
    """All groups by name; `gain:x` are gains that vary with x, the rest torques.

    rate, angle (n,) as the model runs them in the windows: the measured ones hold the very noise
    that the error consists of.
    """
    drive = float(theta[0]) * _lagged(data, float(theta[1]) + float(theta[2]))
    groups: dict[str, list[Probe]] = {}
    for name, signal in _signals(data, rate, angle):
        hats = _hats(data, signal)
        if hats is None:
            continue
        groups[name] = [Probe(hat) for hat in hats]
        groups[f'gain:{name}'] = [Probe(hat * drive) for hat in hats]
    groups['memory'] = [Probe(x) for x in _memories(data, drive)]
    return groups


def _signals(
    data: AxisData, rate: FloatArray, angle: FloatArray | None
) -> Iterator[tuple[str, FloatArray]]:
    yield 'rate', rate
    if angle is not None:
        yield 'angle', angle
    yield 'command', data.command
    yield 'throttle', data.control[:, 0]
    if data.battery_v is not None:
        yield 'voltage', data.battery_v
    for i, name in enumerate(data.other_axes):
        yield f'{name} rate', np.nan_to_num(data.other_rates[:, i])
    for i in range(3):
        if i != data.index:
            yield f'command {("roll", "pitch", "yaw")[i]}', data.control[:, i + 1]
    product: FloatArray = data.other_rates[:, 0] * data.other_rates[:, 1]
    yield 'product of other rates', np.nan_to_num(product)
    yield 'time', np.arange(data.rate.size, dtype=np.float64) * data.dt


def _hats(data: AxisData, signal: FloatArray) -> list[FloatArray] | None:
    """Hat functions over the 1st to 99th percentile of the training segments."""
    used = np.concatenate([signal[a:b] for a, b in data.train])
    low, high = np.percentile(used, [1.0, 99.0])
    if not high - low > 1e-9 * max(abs(low), abs(high), 1e-3):
        return None
    position = np.clip((signal - low) / (high - low), 0.0, 1.0) * (HATS - 1)
    return [np.maximum(0.0, 1.0 - np.abs(position - i)) for i in range(HATS)]


def _lagged(data: AxisData, tau: float) -> FloatArray:
    """The command behind a first-order lag."""
    decay = float(np.exp(-data.dt / max(tau, 0.1 * data.dt)))
    start = np.array([decay * data.command[0]])
    out: FloatArray = lfilter([1.0 - decay], [1.0, -decay], data.command, zi=start)[0]
    return out


def _memories(data: AxisData, drive: FloatArray) -> Iterator[FloatArray]:
    """The drive behind further lags and light modes, and the play that a reversal leaves."""
    for tau in LAGS_S:
        decay = float(np.exp(-data.dt / tau))
        yield lfilter([1.0 - decay], [1.0, -decay], drive)
    for f in MODES_HZ:
        if f * data.dt > 0.2:
            continue
        radius = float(np.exp(-2 * np.pi * f * MODE_DAMPING * data.dt))
        poles = [1.0, -2 * radius * np.cos(2 * np.pi * f * data.dt), radius**2]
        yield lfilter([1.0 - radius, 0.0, -(1.0 - radius)], poles, drive)
        yield lfilter([(1.0 - radius) ** 2], poles, drive)
