"""Checks of a table's columns against each other, for units and signs that cannot be right.

Pure arithmetic on converted columns: errors raise, doubts are returned in words.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.imports.clock import MAX_RATE_HZ
from quad_sysid.imports.units import DEGREE, UNITS, Unit

MIN_RATE_HZ = 20.0
"""Lowest sample rate of flight controllers and rigs."""
USUAL_RATE_HZ = 250.0
"""Of several units of a time, the one whose sample rate is nearest to this is taken."""
MAX_TURN_RAD = 0.5
"""Largest turn between two samples with which they show the motion."""
FASTEST_RAD_S = 70.0
"""4000 deg/s, the widest full scale of gyros that fly."""
FASTEST_M_S = 100.0
"""Faster than anything that hovers."""
WINDOW_S = 0.2
"""Window in which an angle's change is compared with the rate's integral: long against noise and
filter lag, short against drift."""
MIN_WINDOWS = 20
"""Least number of windows, or samples, for a factor."""
TOGETHER = 0.6
"""Least correlation for which a factor between two columns is meaningful."""
NEAR = 0.4
"""Largest difference of a factor's logarithm that counts as near (a factor of 1.5)."""
TOLERATED = 0.2
"""Part by which a factor may be off without a warning."""
ABSURD = 10.0
"""Factor between rate and angle that no filter or drift makes: a unit is wrong."""
CALM, WILD = DEGREE, 1.0
"""Angles, rad, below and above which rate and angle together may be in the wrong unit."""
MIN_TICK = 0.5
"""Least interval of times in ms, us or ns, as it stands: they are whole numbers, or nearly so."""
SLOWEST_HZ = 1.0
"""Rate down to which times without a plausible unit are read as seconds."""
WEIGHT = (4.0, 20.0)
"""m/s². Median of a specific force that is that of a weight."""


@dataclass(frozen=True)
class Column:
    """A column with its unit."""

    source: str
    name: str
    unit: Unit
    named: bool
    """Whether the user named the unit."""
    values: FloatArray
    """(n,) in SI; NaN where a row is missing."""
    degrees: str = 'deg'
    """The unit of degrees of its kind."""

    @property
    def radians(self) -> str:
        """The unit of radians of its kind."""
        return self.degrees.replace('deg', 'rad')

    @property
    def where(self) -> str:
        """Place for a message."""
        return f'{self.source}, column {self.name}'

    def advise(self, unit: str | float) -> str:
        """The option, to be typed, that gives this column another unit."""
        text = unit if isinstance(unit, str) else f'{unit:.6g}'
        return f'--unit {shlex.quote(f"{self.name}={text}")}'


def check_times(time: Column, speed: float | None = None) -> list[str]:
    """Check the sample rate of times (n,) s against usual ones, and against `speed`, rad/s.

    Returns a line on an unusual rate. Raises BadInputError, with a guess, for one that no logger
    reaches, and for a slow one without a given unit, unless `speed` shows a turn of less than half
    a radian between samples.
    """
    if time.values.size < 3:
        return []
    step = float(np.median(np.diff(time.values)))
    rate = 1.0 / step
    if MIN_RATE_HZ <= rate <= MAX_RATE_HZ:
        return []
    measured = f'{rate:.4g} Hz in {time.unit.name}'
    calm = speed is not None and speed * step < MAX_TURN_RAD
    if rate < MIN_RATE_HZ and (time.named or calm):
        return [f'{time.name} gives an unusual sample rate of {measured}']
    guess = time_unit(time.values / time.unit.factor)
    advice = ' (seconds per unit)' if guess is None else \
        f' ({rate * time.unit.factor / UNITS["time"][guess][0]:.4g} Hz)'
    raise BadInputError(
        time.where, 'gives an impossible sample rate', measured,
        f'name its unit, such as {time.advise(guess or "FACTOR")}{advice}'
        + (f', or {time.advise("s")} if it is true' if rate < MIN_RATE_HZ else ''),
    )


def time_unit(values: FloatArray) -> str | None:
    """The unit in which times (n,) give the most usual sample rate; None where no unit does."""
    steps = np.diff(values[np.isfinite(values)])
    step = float(np.median(steps[steps > 0.0]))
    rates = {unit: 1.0 / (factor * step) for unit, (factor, _) in UNITS['time'].items()}
    near = [unit for unit, rate in rates.items() if MIN_RATE_HZ <= rate <= MAX_RATE_HZ
            and (unit == 's' or step >= MIN_TICK)]
    slow = 's' if SLOWEST_HZ <= rates['s'] < MIN_RATE_HZ else None
    return min(near, key=lambda unit: abs(math.log(rates[unit] / USUAL_RATE_HZ)), default=slow)


