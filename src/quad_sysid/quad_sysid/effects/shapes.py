"""Effects without a name: smooth curves of one signal, as an added torque or on the command.

Knots are laid where the training data lie. A named effect wins over a curve unless the curve
explains clearly more; that is decided in discover.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects import torques
from quad_sysid.greybox import kernels
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.structure import (
    CommandMap,
    Effect,
    ParameterSpec,
    Prepared,
    Settings,
    Term,
)

KNOTS = 7
SLOW_MOVES = 0.003
"""A slow signal must move by this share to carry a curve."""
RATE_KNOTS = 12
"""An even number: none lies at zero, where friction jumps."""
WARP = 0.15
"""Knots of a rate curve are even in x / (|x| + 0.15 range): friction lives near zero."""


def _range_of(data: AxisData, signal: FloatArray) -> tuple[float, float] | str:
    """1st and 99th percentile of the signal over the training segments."""
    values = np.concatenate([signal[a:b] for a, b in data.train])
    values = values[np.isfinite(values)]
    if values.size < 100:
        return 'the signal was not measured during training'
    low, high = np.percentile(values, [1.0, 99.0])
    if high - low < 1e-6 * max(1.0, abs(high)):
        return 'the signal does not move during training'
    return float(low), float(high)


def _knots(found: tuple[float, float] | str, *, line: bool, share: float = 0.0) -> Settings | str:
    """Settings of a curve over a range; `line`: the base already has its straight part."""
    if isinstance(found, str):
        return found
    low, high = found
    count = KNOTS
    far = max(abs(low), abs(high))
    warp = share * far
    if warp > 0.0:
        low, high, count = -far / (far + warp), far / (far + warp), RATE_KNOTS
    return {
        'first': low, 'step': (high - low) / (count - 1), 'count': float(count),
        'warp': warp, 'line': 'base' if line else 'own',
    }


def _number(settings: Settings, key: str) -> float:
    value = settings[key]
    if not isinstance(value, float):
        raise TypeError(f'setting {key} of a curve must be a number')
    return value


def _x(settings: Settings) -> FloatArray:
    """(count,) where the knots lie, in the signal's unit."""
    steps = np.arange(int(_number(settings, 'count')), dtype=np.float64)
    z = np.asarray(_number(settings, 'first') + _number(settings, 'step') * steps)
    warp = _number(settings, 'warp')
    return z if warp == 0.0 else np.asarray(warp * z / (1.0 - np.abs(z)))


def _basis(settings: Settings) -> FloatArray:
    """(count, m) knot values that no straight line (or constant) contains: the base has those."""
    x = _x(settings)
    known = [np.ones(x.size)]
    if settings['line'] == 'base':
        known.append(x / np.abs(x).max())
    names = settings.get('besides', ())
    if isinstance(names, tuple):
        known += [NAMED_CURVES[name](x) for name in names if name in NAMED_CURVES]
    columns = np.stack([column / np.abs(column).max() for column in known], axis=1)
    complete: FloatArray = np.linalg.qr(columns, mode='complete')[0]
    return complete[:, columns.shape[1] :]


NAMED_CURVES: dict[str, Callable[[FloatArray], FloatArray]] = {
    'coulomb_friction': np.sign,
    'quadratic_drag': lambda x: x * np.abs(x),
    'pendulum_stiffness': np.sin,
    'cubic_stiffness': lambda x: x**3,
}
"""What a curve leaves out where the named effect is there as well."""


def besides(effect: Effect, settings: Settings, names: tuple[str, ...]) -> Prepared:
    """The curve that refines these named effects: without what they can say themselves."""
    kept = tuple(str(name) for name in names if name in NAMED_CURVES)
    refined: Settings = {**settings, 'besides': kept}
    free = _basis(refined).shape[1]
    return replace(effect, parameters=effect.parameters[:free]), refined


def _curve_values(p: FloatArray, settings: Settings) -> tuple[float, ...]:
    """What the compiled curve takes: z0, step, count, warp, then the knots' values."""
    head = [_number(settings, key) for key in ('first', 'step', 'count', 'warp')]
    return (*head, *(_basis(settings) @ p).tolist())


def _knot_parameters(count: int, unit: str, scale: float) -> tuple[ParameterSpec, ...]:
    return tuple(
        ParameterSpec(f'c{i}', unit, -np.inf, np.inf, (0.0,), scale) for i in range(count)
    )


def _smooth(settings: Settings, size: float) -> FloatArray:
    """Rows of a weak prior: second differences of the knots' values are of this size."""
    bend: FloatArray = np.diff(np.eye(_x(settings).size), 2, axis=0) @ _basis(settings)
    return bend / size


def _torque_prior(settings: Settings) -> FloatArray:
    return _smooth(settings, 1.0)


def _command_prior(settings: Settings) -> FloatArray:
    return _smooth(settings, 0.01)


def _rate_settings(data: AxisData) -> Settings | str:
    return _knots(_range_of(data, data.rate), line=True, share=WARP)


def _rate_torque(_: AxisData, p: FloatArray, settings: Settings) -> Term:
    return Term(kernels.RATE_CURVE, _curve_values(p, settings))


def _angle_settings(data: AxisData) -> Settings | str:
    if data.angle is None:
        return 'the bag holds no orientation'
    return _knots(_range_of(data, data.angle), line=False)


