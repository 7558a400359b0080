"""What is generated from the gains' table: the firmware's C and a page of the documentation.

`python tools/gain_tables.py` writes both, after a change of quad_bridge/gains/table.py; a test
(test/quad_bridge/test_gain_table.py) holds what is committed against the table.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from quad_bridge.gains.table import (
    AXES,
    CLIMB,
    DEFAULT_BOUNDS,
    OF_AIRCRAFT,
    OPTIONAL,
    PER_AXIS,
    ROWS,
    SET_UP,
    SHARED,
    Gain,
)

ROOT = Path(__file__).resolve().parents[1]
HEADER = ROOT / 'firmware/quad_parameter_table.h'
PAGE = ROOT / 'docs/reference/gains.md'


def header() -> str:
    """Names, bounds and start values of the parameters in the order of their index, as C."""
    first, *others = SHARED
    lines = [
        '/* Generated from quad_bridge/gains/table.py by tools/gain_tables.py. SI units. */',
        '#ifndef QUAD_PARAMETER_TABLE_H',
        '#define QUAD_PARAMETER_TABLE_H',
        '',
        '/* Gains of each axis, roll pitch yaw. */',
        'enum {',
        *(f'    {_enumerator(row)}, /* {_comment(row)} */' for row in PER_AXIS),
        '    QUAD_PER_AXIS,',
        f'    {_enumerator(OPTIONAL[0])} = QUAD_PER_AXIS, /* {_comment(OPTIONAL[0])} */',
        *(f'    {_enumerator(row)}, /* {_comment(row)} */' for row in OPTIONAL[1:]),
        '    QUAD_OF_AXIS',
        '};',
        '',
        '/* In a set: first group of each axis, shared, rest of each axis, mixer and notches,',
        ' * height, set-up. */',
        'enum {',
        f'    {_enumerator(first)} = 3 * QUAD_PER_AXIS, /* {_comment(first)} */',
        *(f'    {_enumerator(row)}, /* {_comment(row)} */' for row in others),
        '    QUAD_OPTIONAL,',
        '    QUAD_BEFORE_MIXER = QUAD_OPTIONAL + 3 * (QUAD_OF_AXIS - QUAD_PER_AXIS) - 1,',
        f'    {_enumerator(OF_AIRCRAFT[0])}, /* {_comment(OF_AIRCRAFT[0])} */',
        *(f'    {_enumerator(row)}, /* {_comment(row)} */' for row in (*OF_AIRCRAFT[1:], *CLIMB)),
        '    QUAD_SET_UP, /* from here on: how the aircraft is built */',
        f'    {_enumerator(SET_UP[0])} = QUAD_SET_UP, /* {_comment(SET_UP[0])} */',
        *(f'    {_enumerator(row)}, /* {_comment(row)} */' for row in SET_UP[1:]),
        '    QUAD_PARAMETERS',
        '};',
        '',
        '/* Name, lowest, highest, start; nothing fits where lowest > highest. */',
        '#define QUAD_PARAMETER_TABLE \\',
        *(f'    {_entry(row, axis)}, \\' for axis in range(3) for row in PER_AXIS),
        *(f'    {_entry(row)}, \\' for row in SHARED),
        *(f'    {_entry(row, axis)}, \\' for axis in range(3) for row in OPTIONAL),
        *(f'    {_entry(row)}, \\' for row in (*OF_AIRCRAFT, *CLIMB, *SET_UP)),
        '',
        '#endif',
    ]
    last = max(i for i, line in enumerate(lines) if line.endswith('\\'))
    lines[last] = lines[last].removesuffix(', \\')
    return '\n'.join(lines) + '\n'


def _enumerator(row: Gain) -> str:
    return f'QUAD_{row.name.replace(".", "_").upper()}'


def _comment(row: Gain) -> str:
    unit = '' if row.unit == '1' else f', {row.unit.replace("²", "^2").replace("µ", "u")}'
    return f'{row.meaning}{unit}' + (', read only' if row.limits is None else '')


def _entry(row: Gain, axis: int | None = None) -> str:
    name = row.wire if axis is None else f'{AXES[axis].upper()}_{row.wire}'
    low, high = row.limits or (1.0, 0.0)
    start = row.start[0 if len(row.start) == 1 else axis or 0]
    return f'{{"{name}", {_float(low)}, {_float(high)}, {_float(start)}}}'


def _float(value: float) -> str:
    """The shortest text of the same float32."""
    return f'{np.float32(value)!s}f'


def page() -> str:
    """The documentation's table of all gains."""
    lines = [
        '# Gains',
        '',
        'You look up what each gain means, its unit, and which values are taken. Generated from',
        '`quad_bridge/gains/table.py` by `tools/gain_tables.py`.',
        'Names are those on `/gains/update` and `/gains/active`; a gain of an axis begins with',
        'its name (`roll.rate.kp`, on the wire `ROLL_RATE_KP`). *Limits* are what the firmware',
        'takes. *Bound* is what the [gate](../tune.md) of the bridge lets through unless its',
        'parameter `bounds.<gain>` says otherwise: `[lower, upper, largest factor of one step,',
        'change that is always allowed]`; a gain without one can be changed only where the',
        'configuration bounds it.',
    ]
    for title, rows in (
        ('Each axis: the cascade', PER_AXIS),
        ('The aircraft', SHARED),
        ('Each axis, where a firmware has them (off at 0)', OPTIONAL),
        ('The aircraft, where a firmware has them', OF_AIRCRAFT),
        ('The height mode', CLIMB),
        ('Set-up: by `setup` only, disarmed', SET_UP),
    ):
        lines += ['', f'## {title}', '', '| gain | wire | unit | meaning | limits | bound |',
                  '|---|---|---|---|---|---|']  # fmt: skip
        lines += [_row(row) for row in rows]
    own = [
        f'`{name}` {_bound(bound)}'
        for name, bound in DEFAULT_BOUNDS.items()
        if bound != ROWS[name].bound
    ]
    lines += ['', f'An axis of its own bound: {", ".join(own)}.', '', '## What may go wrong', '']
    lines += [
        '- A set is refused: a gain lies outside its bound, which the answer names.',
        '- Values differ by a factor: in another firmware they have [another unit](../tune.md).',
    ]
    return '\n'.join(lines) + '\n'


def _row(row: Gain) -> str:
    limits = 'read only' if row.limits is None else f'{row.limits[0]:g} to {row.limits[1]:g}'
    bound = '' if row.bound is None else _bound(row.bound)
    return f'| `{row.name}` | `{row.wire}` | {row.unit} | {row.meaning} | {limits} | {bound} |'


def _bound(bound: object) -> str:
    return f'[{", ".join(f"{value:g}" for value in vars(bound).values())}]'


if __name__ == '__main__':
    HEADER.write_text(header(), encoding='ascii')
    PAGE.write_text(page(), encoding='utf-8')
