"""The table of effects: one entry each, with physics, signals, parameters and the flight for it.

To add an effect is to add one entry here and its test. Fitting and choosing stand elsewhere.
All torques are divided by the axis' inertia, which a bag alone cannot give: rad/s².
"""

from __future__ import annotations

from functools import partial

from quad_sysid.contract import FloatArray
from quad_sysid.effects import commands, preparation, torques
from quad_sysid.greybox.data import AxisData
from quad_sysid.greybox.structure import Effect, ParameterSpec, Settings

_INF = float('inf')


def _spec(
    name: str, unit: str, starts: tuple[float, ...], bounds: tuple[float, float], scale: float
) -> ParameterSpec:
    return ParameterSpec(name, unit, bounds[0], bounds[1], starts, scale)


def _gain_after(
    data: AxisData, command: FloatArray, p: FloatArray, _: Settings, __: FloatArray
) -> FloatArray:
    out: FloatArray = command * (1.0 + p[1] * torques.after(data, float(p[0])))
    return out


EFFECTS: tuple[Effect, ...] = (
    Effect(
        name='coulomb_friction',
        signals=('rate',),
        parameters=(_spec('torque', 'rad/s²', (0.1,), (0.0, _INF), 0.1),),
        physics='-T sign(rate): dry friction of a bearing (Coulomb 1785)',
        excite='slow and fast motion with many reversals: a PRBS or a slow square wave',
        torque=torques.coulomb,
    ),
    Effect(
        name='quadratic_drag',
        signals=('rate',),
        parameters=(_spec('coefficient', 'rad/s² per (rad/s)²', (0.05,), (0.0, _INF), 0.1),),
        physics='-k rate |rate|: drag of arms and discs in turbulent flow',
        excite='high rates: a square wave of large amplitude, a chirp',
        torque=torques.drag,
    ),
    Effect(
        name='pendulum_stiffness',
        signals=('angle',),
        parameters=(_spec('stiffness', 'rad/s² per rad', (0.0,), (-_INF, _INF), 1.0),),
        physics='-k sin(angle): centre of mass below (k > 0) or above the axis',
        excite='large slow angles: a square wave of long period, a slow chirp',
        prepare=preparation.needs_angle,
        torque=torques.pendulum,
    ),
    Effect(
        name='cubic_stiffness',
        signals=('angle',),
        parameters=(_spec('stiffness', 'rad/s² per rad³', (0.0,), (-_INF, _INF), 10.0),),
        physics='-k angle³: a spring that hardens (k > 0), as cables do',
        excite='large angles',
        prepare=preparation.needs_angle,
        torque=torques.cubic,
    ),
    Effect(
        name='dead_zone',
        signals=('command',),
        parameters=(_spec('half_width', '1', (0.002, 0.01), (0.0, 0.5), 0.005),),
        physics='sign(u) max(|u| - w, 0): the motors do not answer to small commands',
        excite='small commands around zero: a multisine of small amplitude',
        command=commands.dead_zone,
    ),
    Effect(
        name='battery_sag',
        signals=('command', 'battery'),
        parameters=(_spec('exponent', '1', (1.0,), (-2.0, 6.0), 1.0),),
        physics='gain (V / V_ref)^n: thrust per command falls with the pack voltage',
        excite='a long flight, or throttle changes, so that the voltage moves by 5 % or more',
        prepare=preparation.sag_settings,
        command=commands.battery_sag,
    ),
    Effect(
        name='thrust_curve',
        signals=('command', 'throttle'),
        parameters=(_spec('curvature', '1', (0.3,), (-1.0, 1.0), 0.2),),
        physics='thrust (1 - k) m + k m² of each motor command m',
        excite='throttle changes during the excitation, or large commands on two axes at once',
        prepare=preparation.thrust_settings,
        command=commands.thrust_curve,
    ),
    Effect(
        name='saturation',
        signals=('command', 'motors'),
        parameters=(
            _spec('lower', '1', (0.0,), (0.0, 1.0), 0.02),
            _spec('upper', '1', (1.0,), (0.0, 1.0), 0.02),
        ),
        physics='clip(m, lower, upper): the motors stop short of what they are told',
        excite='large commands: a square wave of large amplitude',
        starts=preparation.limit_starts,
        command=commands.saturation,
    ),
    Effect(
        name='motor_lag',
        signals=('command',),
        parameters=(
            _spec('slow_time_constant', 's', (0.1, 0.2), (0.005, 1.0), 0.03),
            _spec('share', '1', (0.25,), (0.0, 1.0), 0.2),
        ),
        physics='a share of the motors answers with a longer lag than the others',
        excite='a PRBS that reaches beyond 1 / lag',
        command=commands.slow_motors,
    ),
    *(
        Effect(
            name='motor_lag',
            variant=f'motor {motor + 1}',
            signals=('command', 'motors'),
            parameters=(
                _spec('slow_time_constant', 's', (0.1, 0.2), (0.005, 1.0), 0.03),
            ),
            physics='one motor answers with a longer lag; the other axes then act here as well',
            excite='hover with all axes moving',
            prepare=partial(preparation.single_motor, motor=motor),
            command=commands.one_slow_motor,
        )
        for motor in range(4)
    ),
    Effect(
        name='backlash',
        signals=('command', 'history'),
        parameters=(_spec('half_width', '1', (0.002, 0.008), (0.0, 0.5), 0.003),),
        physics='play of +-w between command and torque',
        excite='small slow reversals of the command',
        command=commands.backlash,
    ),
    Effect(
        name='resonance',
        signals=('command', 'history'),
        parameters=(
            _spec('frequency', 'Hz', (2.5, 5.0, 8.0, 13.0), (0.5, 20.0), 0.5),
            _spec('damping_ratio', '1', (0.1,), (0.002, 0.3), 0.05),
            _spec('in_phase', '1', (0.0,), (-5.0, 5.0), 0.2),
            _spec('quadrature', '1', (0.1,), (-5.0, 5.0), 0.2),
        ),
        physics='a lightly damped mode between command and torque',
        excite='a chirp or PRBS through the mode',
        command=commands.resonance,
    ),
    *(
        Effect(
            name='cross_axis_input',
            variant=f'other axis {which + 1}',
            signals=('other command',),
            parameters=(_spec('fraction', '1', (0.0,), (-2.0, 2.0), 0.05),),
            physics="a fraction of another axis' command acts here (motors out of line)",
            excite='both axes excited with different signals',
            prepare=partial(preparation.coupled_command, which=which),
            command=commands.cross_axis,
        )
        for which in (0, 1)
    ),
    *(
        Effect(
            name='gyroscopic_coupling',
            variant=f'other axis {which + 1}',
            signals=('other rate',),
            parameters=(_spec('coefficient', '1/s', (0.0,), (-_INF, _INF), 0.2),),
            physics="h times another axis' rate: spinning rotors (paper, eqs. 4 and 5)",
            excite='hover with all axes moving',
            prepare=partial(preparation.coupled_rate, which=which),
            torque=torques.other_rate,
        )
        for which in (0, 1)
    ),
    Effect(
        name='inertia_coupling',
        signals=('product of other rates',),
        parameters=(_spec('coefficient', '1', (0.0,), (-_INF, _INF), 0.2),),
        physics='c times the product of the other two rates (Euler; paper, eqs. 4 to 6)',
        excite='hover with all axes moving fast',
        prepare=preparation.both_rates,
        torque=torques.rate_product,
    ),
    Effect(
        name='periodic_disturbance',
        signals=('time',),
        parameters=(
            _spec('amplitude', 'rad/s²', (0.1,), (0.0, _INF), 0.1),
            _spec('frequency', 'Hz', (1.0,), (0.05, 16.0), 0.01),
            _spec('phase', 'rad', (0.0,), (-_INF, _INF), 0.3),
        ),
        physics='A sin(2 pi f t + phase): an unbalanced part, a swinging load',
        excite='any flight of many periods',
        starts=preparation.line_starts,
        torque=torques.periodic,
    ),
    Effect(
        name='step_event',
        variant='gain',
        signals=('time', 'command'),
        parameters=(
            _spec('time', 's', (0.0,), (0.0, _INF), 0.5),
            _spec('change', '1', (0.0,), (-1.0, 5.0), 0.05),
        ),
        physics='from a time on the gain is scaled by 1 + change (a blade chips)',
        excite='any; the event itself must fall into the training segments',
        starts=preparation.event_starts,
        command=_gain_after,
    ),
    Effect(
        name='step_event',
        variant='torque',
        signals=('time',),
        parameters=(
            _spec('time', 's', (0.0,), (0.0, _INF), 0.5),
            _spec('torque', 'rad/s²', (0.0,), (-_INF, _INF), 0.1),
        ),
        physics='from a time on a constant torque acts (a load shifts)',
        excite='any; the event itself must fall into the training segments',
        starts=preparation.event_starts,
        torque=torques.step_torque,
    ),
)


def by_name(name: str) -> Effect:
    """The first effect of this name; KeyError where the table has none."""
    for effect in EFFECTS:
        if effect.name == name:
            return effect
    raise KeyError(name)
