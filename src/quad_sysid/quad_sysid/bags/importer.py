"""A foreign CSV recording → a bag of the contract: `import_csv`.

Columns, units, frames and the derivative of an angle; what was done is written into the bag's
metadata and comes back in `Record.warnings`. No identification.
"""

from __future__ import annotations

import gzip
import shlex
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from quad_sysid.bags.csv_table import Table, read_table
from quad_sysid.bags.mixers import Mixer, mixer_of
from quad_sysid.bags.plausible import Column, check_rate, check_reference, check_times
from quad_sysid.bags.stamps import Grid, uniform_grid
from quad_sysid.bags.units import Role, Unit, unit_of
from quad_sysid.bags.writer import BagOptions, write_bag
from quad_sysid.contract import AXES, FloatArray, control_from_motors, motors_from_wrench
from quad_sysid.errors import BadInputError
from quad_sysid.record import GainChange, Record, finite_runs

MIDDLE_COMMAND = 0.5
"""U1 that is written beside a control column: the middle of the motors' range."""
DERIVATIVE_HALF_WIDTH_S = 0.01
DERIVATIVE_ORDER = 3
JITTER_KEPT = 0.1
"""Cycles: up to here samples are taken as they are."""
JITTER_LIMIT = 0.3
"""Cycles: up to here samples are interpolated; beyond, the file is refused."""
ANGLE_LIMIT = {'roll': np.pi, 'pitch': 0.5 * np.pi, 'yaw': np.inf}
BEYOND_LIMIT = 0.1
"""Share of rows beyond an X frame's motors up to which they are left out as gaps."""
EPOCH_S = 1e8
"""Times beyond this count as seconds since 1970; others start at one second."""


@dataclass(frozen=True)
class ImportOptions:
    """What `quad-sysid import` is told: names of columns, their units, where to write."""

    file: Path
    axis: str
    time: str
    out: Path
    control: str | None = None
    motors: tuple[str, ...] = ()
    mixer: str = 'x'
    """`x`, `plus` or a file, see mixers.py."""
    rate: str | None = None
    angle: str | None = None
    reference: str | None = None
    reference_is: str = 'angle'
    """`angle` or `rate`."""
    battery: str | None = None
    units: Mapping[str, str] = field(default_factory=dict)


def parse_units(items: list[str]) -> dict[str, str]:
    """Read the `COL=UNIT` of the command's --unit options."""
    units = {}
    for item in items:
        column, equals, unit = item.rpartition('=')
        if not (equals and column and unit):
            raise BadInputError('--unit', 'needs COLUMN=UNIT', repr(item), 'such as gx=deg/s')
        units[column] = unit
    return units


def import_csv(options: ImportOptions) -> Path:
    """Write the bag and return its path; raises BadInputError naming file, line and column."""
    if options.out.exists():
        raise BadInputError(
            str(options.out), 'exists and is not overwritten', remedy='choose another --out'
        )
    roles = _roles(options)
    units = {name: unit_of(role, options.units.get(name), name) for name, role in roles.items()}
    with _lines(options.file) as lines:
        table = read_table(lines, str(options.file), list(roles))
    seconds = units[options.time](table.columns[options.time])
    odd = check_times(_column(options, units, options.time, seconds))
    grid = _grid(seconds, table, options)
    columns = {
        name: _on_grid(units[name](table.columns[name]), seconds, grid)
        for name in roles if name != options.time
    }
    control, motors, wrench = _input(options, table, units, columns)
    notes = _notes(options, roles, units)
    left_out = int(np.count_nonzero(np.isnan(control[grid.cells, 0])))
    if left_out:
        notes.append(f'{left_out} rows left out that no motors of an X frame can give')
    rate = columns.get(options.rate or '')
    angle = columns.get(options.angle or '')
    odd += _compared(options, units, columns, grid.dt)
    gains: tuple[GainChange, ...] = ()
    if rate is None:
        rate, told = _derivative(columns[options.angle or ''], grid.dt)
        notes.append(f'rate of {options.angle} by {told}')
        gains = (GainChange(0.0, {'sensor.rate_from_angle_s': DERIVATIVE_HALF_WIDTH_S}),)
    if _jitter(seconds, grid) > JITTER_KEPT:
        notes.append(f'interpolated to a uniform grid of {1.0 / grid.dt:.6g} Hz')

    def along(values: FloatArray | None) -> FloatArray | None:
        return None if values is None else _along(options.axis, values, control)

    reference = along(columns.get(options.reference or ''))
    by_angle = options.reference_is == 'angle'
    record = Record(
        source=str(options.file), dt=grid.dt, t0_ns=grid.t0_ns,
        rates=_along(options.axis, rate, control), control=control, motors=motors, wrench=wrench,
        angles=along(angle), attitude_setpoint=reference if by_angle else None,
        rate_setpoint=None if by_angle else reference,
        battery_v=columns.get(options.battery or ''), gains=gains,
    )
    notes_of_bag = {'import': f'{options.file.name}: {"; ".join(notes)}'}
    if odd:
        notes_of_bag['import check'] = '; '.join(odd)
    return write_bag(record, options.out, BagOptions(notes=notes_of_bag))


