"""The unit that a column is likely to have, by its name and the size of its values."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.imports.plausible import MIN_RATE_HZ, time_unit
from quad_sysid.imports.table import Table
from quad_sysid.imports.units import OPTIONS, UNITS, Role, header_unit, unit_in_name
from quad_sysid.motion import GRAVITY

SMOOTH_TURN = 20.0
"""99 % quantile of a rate, rad/s, above which it is read as deg/s."""
MAX_V = 1000.0
"""A larger battery voltage is read as mV."""
FEW, FAR = 1e-3, 2.0
"""Share of the rows that may be damaged: what reaches so much further than all others is."""


def likely_units(table: Table, option: str, names: Sequence[str]) -> list[str]:
    """The units of an option's columns, where name or size shows one that is not SI; else ''.

    Columns of one sensor share what is known of any of them. SI is named where the name's own unit
    is unknown. An empty name is no column.
    """
    role, names = OPTIONS[option].role, [name for name in names if name]
    units = {None, *UNITS[role]}
    return [unit or ('' if header_unit(name, role) in units else next(iter(UNITS[role])))
            for name, unit in zip(names, _by_size(table, option, names), strict=True)]


def rounded_down(value: float) -> float:
    """Round down to two digits, so that a limit is not exceeded."""
    digit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f'{math.floor(value / digit + 1e-6) * digit:.2g}')


def one_sided(values: FloatArray) -> bool:
    """Whether values never cross zero, as those of a motor, signed by its spin or not."""
    return bool(np.nanmin(values) >= 0.0 or np.nanmax(values) <= 0.0)


def _by_size(  # noqa: C901, PLR0911 - option by option
    table: Table, option: str, names: Sequence[str]
) -> list[str]:
    columns = [table.columns[name] for name in names]
    if option == 'time':
        header = header_unit(names[0])
        unit = header if header in UNITS['time'] else time_unit(columns[0])
        steps = np.diff(columns[0][np.isfinite(columns[0])])
        usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
        if unit == 's' and usual * MIN_RATE_HZ > 1.0:
            return ['s']  # so slow that it is asked for
        return ['' if unit == 's' else unit or '']
    if OPTIONS[option].role in ('rate', 'angle'):
        return _turn_units(names, columns, OPTIONS[option].role)
    low, high = _reach(np.concatenate(columns))
    if option == 'motors' and low < 0.0:
        upper = f'{rounded_down(1.0 / high):g}' if high > 1.0 else ''
        return [upper] * len(names)  # signed by their spin
    if option == 'acceleration':
        size = max(float(np.nanmedian(np.abs(values))) for values in columns)
        named = header_unit(names[0], 'acceleration') in UNITS['acceleration']
        near = next((unit for unit, (factor, _) in UNITS['acceleration'].items()
                     if 0.5 < size * factor / GRAVITY < 2.0), f'{GRAVITY / size:.4g}')
        return ['' if named or near == 'm/s2' else near] * len(names)
    if option == 'battery':
        return ['mV' if float(np.nanmedian(columns[0])) > MAX_V else '']
    # pulses last 900 to 2200 µs, DShot goes to 2047, PWM of 16 bits to 65535; no torque passes 0.5
    if option == 'motors' and 1.0 < high <= 2200.0:
        flying = np.median([np.nanmedian(values) for values in columns])
        unit = 'percent' if high <= 100.0 else 'pulse_us' if flying >= 900.0 else 'dshot'
    elif option == 'control' and high <= 2200.0 and low >= 900.0:
        unit = 'pulse_us'
    elif high > 2000.0:
        unit = 'pwm16'
    elif option == 'control' and not 0.02 < high <= 0.5:
        unit = f'{10.0 ** np.floor(np.log10(0.5 / high)):g}'
    else:
        unit = f'{0.5 / high:.3g}' if option == 'thrust' and high > 1.0 else ''
    return [unit] * len(names)


def _reach(values: FloatArray) -> tuple[float, float]:
    """Least value and largest magnitude of a sensor's columns, but for FEW damaged cells."""
    finite = values[np.isfinite(values)]
    size = np.abs(finite)
    near = size <= FAR * np.quantile(size, 1.0 - FEW, method='lower')
    return float(np.quantile(finite, FEW, method='higher')), float(size[near].max())


def _turn_units(names: Sequence[str], columns: Sequence[np.ndarray], role: Role) -> list[str]:
    """The unit of a sensor's columns where a name or the size of any says so; '' for SI."""
    rate = role == 'rate'
    si, degrees = ('rad/s', 'deg/s') if rate else ('rad', 'deg')

    def named(name: str) -> str | None:
        if header_unit(name, role) in UNITS[role]:
            return header_unit(name, role)
        return unit_in_name(name, role)

    own = [named(name) for name in names]
    named_units = {unit for unit in own if unit}
    largest = max(float(np.nanquantile(np.abs(values), 0.99)) for values in columns)
    large = largest > (SMOOTH_TURN if rate else 2.0 * np.pi)
    common = '' if named_units or not large else degrees
    if len(named_units) == 1:
        common = named_units.pop()
    units = [unit or common for unit in own]
    return ['' if unit == si else unit for unit in units]
