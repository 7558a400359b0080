"""What an effect needs before it can be fitted: whether the data can show it, and start values."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.ndimage import median_filter

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.fit import Fit
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Effect, Settings

MOVES = 0.02
"""A signal that must move for an effect to show must move by this share of its mean."""
SHARE_OF_COMMAND = 0.05
"""Another axis' command must be this large beside this axis'."""
EVENTS = 3
EVENT_GRID_S = 0.5
EVENT_STEP = 1e-3
FOR_GOOD = 1e6
"""Duration of an event that does not end, s."""
LONGEST_EVENT_S = 10.0
MOST_TIMES = 240
MOST_ERRORS = 40_000
"""So many times, and about so many of the errors, are enough to see an event."""
LINES = 2
LINE_NEIGHBOURS = 41
MIRRORED = 0.02
"""Motors whose mean moves by less than this share of what they move by."""
LINE_BAND_HZ = (0.2, 15.0)
"""Faster lines are vibration of the sensor and not motion of the aircraft."""
LINE_START = 0.05
"""Amplitude to start a line from, rad/s²."""
LEAST_RATE = 0.05
"""Another axis must turn with this RMS, rad/s, beyond the noise of its gyro."""


def over_training(data: AxisData, signal: FloatArray) -> FloatArray:
    """The signal's samples in the training segments."""
    return np.concatenate([signal[a:b] for a, b in data.train])


def needs_angle(data: AxisData) -> Settings | str:
    """Effects on the angle."""
    return {} if data.angle is not None else 'the bag holds no orientation'


def sag_settings(data: AxisData) -> Settings | str:
    """Reference voltage: the mean over training."""
    if data.battery_v is None:
        return 'the bag holds no battery voltage'
    used = over_training(data, data.battery_v)
    if np.ptp(used) < 0.002 * np.mean(used):
        return f'the voltage moves by {np.ptp(used):.3f} V only; fly longer or with more throttle'
    return {'reference_v': float(np.mean(used))}


def thrust_settings(data: AxisData) -> Settings | str:
    """Mean throttle over training."""
    throttle = over_training(data, data.control[:, 0])
    others = [over_training(data, data.control[:, i + 1]) for i in range(3) if i != data.index]
    mean = float(np.mean(throttle))
    product = float(np.std(others[0] * others[1]))
    command = float(np.std(over_training(data, data.command)))
    if np.std(throttle) < MOVES * mean and product < MOVES * command:
        return f'the throttle stays at {mean:.2f}; fly with throttle changes'
    return {'throttle': mean}


def coupled_command(data: AxisData, which: int) -> Settings | str:
    """Column of another axis' command in U1..U4."""
    name = data.other_axes[which]
    column = AXES.index(name) + 1
    own = float(np.std(over_training(data, data.command)))
    if np.std(over_training(data, data.control[:, column])) < SHARE_OF_COMMAND * own:
        return f'the command of {name} hardly moves during training; excite it as well'
    return {'column': float(column)}


def single_motor(data: AxisData, motor: int) -> Settings | str:
    """Index of one motor, where it does more than this axis asks of it."""
    for which in (0, 1):
        if not isinstance(coupled_command(data, which), str):
            return {'motor': float(motor)}
    return 'the other axes hardly move, so no single motor can be told from its like'


def coupled_rate(data: AxisData, which: int) -> Settings | str:
    """Column of another axis' rate."""
    rate = over_training(data, data.other_rates[:, which])
    if not np.isfinite(rate).all():
        return f'the rate of {data.other_axes[which]} was not measured throughout'
    if np.std(rate) < LEAST_RATE:
        return f'{data.other_axes[which]} hardly turns during training'
    return {'column': float(which)}


def both_rates(data: AxisData) -> Settings | str:
    """Both other rates turn."""
    for which in (0, 1):
        found = coupled_rate(data, which)
        if isinstance(found, str):
            return found
    return {}


def limit_starts(sim: Simulator, _: Fit, __: Effect) -> tuple[tuple[float, ...], ...]:
    """Limits of the motors where some of the training commands lie beyond them.

    Where throttle stands still one side rises as the other falls, and an upper limit takes the
    same torque as a lower one: the upper is asked for then, as the one that aircraft have.
    """
    motors = over_training(sim.data, sim.data.motors)
    low, less, more, high = np.percentile(motors, [0.0, 5.0, 95.0, 100.0])
    mirrored = np.std(motors.mean(axis=1)) < MIRRORED * np.std(motors)
    return ((low, more),) if mirrored else ((low, more), (less, high), (less, more))


