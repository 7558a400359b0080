"""Checks of a table's columns against each other, for units and signs that cannot be right.

Pure arithmetic on converted columns: errors raise, doubts are returned in words.
"""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.errors import BadInputError
from quad_sysid.imports.units import DEGREE, UNITS, Role, Unit

LOWEST_RATE_HZ, HIGHEST_RATE_HZ = 20.0, 20e3
"""Range of sample rates of flight controllers and rigs."""
USUAL_RATE_HZ = 250.0
MOST_TURN_RAD = 0.5
"""Largest turn between two samples with which they show the motion."""
FASTEST_RAD_S = 70.0
"""4000 deg/s, the widest full scale of gyros that fly."""
WINDOW_S = 0.2
"""Window in which an angle's change is compared with the rate's integral: long against noise and
filter lag, short against drift."""
FEWEST_WINDOWS = 20
TOGETHER = 0.6
"""Least correlation for which a factor between two columns is meaningful."""
NEAR = 0.4
"""Largest difference of a factor's logarithm that counts as near (a factor of 1.5)."""
TOLERATED = 0.2


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

    Returns a line on an unusual rate. Raises BadInputError, with a guess, where no unit was given
    and the axis would turn by more than half a radian between two samples, or `speed` is unknown.
    """
    if time.values.size < 3:
        return []
    step = float(np.median(np.diff(time.values)))
    rate = 1.0 / step
    if LOWEST_RATE_HZ <= rate <= HIGHEST_RATE_HZ:
        return []
    found = f'{rate:.4g} Hz in {time.unit.name}'
    slow = rate < LOWEST_RATE_HZ and speed is not None and speed * step < MOST_TURN_RAD
    if time.named or slow:
        return [f'{time.name} gives an unusual sample rate of {found}']
    guesses = {
        name: time.unit.factor / (factor * step) for name, (factor, _) in UNITS['time'].items()
    }
    likely = sorted(
        (abs(math.log(guess / USUAL_RATE_HZ)), name) for name, guess in guesses.items()
        if name != time.unit.name and LOWEST_RATE_HZ <= guess <= HIGHEST_RATE_HZ
    )
    guess = likely[0][1] if likely else 'FACTOR'
    told = f' ({guesses[guess]:.4g} Hz)' if likely else ' (seconds per unit)'
    raise BadInputError(
        time.where, 'gives an impossible sample rate', found,
        f'name its unit, such as {time.advise(guess)}{told}, or {time.advise("s")} if it is true',
    )


def check_size(rate: Column) -> None:
    """Refuse a rate (n,) without a given unit that exceeds a gyro's full scale in rad/s."""
    size = float(np.nanquantile(np.abs(rate.values), 0.99))
    if not rate.named and size > FASTEST_RAD_S:
        raise BadInputError(
            rate.where, f'is beyond {FASTEST_RAD_S:g} rad/s, the full scale of a gyro',
            f'{size:.4g} {rate.unit.name}',
            f'name its unit, such as {rate.advise("deg/s")}, '
            f'or {rate.advise(rate.unit.name)} if it is true',
        )


def check_rate(rate: Column, angle: Column | None, dt: float) -> list[str]:
    """Compare a rate (n,) rad/s with the angle (n,) rad at intervals of `dt` s.

    Raises BadInputError for a factor near 180/pi, its inverse, or -1. Returns a line on any other
    factor that is more than 20 % off, and where a comparison is not possible.
    """
    size = float(np.nanstd(rate.values))
    alone = (f'the unit of {rate.name} could not be checked: its RMS is {size:.3g} rad/s, '
             f'{size / DEGREE:.3g} deg/s')
    if angle is None:
        check_size(rate)
        return [] if rate.named else [f'{alone}; add --angle']
    compared = turn_factor(rate.values, angle.values, dt)
    if compared is None:
        check_size(rate)
        return [] if rate.named else [alone]
    together, factor = compared
    if abs(together) < TOGETHER:
        loose = f'(correlation {together:.2f})'
        return [f'{rate.name} and the change of {angle.name} disagree {loose}: {alone}']
    _refuse(rate, angle, factor)
    if abs(factor - 1.0) > TOLERATED:
        advice = f'if the rate is at fault, {rate.advise(rate.unit.factor * factor)}'
        return [f'{angle.name} changes by {factor:.3g} times what {rate.name} gives: {advice}']
    return []


def turn_factor(rate: FloatArray, angle: FloatArray, dt: float) -> tuple[float, float] | None:
    """Correlation of an angle's changes with the rate's integral, and their ratio with its sign.

    None where there is too little motion.
    """
    turned, changed = _over_windows(rate, angle, dt)
    if len(turned) < FEWEST_WINDOWS or not (np.ptp(turned) and np.ptp(changed)):
        return None
    together = float(np.corrcoef(turned, changed)[0, 1])
    return together, math.copysign(float(np.std(changed) / np.std(turned)), together)


