"""Effects without a name: curves of one signal, hidden states, something that passes in time.

A curve is an added torque, a friction against the rate, or a change of the gain. A named effect
goes before a curve that explains no more; that is decided in choice.py. How a curve is laid out
stands in curves.py.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects import commands, preparation, torques
from quad_sysid.effects.curves import (
    BROAD_KNOTS,
    FINE_KNOTS,
    KNOTS,
    NAMED_CURVES,
    RATE_KNOTS,
    basis,
    curve_values,
    knot_parameters,
    knot_positions,
    knots,
    range_of,
    smooth,
)
from quad_sysid.greybox import kernels
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.structure import CommandMap, Effect, ParameterSpec, Settings, Term

SLOW_MOVES = 0.003
"""A slow signal must move by this share to carry a curve."""
WARP = 0.15
"""Knots of a rate curve are even in x / (|x| + 0.15 range): friction lives near zero."""
_INF = float('inf')


def _bent(settings: Settings, size: float) -> FloatArray:
    """A weak prior: second differences of the knots' values are of this size."""
    return smooth(settings, size)


_torque_prior = partial(_bent, size=1.0)
_command_prior = partial(_bent, size=0.01)
_gain_prior = partial(_bent, size=0.1)


def _signal(data: AxisData, name: str) -> FloatArray | None:
    """A signal that a curve can follow; None where it was not measured."""
    if name == 'time':
        return np.arange(data.rate.size, dtype=np.float64) * data.dt
    return {
        'rate': data.rate, 'angle': data.angle, 'command': data.command,
        'battery': data.battery_v, 'throttle': data.control[:, 0],
    }[name]


MISSING = {
    'angle': 'the bag holds no orientation', 'battery': 'the bag holds no battery voltage',
}


def _laid(
    data: AxisData, name: str, *, known: str, share: float = 0.0, count: int = KNOTS,
    slow: bool = False,
) -> Settings | str:
    """Knots over the signal's range, or why there are none."""
    signal = _signal(data, name)
    if signal is None:
        return MISSING[name]
    found = range_of(data, signal)
    if slow and not isinstance(found, str) and found[1] - found[0] < SLOW_MOVES * abs(found[1]):
        return f'{name} hardly moves during training'
    return knots(found, known=known, share=share, count=count)


def _torque_curve(code: int, _: AxisData, p: FloatArray, settings: Settings) -> Term:
    return Term(code, curve_values(p, settings))


def _friction_by_angle(_: AxisData, p: FloatArray, settings: Settings) -> Term:
    values = curve_values(p, settings)
    return Term(kernels.FRICTION_BY_ANGLE, (*values, torques.STICTION_RATE))


def _damping_by_time(data: AxisData, p: FloatArray, settings: Settings) -> Term:
    return Term(kernels.RATE_TIMES, (1.0,), _along(data, p, settings, 'time'))


def _friction_by_time(data: AxisData, p: FloatArray, settings: Settings) -> Term:
    level = _along(data, p, settings, 'time')
    width = max(torques.STICTION_RATE, float(np.abs(level).max()) * data.dt)
    return Term(kernels.FRICTION_SIGNAL, (width,), level)


def _command_map(
    _: AxisData, command: FloatArray, p: FloatArray, settings: Settings, __: FloatArray
) -> FloatArray:
    return command + np.interp(command, knot_positions(settings), basis(settings) @ p)


def _thrust_map(
    data: AxisData, command: FloatArray, p: FloatArray, settings: Settings, base: FloatArray
) -> FloatArray:
    curve = knot_positions(settings), basis(settings) @ p
    return commands.behind_lag(data, command, float(base[1]), *curve)


def _along(data: AxisData, p: FloatArray, settings: Settings, name: str) -> FloatArray:
    """(n,) the curve along the record, held outside its knots."""
    signal = _signal(data, name)
    if signal is None:
        return np.zeros(data.rate.size)
    out: FloatArray = np.interp(signal, knot_positions(settings), basis(settings) @ p)
    return out