def _angle_torque(_: AxisData, p: FloatArray, settings: Settings) -> Term:
    return Term(kernels.ANGLE_CURVE, _curve_values(p, settings))


def _command_settings(data: AxisData) -> Settings | str:
    return _knots(_range_of(data, data.command), line=True)


def _command_map(
    _: AxisData, command: FloatArray, p: FloatArray, settings: Settings, __: FloatArray
) -> FloatArray:
    return command + np.interp(command, _x(settings), _basis(settings) @ p)


def _slow(data: AxisData, name: str) -> FloatArray | None:
    """A slow signal that is known throughout a window: time, voltage or throttle."""
    if name == 'time':
        return np.arange(data.rate.size, dtype=np.float64) * data.dt
    return data.battery_v if name == 'battery' else data.control[:, 0]


def _slow_settings(data: AxisData, name: str, *, gain: bool) -> Settings | str:
    signal = _slow(data, name)
    if signal is None:
        return 'the bag holds no battery voltage'
    found = _range_of(data, signal)
    if not isinstance(found, str) and found[1] - found[0] < SLOW_MOVES * abs(found[1]):
        return f'{name} hardly moves during training'
    settings = _knots(found, line=False)
    return settings if isinstance(settings, str) else {**settings, 'gain': str(gain)}


def _slow_curve(data: AxisData, p: FloatArray, settings: Settings, name: str) -> FloatArray:
    """(n,) the curve along the record, held outside its knots."""
    signal = _slow(data, name)
    if signal is None:
        return np.zeros(data.rate.size)
    out: FloatArray = np.interp(signal, _x(settings), _basis(settings) @ p)
    return out


def _slow_gain(name: str) -> CommandMap:
    def change(
        data: AxisData, command: FloatArray, p: FloatArray, settings: Settings, _: FloatArray
    ) -> FloatArray:
        out: FloatArray = command * (1.0 + _slow_curve(data, p, settings, name))
        return out

    return change


def _slow_torque(data: AxisData, p: FloatArray, settings: Settings) -> Term:
    return Term(kernels.SIGNAL, (1.0,), _slow_curve(data, p, settings, 'time'))


def _gain_prior(settings: Settings) -> FloatArray:
    return _smooth(settings, 0.1)


SHAPES: tuple[Effect, ...] = (
    *(
        Effect(
            name=f'shape:gain:{name}',
            kind='shape',
            signals=('command', name),
            parameters=_knot_parameters(KNOTS - 1, '1', 0.02),
            physics=f'the gain is scaled by 1 + a smooth curve of {name}',
            excite=f'a flight in which {name} moves over its range during the excitation',
            prepare=partial(_slow_settings, name=name, gain=True),
            command=_slow_gain(name),
            prior=_gain_prior,
        )
        for name in ('time', 'battery', 'throttle')
    ),
    Effect(
        name='shape:time',
        kind='shape',
        signals=('time',),
        parameters=_knot_parameters(KNOTS - 1, 'rad/s²', 0.1),
        physics='a torque that drifts slowly over the flight',
        excite='a long flight',
        prepare=partial(_slow_settings, name='time', gain=False),
        torque=_slow_torque,
        prior=_torque_prior,
    ),
    Effect(
        name='mode',
        kind='mode',
        variant='slow state',
        signals=('rate', 'history'),
        parameters=(
            ParameterSpec('stiffness', 'rad/s² per rad', -np.inf, np.inf, (0.0,), 1.0),
            ParameterSpec('time_constant', 's', 0.02, 30.0, (0.2, 1.5), 0.3),
        ),
        physics='a hidden state that follows the angle slowly, as a strap or a fluid does',
        excite='steps with long rests: a square wave of long period',
        torque=torques.slow_state,
    ),
    Effect(
        name='mode',
        kind='mode',
        variant='oscillation',
        signals=('rate', 'history'),
        parameters=(
            ParameterSpec('frequency', 'Hz', 0.1, 20.0, (0.6, 2.0, 6.0), 0.3),
            ParameterSpec('damping_ratio', '1', 0.005, 1.0, (0.2,), 0.1),
            ParameterSpec('in_phase', 'rad/s² per rad/s', -np.inf, np.inf, (0.0,), 0.5),
            ParameterSpec('quadrature', 'rad/s² per rad/s', -np.inf, np.inf, (0.1,), 0.5),
        ),
        physics='something that swings along with the aircraft: a load on a cord, a loose arm',
        excite='a chirp through its frequency',
        torque=torques.swinging,
    ),
    Effect(
        name='shape:rate',
        kind='shape',
        signals=('rate',),
        parameters=_knot_parameters(RATE_KNOTS - 2, 'rad/s²', 0.1),
        physics='a torque that is a smooth curve of the rate',
        excite='rates spread evenly over their range: a chirp or a multisine',
        prepare=_rate_settings,
        torque=_rate_torque,
        prior=_torque_prior,
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
        prior=_torque_prior,
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
        prior=_command_prior,
    ),
)


def curve_of(
    effect: Effect, p: FloatArray, settings: Settings
) -> tuple[FloatArray, FloatArray]:
    """Knots x and values y of a fitted curve, for plots and for the closed loop.

    A curve of the command is the whole map (the command itself included).
    """
    x, values = _x(settings), _basis(settings) @ p
    return x, x + values if effect.name == 'shape:command' else values