def check_size(rate: Column) -> None:
    """Raise BadInputError for a rate without a stated unit that no gyro measures in rad/s."""
    _check_largest(rate, rate.values, FASTEST_RAD_S, rate.unit.name, 'deg/s',
                   f'is beyond {FASTEST_RAD_S:g} rad/s, the full scale of a gyro')


def check_speed(column: Column, speed: FloatArray, unit: str) -> None:
    """Raise BadInputError for a column without a stated unit by which nothing is so fast, m/s.

    `unit`: that which it may have.
    """
    _check_largest(column, speed, FASTEST_M_S, 'm/s', unit, f'is faster than {FASTEST_M_S:g} m/s')


def _check_largest(column: Column, values: FloatArray, limit: float, unit: str, likely: str,
                   problem: str) -> None:
    size = float(np.nanquantile(np.abs(values), 0.99)) if values.size else 0.0
    if not column.named and size > limit:
        raise BadInputError(
            column.where, problem, f'{size:.4g} {unit}',
            f'name its unit, such as {column.advise(likely)}, '
            f'or {column.advise(column.unit.name)} if it is true')


def check_rate(rate: Column, angle: Column | None, dt: float) -> list[str]:
    """Compare a rate (n,) rad/s with the angle (n,) rad at intervals of `dt` s.

    Raises BadInputError for a factor near 180/pi, its inverse, or -1. Returns a line on any other
    factor that is more than 20 % off, and where a comparison is not possible.
    """
    size = float(np.nanstd(rate.values))
    alone = (f'the unit of {rate.name} could not be checked: its RMS is {size:.3g} rad/s, '
             f'{size / DEGREE:.3g} deg/s')
    compared = None if angle is None else turn_factor(rate.values, angle.values, dt)
    check_size(rate)
    if angle is None or compared is None:
        return [alone + ('; add --angle' if angle is None else '')]
    together, factor = compared
    if abs(together) < TOGETHER:
        loose = f'(correlation {together:.2f})'
        return [f'{rate.name} and the change of {angle.name} disagree {loose}: {alone}']
    _refuse(rate, angle, factor)
    if not 1.0 / ABSURD < abs(factor) < ABSURD:
        raise _apart(rate, rate, angle, factor, 'name the true unit of one, such as '
                     f'{rate.advise(rate.unit.factor * factor)}')
    if abs(factor - 1.0) > TOLERATED:
        advice = f'if the rate is at fault, {rate.advise(rate.unit.factor * factor)}'
        return [f'{angle.name} changes by {factor:.3g} times what {rate.name} gives: {advice}']
    return []


def check_extent(pairs: Sequence[tuple[Column, Column]]) -> list[str]:
    """A line where rates and angles agree, but move so that both may be in the wrong unit.

    Nothing else tells: the integral of a rate in deg/s is an angle in degrees, whatever both are
    called. `pairs`: rate and angle of roll and pitch.
    """
    sizes = [float(np.nanquantile(np.abs(angle.values - np.nanmedian(angle.values)), 0.99))
             for _, angle in pairs]
    both = [column for pair in pairs for column in pair]
    if pairs and max(sizes) < CALM and all(c.unit.name == c.degrees for c in both):
        extent, other = f'{max(sizes) / DEGREE:.2g} deg only', [c.radians for c in both]
    elif pairs and max(sizes) > WILD and not any(
            c.named or c.unit.name == c.degrees for c in both):
        extent, other = f'{max(sizes):.2g} rad', [c.degrees for c in both]
    else:
        return []
    names = ' and '.join(angle.name for _, angle in pairs)
    advice = ' '.join(c.advise(unit) for c, unit in zip(both, other, strict=True))
    unit = 'radians' if other[0].startswith('rad') else 'degrees'
    return [f'{names} moves by {extent}, and the rate agrees: if both are in {unit}, {advice}']


def turn_factor(rate: FloatArray, angle: FloatArray, dt: float) -> tuple[float, float] | None:
    """Correlation of an angle's changes with the rate's integral, and their ratio with its sign.

    None where there is too little motion.
    """
    integrals, changed = _over_windows(rate, angle, dt)
    if len(integrals) < MIN_WINDOWS or not (np.ptp(integrals) and np.ptp(changed)):
        return None
    together = float(np.corrcoef(integrals, changed)[0, 1])
    return together, math.copysign(float(np.std(changed) / np.std(integrals)), together)


