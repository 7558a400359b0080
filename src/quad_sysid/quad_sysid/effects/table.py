"""The table of effects: one entry each, with physics, signals, parameters and the flight for it.

To add an effect is to add one entry here and its test. Fitting and choosing stand elsewhere.
All torques are divided by the axis' inertia, which a bag alone cannot give: rad/s².
"""

from __future__ import annotations

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.greybox import kernels
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.structure import Effect, ParameterSpec, Settings, Term

STICTION_RATE = 0.01
"""Rate over which a friction torque changes its sign, rad/s: below any gyro's noise."""


def _drag(_: AxisData, p: FloatArray, __: Settings) -> Term:
    return Term(kernels.QUADRATIC, (p[0],))


def _coulomb(data: AxisData, p: FloatArray, _: Settings) -> Term:
    # the slope at rest must not outrun the integration step of one cycle
    return Term(kernels.COULOMB, (p[0], max(STICTION_RATE, abs(p[0]) * data.dt)))


def _pendulum(_: AxisData, p: FloatArray, __: Settings) -> Term:
    return Term(kernels.PENDULUM, (p[0],))


def _cubic(_: AxisData, p: FloatArray, __: Settings) -> Term:
    return Term(kernels.CUBIC, (p[0],))


def _dead_zone(_: AxisData, command: FloatArray, p: FloatArray, __: Settings) -> FloatArray:
    return np.sign(command) * np.maximum(np.abs(command) - p[0], 0.0)


def _needs_angle(data: AxisData) -> Settings | str:
    if data.angle is None:
        return 'the bag holds no orientation'
    return {}


def _command_scale(data: AxisData) -> float:
    """RMS of the command over the training segments, normalised."""
    values = np.concatenate([data.command[a:b] for a, b in data.train])
    return float(np.std(values))


def _sag_settings(data: AxisData) -> Settings | str:
    if data.battery_v is None:
        return 'the bag holds no battery voltage'
    used = np.concatenate([data.battery_v[a:b] for a, b in data.train])
    if np.ptp(used) < 0.01 * np.mean(used):
        return f'the voltage moves by {np.ptp(used):.3f} V only; fly longer or with more throttle'
    return {'reference_v': float(np.mean(used))}


def _sag(data: AxisData, command: FloatArray, p: FloatArray, settings: Settings) -> FloatArray:
    reference = settings['reference_v']
    if data.battery_v is None or not isinstance(reference, float):
        return command
    return command * (data.battery_v / reference) ** p[0]


def _spec(
    name: str, unit: str, starts: tuple[float, ...], bounds: tuple[float, float], scale: float
) -> ParameterSpec:
    return ParameterSpec(name, unit, bounds[0], bounds[1], starts, scale)


_INF = float('inf')

EFFECTS: tuple[Effect, ...] = (
    Effect(
        name='coulomb_friction',
        signals=('rate',),
        parameters=(_spec('torque', 'rad/s²', (0.1,), (0.0, _INF), 0.1),),
        physics='-T sign(rate): dry friction of a bearing (Coulomb 1785)',
        excite='slow and fast motion with many reversals: a PRBS or a slow square wave',
        torque=_coulomb,
    ),
    Effect(
        name='quadratic_drag',
        signals=('rate',),
        parameters=(_spec('coefficient', 'rad/s² per (rad/s)²', (0.05,), (0.0, _INF), 0.1),),
        physics='-k rate |rate|: drag of arms and discs in turbulent flow',
        excite='high rates: a square wave of large amplitude, a chirp',
        torque=_drag,
    ),
    Effect(
        name='pendulum_stiffness',
        signals=('angle',),
        parameters=(_spec('stiffness', 'rad/s² per rad', (0.0,), (-_INF, _INF), 1.0),),
        physics='-k sin(angle): centre of mass below (k > 0) or above the axis',
        excite='large slow angles: a square wave of long period, a slow chirp',
        prepare=_needs_angle,
        torque=_pendulum,
    ),
    Effect(
        name='cubic_stiffness',
        signals=('angle',),
        parameters=(_spec('stiffness', 'rad/s² per rad³', (0.0,), (-_INF, _INF), 10.0),),
        physics='-k angle³: a spring that hardens (k > 0), as cables do',
        excite='large angles',
        prepare=_needs_angle,
        torque=_cubic,
    ),
    Effect(
        name='dead_zone',
        signals=('command',),
        parameters=(_spec('half_width', '1', (0.002, 0.01), (0.0, 0.5), 0.005),),
        physics='sign(u) max(|u| - w, 0): the motors do not answer to small commands',
        excite='small commands around zero: a multisine of small amplitude',
        command=_dead_zone,
    ),
    Effect(
        name='battery_sag',
        signals=('command', 'battery'),
        parameters=(_spec('exponent', '1', (1.0,), (-2.0, 6.0), 1.0),),
        physics='gain (V / V_ref)^n: thrust per command falls with the pack voltage',
        excite='a long flight, or throttle changes, so that the voltage moves by 5 % or more',
        prepare=_sag_settings,
        command=_sag,
    ),
)


def by_name(name: str) -> Effect:
    """The effect of this name; KeyError where the table has none."""
    for effect in EFFECTS:
        if effect.name == name:
            return effect
    raise KeyError(name)
