"""Whether an axis' data can be answered at all, before anything is fitted: refusals only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import NotInformativeError
from quad_sysid.model.data import AxisData, Span, at_limit, bridged

LEAST_WINDOWS = 8
"""Of 0.5 s, in which the training must be long enough for any fit."""
AT_LIMIT = 1e-3
"""A motor this near to 0 or 1 is at its limit."""
THROUGHOUT = 0.9
"""Share of the training in which all motors at their limits leave nothing to learn from."""
CLIPPED = 0.1
"""Share that a gyro may spend at its limit: the fit leaves these samples out and would hold to
0.3, but errors are told of them too."""


def check_usable(data: AxisData) -> None:
    """Raise NotInformativeError for segments too short, nothing that moves, or limits."""
    _length(data)
    check_limits(data, data.train, 'the training')
    check_moving(data)


def check_limits(data: AxisData, spans: Sequence[Span], where: str) -> None:
    """Raise NotInformativeError for motors or gyro at their limits over spans, named `where`."""
    _motors(data, spans, where)
    _gyro(data, spans, where)


def _length(data: AxisData) -> None:
    if not data.train or not data.windows(data.validation).count:
        missing = 'training' if not data.train else 'validation'
        raise NotInformativeError(
            f'{data.axis}: no {missing} segment of this axis is long enough (1.5 s); '
            'name them with --train and --validate'
        )


def check_moving(data: AxisData) -> None:
    """Raise NotInformativeError for training too short for a fit, or in which nothing moves."""
    count = data.windows(bridged(data.train, data.dt)).count
    if count < LEAST_WINDOWS:
        raise NotInformativeError(
            f'{data.axis}: training holds {count} windows of 0.5 s, at least {LEAST_WINDOWS} are '
            'needed; fly a longer excitation or widen --train'
        )
    if np.ptp(_inside(data.command, data.train)) < 1e-9:
        raise NotInformativeError(
            f'{data.axis}: the command never moves during training; excite this axis'
        )
    if np.ptp(_inside(data.rate, data.train)) < 1e-9:
        raise NotInformativeError(
            f'{data.axis}: the measured rate is constant during training; '
            'check the gyro and that the axis is free to turn'
        )


def _inside(signal: FloatArray, spans: Sequence[Span]) -> FloatArray:
    return np.concatenate([signal[a:b] for a, b in spans])


def _motors(data: AxisData, spans: Sequence[Span], where: str) -> None:
    """All four at 0 or 1: the commands no longer say what the controller does."""
    motors = _inside(data.motors, spans)
    stuck = np.all((motors <= AT_LIMIT) | (motors >= 1.0 - AT_LIMIT), axis=1)
    if stuck.mean() > THROUGHOUT:
        raise NotInformativeError(
            f'{data.axis}: all motors stand at their limits (0 or 1) during '
            f'{100.0 * stuck.mean():.0f} % of {where}; is it armed? Fly with less excitation '
            'or lower gains'
        )


def _gyro(data: AxisData, spans: Sequence[Span], where: str) -> None:
    """The very same largest rate again and again, which no noisy gyro gives."""
    rate = _inside(data.rate, spans)
    largest = float(np.abs(rate).max())
    clipped = at_limit(rate)
    if clipped.mean() > CLIPPED:
        raise NotInformativeError(
            f'{data.axis}: the measured rate stands at {largest:.3g} rad/s during '
            f'{100.0 * clipped.mean():.0f} % of {where}: the gyro is at its limit; widen its '
            'range or fly more gently'
        )