def z_points_down(force: FloatArray) -> bool | None:
    """Whether the specific force along z (n,) m/s² shows a z axis that points down.

    None where it shows no weight: in free fall, of another unit, or without gravity.
    """
    finite = force[np.isfinite(force)]
    usual = float(np.median(finite)) if finite.size else 0.0
    return usual < 0.0 if WEIGHT[0] <= abs(usual) <= WEIGHT[1] else None


def contradicted(rates: FloatArray, angles: FloatArray, dt: float) -> list[str]:
    """A line for each axis whose angles (n, 3) rad contradict the rates (n, 3) rad/s."""
    factors = [turn_factor(rates[:, i], angles[:, i], dt) for i in range(len(AXES))]
    return [
        f'the {axis} angle changes by {both[1]:.3g} times what the rate gives'
        for axis, both in zip(AXES, factors, strict=True)
        if both and abs(both[0]) >= TOGETHER and (both[1] < 0.0 or not _near(both[1], 1.0))
    ]


def check_reference(reference: Column, angle: Column) -> None:
    """Refuse a reference (n,) whose size is that of the angle (n,) times 180/pi or its inverse."""
    is_finite = np.isfinite(reference.values) & np.isfinite(angle.values)
    a, b = reference.values[is_finite], angle.values[is_finite]
    if len(a) < MIN_WINDOWS or not (np.ptp(a) and np.ptp(b)):
        return
    factor = float(np.std(b) / np.std(a))
    if np.corrcoef(a, b)[0, 1] >= TOGETHER:
        _refuse(reference, angle, factor)


def _near(factor: float, *targets: float) -> bool:
    return any(abs(math.log(abs(factor) / value)) < NEAR for value in targets)


def _over_windows(rate: FloatArray, angle: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Integral of the rate and change of the angle over whole windows, (k,) each.

    Windows with missing rows or a jump of the angle (it may wrap) are left out.
    """
    width = max(2, round(WINDOW_S / dt))
    starts = np.arange(0, len(rate) - width, width)
    steps = np.abs(np.diff(angle))
    integrals = np.array([
        dt * (np.sum(rate[i : i + width + 1]) - 0.5 * (rate[i] + rate[i + width])) for i in starts
    ])
    changed = angle[starts + width] - angle[starts]
    jumps = np.array([np.max(steps[i : i + width], initial=0.0) for i in starts])
    is_finite = np.isfinite(integrals) & np.isfinite(changed) & (jumps < 3.0)
    return integrals[is_finite], changed[is_finite]


def _refuse(first: Column, angle: Column, factor: float) -> None:
    """Raise BadInputError where the factor, angle over first, can only be a wrong unit or sign."""
    if factor < 0.0 and _near(factor, 1.0):
        fixes: list[tuple[Column, str | float]] = [(c, -c.unit.factor) for c in (first, angle)]
        remedy = 'one of them turns against forward-left-up'
    elif _near(factor, DEGREE**2, DEGREE**-2):
        large, small = (angle, first) if abs(factor) > 1.0 else (first, angle)
        raise _apart(large, first, angle, factor, 'name both units: '
                     f'{large.advise(large.degrees)} {small.advise(small.radians)}')
    elif _near(factor, DEGREE, 1.0 / DEGREE):
        large, small = (angle, first) if abs(factor) > 1.0 else (first, angle)
        degrees, radians = (large.degrees, small.radians) if factor > 0.0 else (-DEGREE, -1.0)
        fixes = [(large, degrees)] if large.unit.name != large.degrees else []
        fixes += [(small, radians)] if small.unit.name == small.degrees else []
        fixes = fixes or [(first, first.unit.factor * factor)]
        remedy = 'name its unit'
    else:
        return
    blamed = next((column for column, _ in fixes if not column.named), fixes[0][0])
    raise _apart(blamed, first, angle, factor,
                 f'{remedy}: {", or ".join(column.advise(unit) for column, unit in fixes)}')


def _apart(blamed: Column, first: Column, angle: Column, factor: float,
           remedy: str) -> BadInputError:
    return BadInputError(
        blamed.where, f'{angle.name} moves {factor:.3g} times as far as {first.name} says',
        f'{first.name} in {first.unit.name}, {angle.name} in {angle.unit.name}', remedy)
