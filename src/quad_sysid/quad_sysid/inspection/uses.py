"""What data suffice for: each use of a bag, possible or not, and what stands against it.

The conditions are those of the pipeline itself, asked before anything is fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quad_sysid.effects import EFFECTS
from quad_sysid.errors import NotInformativeError
from quad_sysid.model.data import AxisData
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
    gains = f'{axis}.rate.kp' in record.gains_at(np.inf)
    other = '/setpoint/attitude or /excitation/applied is missing or never moves'
    no_gains = '/gains/active is missing'
    return (
        identify,
        Use('indirect and joint approach', reference, '' if reference else other),
        Use('closed-loop check, gain design', reference and gains,
            '' if reference and gains else other if not reference else no_gains),
        *(_effect(told, name, data) for told, name in _EFFECTS),
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
    except NotInformativeError as error:
        return str(error).removeprefix(f'{data.axis}: ')
    return ''


def _moves(data: AxisData, signal: np.ndarray | None) -> bool:
    if signal is None:
        return False
    used = np.concatenate([signal[a:b] for a, b in data.train])
    return bool(np.isfinite(used).all() and np.ptp(used) > MOVES)


def _effect(told: str, name: str, data: AxisData) -> Use:
    """Whether any effect of this name can be tested on the data."""
    answers = [effect.prepare(data) for effect in EFFECTS if effect.name == name]
    refused = [one for one in answers if isinstance(one, str)]
    because = refused[0] if len(refused) == len(answers) else ''
    return Use(f'find {told}', possible=not because, because=because)


_EFFECTS = (
    ('effects of the angle', 'pendulum_stiffness'),
    ('battery sag', 'battery_sag'),
    ('thrust curve', 'thrust_curve'),
    ("another axis' command", 'cross_axis_input'),
)
"""Effects that need more of a flight than the axis' own motion."""