def _notes(
    options: ImportOptions, roles: Mapping[str, Role], units: Mapping[str, Unit]
) -> list[str]:
    """Tell what each column became."""
    notes = [f'{name} [{units[name].name}] as {role}' for name, role in roles.items()]
    if options.control is not None:
        unit = units[options.control]
        notes.append(
            f'normalised command = {unit.factor:g} * {options.control} + {unit.offset:g}, '
            f'about U1 = {MIDDLE_COMMAND:g}'
        )
    notes.append(f'axes other than {options.axis} were not measured and stand as 0')
    return notes


def _roles(options: ImportOptions) -> dict[str, Role]:
    """Give each named column its role, the time first; raises BadInputError on a contradiction."""
    if options.axis not in AXES:
        raise BadInputError('--axis', 'is no axis', repr(options.axis), f'use {", ".join(AXES)}')
    if (options.control is None) == (not options.motors):
        raise BadInputError(
            'import', 'needs exactly one of --control and --motors',
            remedy='the input of the model comes from one of them',
        )
    if options.motors and len(options.motors) != 4:
        raise BadInputError(
            '--motors', 'needs four columns', ','.join(options.motors), 'separate them by commas'
        )
    if options.rate is None and options.angle is None:
        raise BadInputError('import', 'needs --rate or --angle', remedy='name what was measured')
    if options.reference_is not in ('angle', 'rate'):
        raise BadInputError(
            '--reference-is', 'must be angle or rate', repr(options.reference_is), 'choose one'
        )
    roles: dict[str, Role] = {options.time: 'time'}
    named: list[tuple[str | None, Role]] = [
        (options.control, 'control'), *((name, 'motor') for name in options.motors),
        (options.rate, 'rate'), (options.angle, 'angle'),
        (options.reference, 'angle' if options.reference_is == 'angle' else 'rate'),
        (options.battery, 'battery'),
    ]
    for name, role in named:
        if name in roles:
            raise BadInputError('import', 'one column is named twice', name, 'name each once')
        if name is not None:
            roles[name] = role
    strange = [name for name in options.units if name not in roles]
    if strange:
        raise BadInputError(
            '--unit', 'names a column that is not imported', ', '.join(strange),
            f'imported are {", ".join(roles)}',
        )
    return roles


@contextmanager
def _lines(file: Path) -> Iterator[Iterator[str]]:
    """Lines of a text file, compressed or not."""
    try:
        with file.open('rb') as probe:
            packed = probe.read(2) == b'\x1f\x8b'
        opened = gzip.open if packed else open
        with opened(file, 'rt', encoding='utf-8-sig') as stream:
            yield iter(stream)
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise BadInputError(str(file), f'cannot be read ({reason})', remedy='check it') from error
    except UnicodeDecodeError as error:
        raise BadInputError(
            str(file), 'is no text file', remedy='give a CSV file, plain or gzipped'
        ) from error


def _grid(seconds: FloatArray, table: Table, options: ImportOptions) -> Grid:
    """Lay the times on a grid; raises BadInputError where they are too uneven."""
    since = seconds - seconds[0]
    start = round(float(seconds[0]) * 1e9) if seconds[0] > EPOCH_S else 1_000_000_000
    stamps = start + np.rint(since * 1e9).astype(np.int64)
    grid = uniform_grid(stamps, table.source, options.time)
    if len(grid.cells) < len(stamps):
        raise BadInputError(
            f'{table.source}, column {options.time}', 'sample rate changes or samples crowd',
            f'{len(stamps) - len(grid.cells)} of {len(stamps)} rows off the {1 / grid.dt:.4g} Hz',
            'resample the file to one rate before the import',
        )
    jitter = _jitter(seconds, grid)
    if jitter > JITTER_LIMIT:
        raise BadInputError(
            f'{table.source}, column {options.time}', 'sample rate is too uneven',
            f'jitter of {100 * jitter:.0f} % of a sample',
            f'resample the file (up to {100 * JITTER_LIMIT:.0f} % is interpolated)',
        )
    return grid


def _jitter(seconds: FloatArray, grid: Grid) -> float:
    """Distance of the times from the grid in samples (99 % quantile), slow drift apart."""
    off = (seconds - seconds[0]) / grid.dt - grid.cells
    steps = np.diff(off)
    near = np.diff(grid.cells) == 1
    if not near.any():
        return 0.0
    return float(np.quantile(np.abs(steps[near] - np.median(steps[near])), 0.99) / np.sqrt(2.0))


def _on_grid(values: FloatArray, seconds: FloatArray, grid: Grid) -> FloatArray:
    """(n,) on the grid, NaN where rows are missing; interpolated where the times are uneven."""
    out = np.full(grid.n, np.nan)
    if _jitter(seconds, grid) > JITTER_KEPT:
        start = seconds[0] + np.median(seconds - seconds[0] - grid.cells * grid.dt)
        values = np.interp(start + grid.cells * grid.dt, seconds, values)
    out[grid.cells] = values
    return out