def line_starts(sim: Simulator, fit: Fit, _: Effect) -> tuple[tuple[float, ...], ...]:
    """Amplitude, frequency and four phases for the strongest lines in the one-step errors.

    These are white where nothing is missing, so a line stands out over its neighbourhood.
    """
    data = sim.data
    start, stop = max(data.train, key=lambda span: span[1] - span[0])
    error = np.nan_to_num(sim.run(fit.structure, fit.theta).innovations[start:stop])
    power = np.abs(np.fft.rfft((error - error.mean()) * np.hanning(error.size))) ** 2
    frequency = np.fft.rfftfreq(error.size, data.dt)
    height = power / np.maximum(median_filter(power, LINE_NEIGHBOURS), 1e-300)
    height[(frequency < LINE_BAND_HZ[0]) | (frequency > LINE_BAND_HZ[1])] = 0.0
    found: list[tuple[float, ...]] = []
    for _number in range(LINES):
        peak = int(np.argmax(height))
        f = float(frequency[peak])
        found += [(LINE_START, f, phase * np.pi / 2.0) for phase in range(4)]
        height[max(peak - 4, 0) : peak + 5] = 0.0
    return tuple(found)


def event_starts(sim: Simulator, fit: Fit, effect: Effect) -> tuple[tuple[float, ...], ...]:
    """The times at which a small change would explain most of the errors, to first order."""
    steps = _Steps(sim, fit, effect, lambda time: (time, EVENT_STEP))
    times = _coarse(sim.data)
    if not times.size:
        return ((_middle(sim.data), 0.0),)
    found = _best_steps(*steps.at(times))
    fine = _around([time for time, _ in found], times)
    return tuple(_best_steps(*steps.at(fine)))


def passing_starts(sim: Simulator, fit: Fit, effect: Effect) -> tuple[tuple[float, ...], ...]:
    """The same for something that begins and ends: the difference of two steps."""
    steps = _Steps(sim, fit, effect, lambda time: (time, FOR_GOOD, EVENT_STEP))
    times = _coarse(sim.data)
    if times.size < 2:
        return ((_middle(sim.data), EVENT_GRID_S, 0.0),)
    start, duration, _ = _best_pulses(*steps.at(times))[0]
    fine = _around([start, start + duration], times)
    return tuple(_best_pulses(*steps.at(fine)))


def _best_steps(
    times: FloatArray, gram: FloatArray, score: FloatArray
) -> list[tuple[float, float]]:
    """(time, size) of what explains most, at most EVENTS of them."""
    strength = np.maximum(np.diag(gram), 1e-300)
    best = np.argsort(-(score**2) / strength)[:EVENTS]
    return [(float(times[i]), float(-score[i] / strength[i])) for i in best]


def _best_pulses(
    times: FloatArray, gram: FloatArray, score: FloatArray
) -> list[tuple[float, float, float]]:
    """(time, duration, size) of what explains most, at most EVENTS of them."""
    i, j = np.triu_indices(times.size, 1)
    short = times[j] - times[i] <= LONGEST_EVENT_S
    i, j = i[short], j[short]
    strength = np.maximum(gram[i, i] + gram[j, j] - 2.0 * gram[i, j], 1e-300)
    push = score[i] - score[j]
    best = np.argsort(-(push**2) / strength)[:EVENTS]
    return [
        (float(times[i[k]]), float(times[j[k]] - times[i[k]]), float(-push[k] / strength[k]))
        for k in best
    ]


def _middle(data: AxisData) -> float:
    start, stop = max(data.train, key=lambda span: span[1] - span[0])
    return 0.5 * (start + stop) * data.dt


def _coarse(data: AxisData) -> FloatArray:
    """Times over the training segments at which something may set in."""
    total = sum(b - a for a, b in data.train) * data.dt
    grid = max(EVENT_GRID_S, total / MOST_TIMES)
    return np.concatenate(
        [np.arange(a * data.dt + 1.0, b * data.dt - 1.0, grid) for a, b in data.train]
    )


def _around(times: Sequence[float], coarse: FloatArray) -> FloatArray:
    """A grid ten times as fine, one coarse step to either side of each time."""
    grid = float(np.diff(coarse).min(initial=EVENT_GRID_S))
    shifts = grid * np.linspace(-1.0, 1.0, 21)
    return np.unique(np.concatenate([time + shifts for time in times]))


class _Steps:
    """Unit steps at given times, less what the parameters that are there already can explain."""

    def __init__(
        self, sim: Simulator, fit: Fit, effect: Effect,
        step_at: Callable[[float], tuple[float, ...]],
    ) -> None:
        self._sim, self._step_at, self._theta = sim, step_at, fit.theta
        self._structure = fit.structure.with_effect(effect, {})
        self._thin = slice(None, None, max(1, fit.errors.size // MOST_ERRORS))
        free = np.flatnonzero(~fit.at_bound)
        known = fit.jacobian.reshape(-1, fit.theta.size)[self._thin, free]
        self._known = np.linalg.qr(known)[0]
        self._errors = fit.errors.ravel()[self._thin]

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The times (m,), the steps' Gram matrix (m, m), their product with the errors (m,)."""
        columns = np.empty((times.size, self._errors.size))
        for row, time in zip(columns, times, strict=True):
            run = self._sim.run(self._structure, np.r_[self._theta, self._step_at(float(time))])
            row[:] = (run.errors.ravel()[self._thin] - self._errors) / EVENT_STEP
        columns[~np.isfinite(columns).all(axis=1)] = 0.0
        columns -= (columns @ self._known) @ self._known.T
        return times, columns @ columns.T, columns @ self._errors