def _gain_along(name: str) -> CommandMap:
    def change(
        data: AxisData, command: FloatArray, p: FloatArray, settings: Settings, _: FloatArray
    ) -> FloatArray:
        out: FloatArray = command * (1.0 + _along(data, p, settings, name))
        return out

    return change


def _drift(data: AxisData, p: FloatArray, settings: Settings) -> Term:
    return Term(kernels.SIGNAL, (1.0,), _along(data, p, settings, 'time'))


def _gain_in_between(
    data: AxisData, command: FloatArray, p: FloatArray, _: Settings, __: FloatArray
) -> FloatArray:
    during = torques.after(data, float(p[0])) - torques.after(data, float(p[0] + p[1]))
    out: FloatArray = command * (1.0 + p[2] * during)
    return out


_PASSING = (
    ParameterSpec('time', 's', 0.0, _INF, (0.0,), 0.5),
    ParameterSpec('duration', 's', 0.05, 60.0, (1.0,), 0.5),
)

SHAPES: tuple[Effect, ...] = (
    *(
        Effect(
            name=f'shape:gain:{name}',
            kind='shape',
            signals=('command', name),
            parameters=knot_parameters(KNOTS - 1, '1', 0.02),
            physics=f'the gain is scaled by 1 + a smooth curve of {name}',
            excite=f'a flight in which {name} moves over its range during the excitation',
            prepare=partial(_laid, name=name, known='own', slow=True),
            command=_gain_along(name),
            prior=_gain_prior,
        )
        for name in ('time', 'battery', 'throttle')
    ),
    *(
        Effect(
            name=f'shape:gain:{name}',
            kind='shape',
            signals=('command', name),
            parameters=knot_parameters(KNOTS - 1, '1', 0.02),
            physics=f'what the motors turn is scaled by 1 + a smooth curve of the {name}',
            excite=f'large commands at every {name}: a multisine, a chirp',
            prepare=partial(_laid, name=name, known='own'),
            torque=partial(_torque_curve, code),
            prior=_gain_prior,
        )
        for name, code in (
            ('rate', kernels.DRIVE_BY_RATE), ('angle', kernels.DRIVE_BY_ANGLE)
        )
    ),
    Effect(
        name='shape:time',
        kind='shape',
        signals=('time',),
        parameters=knot_parameters(KNOTS - 1, 'rad/s²', 0.1),
        physics='a torque that drifts slowly over the flight',
        excite='a long flight',
        prepare=partial(_laid, name='time', known='own'),
        torque=_drift,
        prior=_torque_prior,
    ),
    Effect(
        name='shape:time',
        kind='shape',
        variant='friction',
        signals=('rate', 'time'),
        parameters=knot_parameters(KNOTS, 'rad/s²', 0.1),
        physics='a friction against the rate that drifts over the flight',
        excite='a long flight with many reversals',
        prepare=partial(_laid, name='time', known='free'),
        torque=_friction_by_time,
        prior=_torque_prior,
    ),
    Effect(
        name='shape:time',
        kind='shape',
        variant='damping',
        signals=('rate', 'time'),
        parameters=knot_parameters(KNOTS - 1, '1/s', 0.1),
        physics='a viscous damping that drifts over the flight: grease that warms up',
        excite='a long flight with large rates',
        prepare=partial(_laid, name='time', known='own'),
        torque=_damping_by_time,
        prior=_torque_prior,
    ),
    Effect(
        name='mode',
        kind='mode',
        variant='slow state',
        signals=('rate', 'history'),
        parameters=(
            ParameterSpec('stiffness', 'rad/s² per rad', -_INF, _INF, (0.0,), 1.0),
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
            ParameterSpec('in_phase', 'rad/s² per rad/s', -_INF, _INF, (0.0,), 0.5),
            ParameterSpec('quadrature', 'rad/s² per rad/s', -_INF, _INF, (0.1,), 0.5),
        ),
        physics='something that swings along with the aircraft: a load on a cord, a loose arm',
        excite='a chirp through its frequency',
        torque=torques.swinging,
    ),
    Effect(
        name='mode',
        kind='mode',
        variant='hysteresis',
        signals=('rate', 'history'),
        parameters=(
            ParameterSpec('torque', 'rad/s²', 0.0, _INF, (0.1,), 0.1),
            ParameterSpec('build_up', 'rad', 1e-3, 1.0, (0.02, 0.1), 0.02),
        ),
        physics='a friction that builds up over an angle, as in cables and seals (Dahl 1968)',
        excite='small and large slow reversals',
        torque=torques.hysteresis,
    ),
    *(
        Effect(
            name='shape:rate',
            kind='shape',
            variant=variant,
            signals=('rate',),
            parameters=knot_parameters(count - 2, 'rad/s²', 0.1),
            physics='a torque that is a smooth curve of the rate',
            excite='rates spread evenly over their range: a chirp or a multisine',
            prepare=partial(_laid, name='rate', known='base', share=share, count=count),
            torque=partial(_torque_curve, kernels.RATE_CURVE),
            prior=_torque_prior,
        )
        for variant, count, share in (('', RATE_KNOTS, WARP), ('broad', BROAD_KNOTS, 0.0))
    ),
    *(
        Effect(
            name='shape:angle',
            kind='shape',
            variant=variant,
            signals=('angle',),
            parameters=knot_parameters(count - 1, 'rad/s²', 0.1),
            physics='a torque that is a smooth curve of the angle',
            excite='slow large angles: a slow chirp or a square wave of long period',
            prepare=partial(_laid, name='angle', known='own', count=count),
            torque=partial(_torque_curve, kernels.ANGLE_CURVE),
            prior=_torque_prior,
        )
        for variant, count in (('', KNOTS), ('fine', FINE_KNOTS))
    ),
    Effect(
        name='shape:angle',
        kind='shape',
        variant='friction',
        signals=('rate', 'angle'),
        parameters=knot_parameters(KNOTS, 'rad/s²', 0.1),
        physics='a friction against the rate that is a smooth curve of the angle',
        excite='slow reversals at all angles: a square wave of changing amplitude',
        prepare=partial(_laid, name='angle', known='free'),
        torque=_friction_by_angle,
        prior=_torque_prior,
    ),
    *(
        Effect(
            name='shape:command',
            kind='shape',
            variant=variant,
            signals=('command',),
            parameters=knot_parameters(count - 2, '1', 0.002),
            physics=physics,
            excite='commands spread evenly over their range: a multisine',
            prepare=partial(_laid, name='command', known='base', share=share),
            command=curve,
            prior=_command_prior,
        )
        for variant, count, share, physics, curve in (
            ('', KNOTS, 0.0, 'the command acts through a smooth curve', _command_map),
            (
                'thrust', RATE_KNOTS, WARP,
                'what the motors give, after their lag, is a smooth curve', _thrust_map,
            ),
        )
    ),
    Effect(
        name='event',
        kind='event',
        variant='torque',
        signals=('time',),
        parameters=(*_PASSING, ParameterSpec('torque', 'rad/s²', -_INF, _INF, (0.0,), 0.1)),
        physics='a torque that acts for a while and is gone: a gust, a touch, a snag',
        excite='any; the event itself must fall into the training segments',
        starts=preparation.passing_starts,
        torque=torques.pulse_torque,
    ),
    Effect(
        name='event',
        kind='event',
        variant='gain',
        signals=('time', 'command'),
        parameters=(*_PASSING, ParameterSpec('change', '1', -1.0, 5.0, (0.0,), 0.05)),
        physics='the gain changes for a while and returns: a motor that misses',
        excite='any; the event itself must fall into the training segments',
        starts=preparation.passing_starts,
        command=_gain_in_between,
    ),
)

__all__ = ['NAMED_CURVES', 'SHAPES']