def contradicted(rates: FloatArray, angles: FloatArray, dt: float) -> list[str]:
    """A line for each axis whose angles (n, 3) rad contradict the rates (n, 3) rad/s."""
    found = [turn_factor(rates[:, i], angles[:, i], dt) for i in range(len(AXES))]
    return [
        f'the {axis} angle changes by {both[1]:.3g} times what the rate gives'
        for axis, both in zip(AXES, found, strict=True)
        if both and abs(both[0]) >= TOGETHER and (both[1] < 0.0 or not _near(both[1], 1.0))
    ]


def check_reference(reference: Column, angle: Column) -> None:
    """Refuse a reference (n,) that differs from the angle (n,) by a factor near 180/pi."""
    known = np.isfinite(reference.values) & np.isfinite(angle.values)
    a, b = reference.values[known], angle.values[known]
    if len(a) < FEWEST_WINDOWS or not (np.ptp(a) and np.ptp(b)):
        return
    factor = float(np.std(b) / np.std(a))
    if np.corrcoef(a, b)[0, 1] < TOGETHER or not _near(factor, DEGREE, 1.0 / DEGREE):
        return
    ways = _other_units((reference, 'angle', 'deg', 'rad'), (angle, 'angle', 'deg', 'rad'), factor)
    blamed = next((column for column, _ in ways if not column.named), ways[0][0])
    raise BadInputError(
        blamed.where, f'{angle.name} moves {factor:.3g} times as far as {reference.name}',
        f'{reference.name} in {reference.unit.name}, {angle.name} in {angle.unit.name}',
        f'name its unit: {", or ".join(column.advise(unit.name) for column, unit in ways)}',
    )


def _near(factor: float, *wanted: float) -> bool:
    return any(abs(math.log(abs(factor) / value)) < NEAR for value in wanted)


def _over_windows(
    rate: FloatArray, angle: FloatArray, dt: float
) -> tuple[FloatArray, FloatArray]:
    """Integral of the rate and change of the angle over whole windows, (k,) each.

    Windows with missing rows or a jump of the angle (it may wrap) are left out.
    """
    width = max(2, round(WINDOW_S / dt))
    starts = np.arange(0, len(rate) - width, width)
    steps = np.abs(np.diff(angle))
    turned = np.array([
        dt * (np.sum(rate[i : i + width + 1]) - 0.5 * (rate[i] + rate[i + width])) for i in starts
    ])
    changed = angle[starts + width] - angle[starts]
    jumps = np.array([np.max(steps[i : i + width], initial=0.0) for i in starts])
    whole = np.isfinite(turned) & np.isfinite(changed) & (jumps < 3.0)
    return turned[whole], changed[whole]


def _refuse(rate: Column, angle: Column, factor: float) -> None:
    """Raise BadInputError where the factor, angle over rate, is a wrong unit or sign."""
    if _near(factor, DEGREE, 1.0 / DEGREE):
        ways = _other_units(
            (rate, 'rate', 'deg/s', 'rad/s'), (angle, 'angle', 'deg', 'rad'), factor
        )
    elif factor < 0.0 and _near(factor, 1.0):
        ways = [(rate, rate.unit), (angle, angle.unit)]
    else:
        return
    blamed = next((column for column, _ in ways if not column.named), ways[0][0])
    advice = ', or '.join(
        column.advise(unit.name if factor > 0.0 else -unit.factor) for column, unit in ways
    )
    raise BadInputError(
        blamed.where,
        f'contradicts {(angle if blamed is rate else rate).name}: {angle.name} changes by '
        f'{factor:.3g} times what {rate.name} gives',
        f'{rate.name} in {rate.unit.name}, {angle.name} in {angle.unit.name}',
        f'name its unit: {advice}' if factor > 0.0 else
        f'one of them turns against forward-left-up: {advice}',
    )


def _other_units(
    below: tuple[Column, Role, str, str], above: tuple[Column, Role, str, str], factor: float
) -> list[tuple[Column, Unit]]:
    """Units that would correct a factor near pi/180 or 180/pi between two columns.

    Each column comes with its role, its unit of degrees and that of radians; `factor` is the size
    of the second over the first.
    """
    small = _near(factor, DEGREE)
    ways = []
    for (column, role, degrees, radians), to_degrees in ((below, small), (above, not small)):
        name = degrees if to_degrees else radians
        if to_degrees or column.unit.name == degrees:
            ways.append((column, Unit(name, *UNITS[role][name])))
    return [way for way in ways if way[0].unit.name != way[1].name] or [
        (below[0], Unit(f'{below[0].unit.factor * factor:.6g}', below[0].unit.factor * factor))
    ]
