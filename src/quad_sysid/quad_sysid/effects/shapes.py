"""Effects without a name: smooth curves of one signal, as an added torque or on the command.

Knots are laid where the training data lie. A named effect wins over a curve unless the curve
explains clearly more; that is decided in discover.py.
"""

from __future__ import annotations

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.greybox import kernels
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.structure import Effect, ParameterSpec, Settings, Term

KNOTS = 7


def _range_of(data: AxisData, signal: FloatArray) -> Settings | str:
    """Knots from the 1st to the 99th percentile of the signal over the training segments."""
    values = np.concatenate([signal[a:b] for a, b in data.train])
    values = values[np.isfinite(values)]
    if values.size < 100:
        return 'the signal was not measured during training'
    low, high = np.percentile(values, [1.0, 99.0])
    if high - low < 1e-6 * max(1.0, abs(high)):
        return 'the signal does not move during training'
    return {'first': float(low), 'step': float((high - low) / (KNOTS - 1))}


def _basis(settings: Settings) -> FloatArray:
    """(KNOTS, m) knot values that no straight line (or constant) contains: the base has those."""
    x = np.linspace(-1.0, 1.0, KNOTS)
    known = np.stack([np.ones(KNOTS), x][: 2 if settings.get('line') == 'base' else 1], axis=1)
    complete: FloatArray = np.linalg.qr(np.hstack([known, np.vander(x, KNOTS - known.shape[1])]))[0]
    return complete[:, known.shape[1] :]


def _curve_values(p: FloatArray, settings: Settings) -> tuple[float, ...]:
    first, step = settings['first'], settings['step']
    if not (isinstance(first, float) and isinstance(step, float)):
        raise TypeError('a curve needs first and step as numbers')
    return (first, step, float(KNOTS), *(_basis(settings) @ p).tolist())


def _knot_parameters(count: int, unit: str, scale: float) -> tuple[ParameterSpec, ...]:
    return tuple(
        ParameterSpec(f'c{i}', unit, -np.inf, np.inf, (0.0,), scale) for i in range(count)
    )


def _with_line(settings: Settings | str) -> Settings | str:
    """Mark a curve whose straight part the base already has."""
    return settings if isinstance(settings, str) else {**settings, 'line': 'base'}


def _rate_settings(data: AxisData) -> Settings | str:
    return _with_line(_range_of(data, data.rate))


def _rate_torque(_: AxisData, p: FloatArray, settings: Settings) -> Term:
    return Term(kernels.RATE_CURVE, _curve_values(p, settings))


def _angle_settings(data: AxisData) -> Settings | str:
    if data.angle is None:
        return 'the bag holds no orientation'
    return _range_of(data, data.angle)


def _angle_torque(_: AxisData, p: FloatArray, settings: Settings) -> Term:
    return Term(kernels.ANGLE_CURVE, _curve_values(p, settings))


def _command_settings(data: AxisData) -> Settings | str:
    return _with_line(_range_of(data, data.command))


def _command_map(
    _: AxisData, command: FloatArray, p: FloatArray, settings: Settings
) -> FloatArray:
    first, step, _, *y = _curve_values(p, settings)
    knots = first + step * np.arange(KNOTS)
    return command + np.interp(command, knots, np.array(y))


SHAPES: tuple[Effect, ...] = (
    Effect(
        name='shape:rate',
        kind='shape',
        signals=('rate',),
        parameters=_knot_parameters(KNOTS - 2, 'rad/s²', 0.1),
        physics='a torque that is a smooth curve of the rate',
        excite='rates spread evenly over their range: a chirp or a multisine',
        prepare=_rate_settings,
        torque=_rate_torque,
    ),
    Effect(
        name='shape:angle',
        kind='shape',
        signals=('angle',),
        parameters=_knot_parameters(KNOTS - 1, 'rad/s²', 0.1),
        physics='a torque that is a smooth curve of the angle',
        excite='slow large angles: a slow chirp or a square wave of long period',
        prepare=_angle_settings,
        torque=_angle_torque,
    ),
    Effect(
        name='shape:command',
        kind='shape',
        signals=('command',),
        parameters=_knot_parameters(KNOTS - 2, '1', 0.002),
        physics='the command acts through a smooth curve',
        excite='commands spread evenly over their range: a multisine',
        prepare=_command_settings,
        command=_command_map,
    ),
)


def curve_of(
    effect: Effect, p: FloatArray, settings: Settings
) -> tuple[FloatArray, FloatArray]:
    """Knots x and values y of a fitted curve, for plots and for the closed loop.

    A curve of the command is the whole map (the command itself included).
    """
    first, step, _, *y = _curve_values(p, settings)
    x = first + step * np.arange(KNOTS)
    values = np.array(y)
    return x, x + values if effect.command is not None else values
