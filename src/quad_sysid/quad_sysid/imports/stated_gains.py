"""Gains that a user states, of a table or arrays that cannot hold them. No files."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from typing import Any

from quad_sysid.axes import EVERY
from quad_sysid.errors import BadInputError

D_ON = {'measurement': 0.0, 'error': 1.0}
"""What `<axis>.rate.d_on` may say, as a number."""
GYRO_FILTER = 'sensor.gyro_filter_hz'


def parse_gains(items: Sequence[str]) -> dict[str, str]:
    """Read the `NAME=VALUE` of the command's --gain options."""
    gains: dict[str, str] = {}
    for item in items:
        name, equals, value = item.partition('=')
        if not (equals and name and value):
            raise BadInputError('--gain', 'needs NAME=VALUE', repr(item),
                                'such as roll.rate.kp=0.07')
        if name in gains:
            raise BadInputError('--gain', f'names {name} twice', f'{gains[name]} and {value}')
        gains[name] = value
    return gains


def stated(gains: Mapping[str, Any], axes: Sequence[str], where: str) -> dict[str, float]:
    """The gains that flew on these axes, by the names of /gains/active and in its units (SI).

    `rate.ki` and `rate.kd` that are not stated are 0, filters and limits are none, as of other
    firmware than ours. Raises BadInputError, naming `where` and the gain, for one that is unknown
    or wrong, and for an axis without `rate.kp` or `angle.kp`.
    """
    if not gains:
        return {}
    from quad_sysid.loop.cascade import FOREIGN_NAMES, NOTCH, contract_names

    known = [*(f'{axis}.{name}' for axis in axes for name in (*FOREIGN_NAMES.values(),
                                                               'rate.d_on')),
             *(name for axis in axes for name in contract_names(axis).values()),
             *NOTCH.values(), GYRO_FILTER]
    out: dict[str, float] = {}
    for name, value in gains.items():
        if name not in known:
            near = difflib.get_close_matches(str(name), known, n=1)
            raise BadInputError(where, f'{name} is no gain of {", ".join(axes)}', value,
                                'leave it out, or add its axis to these'
                                if str(name).partition('.')[0] in {*EVERY} - {*axes} else
                                f'did you mean {near[0]}?' if near else
                                f'there are {", ".join(sorted(known))}')
        out[name] = _number(name, value, where)
    for axis in axes:
        if any(name.startswith(f'{axis}.') for name in out):
            out |= _whole(axis, out, where)
    return out


def _whole(axis: str, gains: Mapping[str, float], where: str) -> dict[str, float]:
    """All gains of an axis, of which some are stated."""
    from quad_sysid.loop.cascade import FOREIGN_NAMES, TUNED, CascadeGains, contract_names

    names = contract_names(axis)
    for field, remedy in (('rate_kp', 'state it too'),
                          ('angle_kp', 'state it too; 0 where the stick commands the rate')):
        if names[field] not in gains:
            raise BadInputError(where, f'{names[field]} is missing', remedy=remedy)
    out = {**dict.fromkeys((names[field] for field in TUNED), 0.0),
           f'{axis}.{FOREIGN_NAMES["kff"]}': 0.0,  # by which a firmware is another one than ours
           **gains}
    try:
        CascadeGains.from_mapping(out, axis)
    except BadInputError as error:
        raise BadInputError(where, f'{axis}: {error}') from error
    return out


def _number(name: str, value: Any, where: str) -> float:
    """One gain as a number."""
    d_on = name.endswith('.d_on')
    try:
        number = float(D_ON.get(value, value) if d_on else value)
    except (TypeError, ValueError):
        number = math.nan
    if d_on and number not in D_ON.values():
        must = f'must be {" or ".join(D_ON)}'
    elif not math.isfinite(number):
        must = 'must be a number'
    elif name.endswith('_hz') and number < 0.0:
        must = 'must not be negative'
    else:
        return number
    raise BadInputError(where, f'{name} {must}', repr(value))