def _input(
    options: ImportOptions, table: Table, units: Mapping[str, Unit],
    columns: Mapping[str, FloatArray],
) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
    """Control (n, 4), and the motors (n, 4) or wrench (n, 4) to be written."""
    if options.control is not None:
        _check_range(table, options.control, units[options.control], -0.5, 0.5)
        values = columns[options.control]
        wrench = np.zeros((len(values), 4))
        wrench[:, 0] = MIDDLE_COMMAND
        wrench[:, 1 + AXES.index(options.axis)] = values
        wrench[np.isnan(values)] = np.nan
        return wrench, None, wrench
    for name in options.motors:
        _check_range(table, name, units[name], 0.0, 1.0)
    mixer: Mixer = mixer_of(options.mixer, options.motors)
    motors = np.column_stack([columns[name] for name in options.motors])
    if mixer.order is not None:
        ordered = motors[:, list(mixer.order)]
        return control_from_motors(ordered), ordered, None
    wrench = motors @ mixer.matrix.T
    limited = control_from_motors(motors_from_wrench(wrench))
    beyond = np.nanmax(np.abs(limited - wrench), axis=1, initial=0.0) > 1e-6
    share = float(np.mean(beyond))
    if share > BEYOND_LIMIT:
        raise BadInputError(
            table.source, f'--mixer {options.mixer} gives more than the motors of an X frame can',
            f'{100 * share:.1f} % of the rows', 'scale the matrix or --unit down',
        )
    wrench[beyond] = np.nan
    return wrench, None, wrench


def _check_range(table: Table, name: str, unit: Unit, low: float, high: float) -> None:
    """Raise BadInputError at the first row that is outside the normalised range."""
    values = unit(table.columns[name])
    tolerance = 1e-6
    outside = np.flatnonzero((values < low - tolerance) | (values > high + tolerance))
    if len(outside):
        raw = table.columns[name]
        scale = np.max(np.abs(raw)) / max(abs(low), abs(high))
        raise table.complain(
            int(outside[0]), name,
            f'in unit {unit.name} is outside {low:g}..{high:g} of a normalised command '
            f'({len(outside)} rows)',
            'name its unit, or a factor such as '
            f'--unit {shlex.quote(f"{name}={1.0 / scale:.2g}")}',
        )


def _check_angle(angle: FloatArray, options: ImportOptions) -> None:
    limit = ANGLE_LIMIT[options.axis]
    largest = float(np.nanmax(np.abs(angle)))
    if largest >= limit:
        raise BadInputError(
            f'{options.file}, column {options.angle}', f'is beyond a {options.axis} angle',
            f'{largest:.4g} of {limit:.4g}',
            f'name its unit, such as --unit {shlex.quote(f"{options.angle}=deg")}',
        )


def _column(
    options: ImportOptions, units: Mapping[str, Unit], name: str, values: FloatArray
) -> Column:
    return Column(str(options.file), name, units[name], name in options.units, values)


def _compared(
    options: ImportOptions, units: Mapping[str, Unit], columns: Mapping[str, FloatArray], dt: float
) -> list[str]:
    """Hold rate, angle and reference against each other; what is odd, in words."""
    rate, angle, reference = (
        _column(options, units, name, columns[name]) if name else None
        for name in (options.rate, options.angle, options.reference)
    )
    if angle is not None:
        _check_angle(angle.values, options)
    odd = [] if rate is None else check_rate(rate, angle, dt)
    if reference is not None and angle is not None and options.reference_is == 'angle':
        check_reference(reference, angle)
    return odd


def _derivative(values: FloatArray, dt: float) -> tuple[FloatArray, str]:
    """Rate (n,) of an angle (n,) without phase shift, and what it was made by.

    Savitzky-Golay (Anal. Chem. 36, 1964): slope of a cubic fitted over 10 ms to either side, at
    least 2 samples; its -3 dB frequency is some (order + 1) / (3.2 m - 4.6) of half the sample
    rate for m samples to either side. Runs too short for it stay NaN.
    """
    from scipy.signal import savgol_filter  # slow to import, and only an angle alone needs it

    half = max(2, round(DERIVATIVE_HALF_WIDTH_S / dt))
    width = 2 * half + 1
    out = np.full(len(values), np.nan)
    for start, stop in finite_runs(np.isfinite(values), (0, len(values))):
        if stop - start >= width:
            out[start:stop] = savgol_filter(
                values[start:stop], width, DERIVATIVE_ORDER, deriv=1, delta=dt, mode='interp'
            )
    return out, f'a zero-phase Savitzky-Golay derivative (cubic over {width} samples)'


def _along(axis: str, values: FloatArray, control: FloatArray) -> FloatArray:
    """(n, 3) with `values` on one axis, 0 on the others, NaN rows where it or the input lacks."""
    out = np.zeros((len(control), 3))
    out[:, AXES.index(axis)] = values
    out[np.isnan(out).any(axis=1)] = np.nan
    return out
