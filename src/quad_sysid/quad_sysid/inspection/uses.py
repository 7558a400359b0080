"""What data suffice for: each use of a bag, possible or not, and what stands against it.

The conditions are those of the pipeline itself, asked before anything is fitted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from quad_sysid.effects.preparation import coupled_command, needs_angle, sag_settings
from quad_sysid.effects.preparation import thrust_settings as throttle_settings
from quad_sysid.errors import NotInformativeError
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.fit import check_training
from quad_sysid.pipeline.usable import check_usable
from quad_sysid.record import Record

MOVES = 1e-9
"""A signal with less spread than this never moves."""


@dataclass(frozen=True)
class Use:
    """One thing a user may want of a bag."""

    name: str
    possible: bool
    because: str = ''
    """What stands against it; empty where nothing does."""


def uses_of_axis(record: Record, data: AxisData) -> tuple[Use, ...]:
    """What one axis' data allow: identification first, then what hangs on more signals."""
    refused = _refusal(data)
    axis = data.axis
    identify = Use(f'identify {axis}', possible=not refused, because=refused)
    if refused:
        return (identify,)
    reference = _moves(data, data.reference)
    gains = bool(record.gains)
    other = '/setpoint/attitude or /excitation/applied is missing or never moves'
    no_gains = '/gains/active is missing'
    return (
        identify,
        Use('indirect and joint approach', reference, '' if reference else other),
        Use('closed-loop check, gain design', reference and gains,
            '' if reference and gains else other if not reference else no_gains),
        *(_effect(name, ask, data) for name, ask in _EFFECTS),
    )


def uses_of_flight(identifiable: tuple[str, ...], *, moving: bool) -> tuple[Use, ...]:
    """What the flight as a whole allows: by the axes to identify, and whether one moves."""
    both = {'roll', 'pitch'} <= set(identifiable)
    return (
        Use('evaluate a stored model', moving,
            '' if moving else 'no axis holds rate and command that move'),
        Use('one model for roll and pitch', both,
            '' if both else 'it needs both, and this bag does not hold them'),
    )


def _refusal(data: AxisData) -> str:
    try:
        check_usable(data)
        check_training(data, data.train)
    except NotInformativeError as error:
        return str(error).removeprefix(f'{data.axis}: ')
    return ''


def _moves(data: AxisData, signal: np.ndarray | None) -> bool:
    if signal is None:
        return False
    used = np.concatenate([signal[a:b] for a, b in data.train])
    return bool(np.isfinite(used).all() and np.ptp(used) > MOVES)


def _effect(
    name: str, ask: Callable[[AxisData], object], data: AxisData
) -> Use:
    told = ask(data)
    because = told if isinstance(told, str) else ''
    return Use(f'find {name}', possible=not because, because=because)


def _coupling(data: AxisData) -> object:
    first, second = coupled_command(data, 0), coupled_command(data, 1)
    return first if isinstance(first, str) and isinstance(second, str) else {}


_EFFECTS: tuple[tuple[str, Callable[[AxisData], object]], ...] = (
    ('effects of the angle', needs_angle),
    ('battery sag', sag_settings),
    ('thrust curve', throttle_settings),
    ("another axis' command", _coupling),
)
"""Effects that need more of a flight than the axis' own motion."""
