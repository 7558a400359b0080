"""Effects between command and torque: maps of the command, motors, voltage."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import make_interp_spline

from quad_sysid.contract import FloatArray
from quad_sysid.effects.curves import Curve, placed_around_zero
from quad_sysid.effects.hidden import RING, along, followed, ring, step_of
from quad_sysid.effects.torques import Row
from quad_sysid.model import recursion
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import (
    Drive,
    Dynamics,
    Effect,
    Settings,
    Signals,
    Spec,
    required,
)
from quad_sysid.model.structure import BASE

MOVES = 0.02
"""Share of its mean by which a signal must move for its effect to show."""
SLOPING = 0.05
"""Share of a step over which one level gives way to the next."""
AT_ONCE_S = 1e-5
"""A lag that counts as none."""
MOST_MOTORS = 12
"""Motors that may each have an effect of their own."""
LIGHT = 0.3
"""Damping ratio up to which a mode counts as lightly damped."""


def why_not(data: AxisData, *, single: bool = False) -> str:
    """Why an effect of the motors, or of a single one, cannot be told here; '' if it can."""
    if not data.motors.shape[1] or np.ptp(data.training(data.motors), axis=0).max() < 1e-6:
        return 'the bag holds no motor commands'
    if single and all(isinstance(data.signal(f'other command {i}'), str) for i in (1, 2)):
        return 'the other axes hardly move, so no single motor can be told apart'
    return ''


class Map(Row):
    """A map of the command; of every motor's command where it depends on the motors.

    Its law takes the data, the command (n,) or those of the motors (k, n), and the parameters;
    `mode`, where it is linear with memory, gives its Dynamics from the parameters.
    """

    term = 'command'
    mode: Callable[[FloatArray], Dynamics] | None = None

    def prepare(self, data: AxisData) -> Settings | str:
        why = why_not(data) if 'motors' in self.signals else ''
        return why or super().prepare(data)

    def command(
        self, data: AxisData, command: FloatArray, p: FloatArray, settings: Settings
    ) -> FloatArray:
        if 'motors' not in self.signals:
            return self.law(data, command, p)
        motors = data.motors.T
        return command + data.share @ (self.law(data, motors, p) - motors)

    def dynamics(self, p: FloatArray) -> Dynamics | None:
        return None if self.mode is None else self.mode(p)


def _slew(data: AxisData, motors: FloatArray, p: FloatArray) -> FloatArray:
    step = float(p[0]) * data.dt
    return np.stack([along(data, m, recursion.slew, step) for m in motors])


def _in_steps(data: AxisData, motors: FloatArray, p: FloatArray) -> FloatArray:
    """To whole steps; one level lies p[1] steps of p[0] above half of the range.

    A level is kept until the command is p[2] steps further away from it than half of one.
    """
    steps = (motors - 0.5) / p[0] - p[1]
    taken = [along(data, one, recursion.in_steps, float(p[2]), SLOPING) for one in steps]
    return 0.5 + p[0] * (p[1] + np.stack(taken))


def lagged(data: AxisData, command: FloatArray, tau: float) -> FloatArray:
    """(n,) a held command after a first-order lag of `tau` s, mean over each cycle."""
    keep = math.exp(-data.dt / tau)
    a, b = np.array([[keep]]), np.array([1.0 - keep])
    out = command[None, :].copy()
    followed(data.stretches, command, a, b, out)
    return command + (out[0] - command) * (tau / data.dt * (1.0 - keep))


def _ringing(data: AxisData, command: FloatArray, p: FloatArray) -> FloatArray:
    """Command plus the response of a damped mode at mid-cycle."""
    system = ring(min(float(p[0]), 0.4 / data.dt), float(p[1]))
    x = np.stack([command, np.zeros_like(command)])
    followed(data.stretches, command, *step_of(*system, data.dt), x)
    a, b = step_of(*system, 0.5 * data.dt)
    z = a @ x + b[:, None] * command
    return command + p[2] * z[0] + p[3] * z[1]


def _swinging(p: FloatArray) -> Dynamics:
    """The same to a loop."""
    return Dynamics(0.0, 2.0 * math.pi * float(p[0]), float(p[1]), float(p[2]), float(p[3]))


def _lightly(p: FloatArray) -> FloatArray:
    """(4,) with no more damping than a resonance has."""
    return np.r_[p[0], min(float(p[1]), LIGHT), p[2:]]


HALF_WIDTH = (
    Spec('half_width', '1', spread=2.0, centre=math.log(0.003), log=True,
         starts=(0.0003, 0.001, 0.003, 0.01)),
)
MAPS = (
    Map(
        'dead_zone', ('command',), HALF_WIDTH,
        lambda _, u, p: np.sign(u) * np.maximum(np.abs(u) - p[0], 0.0),
        physics='sign(u) max(|u| - w, 0): the motors do not answer to small commands',
        excite='small commands around zero: a multisine of small amplitude',
    ),
    Map(
        'backlash', ('command', 'history'), HALF_WIDTH,
        lambda data, u, p: along(data, u, recursion.play, float(p[0])),
        physics='play of +-w between command and torque',
        excite='small slow reversals of the command',
    ),
)
SLOW_MAPS = (
    Map(
        'shape:lag:command', ('command', 'motors', 'history'),
        (
            Spec('slew', '1/s', spread=1.5, centre=math.log(3.0), log=True,
                 starts=(0.5, 1.5, 4.0, 10.0)),
        ),
        _slew, kind='shape', variant='slew limit', term='response',
        physics='the command of a motor changes by at most so much a second',
        excite='large steps of the command',
    ),
    Map(
        'shape:gain:command', ('command', 'motors'),
        (
            Spec('step', '1', spread=1.5, centre=math.log(0.01), log=True),
            Spec('level', '1', spread=0.3, starts=(0.0,)),
            Spec('hysteresis', '1', spread=0.3, positive=True, starts=(0.0, 0.25)),
        ),
        _in_steps, kind='shape', variant='steps',
        stepped=True,
        physics='motors take their command in whole steps, with hysteresis',
        excite='slow small commands',
    ),
    Map(
        'mode', ('command', 'history'),
        (
            Spec('time_constant', 's', spread=1.0, centre=math.log(0.02), log=True,
                 starts=(0.01, 0.03, 0.1)),
        ),
        lambda data, u, p: lagged(data, u, max(float(p[0]), 1e-5)),
        mode=lambda p: Dynamics(lag_s=float(p[0])), kind='mode', variant='second lag',
        term='response', physics='a second first-order lag between command and torque',
        excite='a PRBS that reaches beyond 1 / lag',
    ),
    Map(
        'mode', ('command', 'history'),
        (
            Spec('frequency', 'Hz', spread=0.8, centre=math.log(3.0), log=True,
                 starts=(1.0, 2.0, 4.0, 8.0)),
            Spec('damping_ratio', '1', spread=0.4, centre=math.log(0.8), log=True, starts=(0.8,)),
            Spec('in_phase', '1', spread=0.3), Spec('quadrature', '1', spread=0.3),
        ),
        _ringing, kind='mode', variant='second order', term='response', mode=_swinging,
        physics=f"{RING} u; adds in_phase z + quadrature z'/w to the command: motors under a "
        'speed controller',
        excite='a PRBS that reaches beyond the frequency',
    ),
    Map(
        'resonance', ('command', 'history'),
        (
            Spec('frequency', 'Hz', spread=0.8, centre=math.log(5.0), log=True,
                 starts=tuple(np.geomspace(1.5, 16.0, 12))),
            Spec('damping_ratio', '1', spread=0.7, centre=math.log(0.06), log=True,
                 starts=(0.06,)),
            # at its peak a mode adds half of what is commanded: share / (2 damping ratio)
            Spec('in_phase', '1', spread=0.06), Spec('quadrature', '1', spread=0.06),
        ),
        lambda data, u, p: _ringing(data, u, _lightly(p)),
        term='response', mode=lambda p: _swinging(_lightly(p)),
        physics=f"{RING} u; adds in_phase z + quadrature z'/w to the command",
        excite='a chirp or PRBS through the mode',
    ),
)


class BatterySag(Effect):
    """The gain follows a power of the battery's voltage."""

    name = 'battery_sag'
    signals = ('battery', 'command')
    term = 'gain'
    parameters = (Spec('exponent', '1', spread=1.5),)
    physics = 'gain (V / V_ref)^n: thrust per command falls with the pack voltage'
    excite = 'a long flight, or throttle changes, so that the voltage moves by 5 % or more'

    def prepare(self, data: AxisData) -> Settings | str:
        volts = data.signal('battery')
        if isinstance(volts, str):
            return volts
        used = data.training(volts)
        if np.ptp(used) < 0.002 * np.mean(used):
            return f'the voltage moves by {np.ptp(used):.3f} V only; fly longer'
        return {'reference_v': float(np.mean(used))}

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return s.drive * ((required(s.battery_v) / float(settings['reference_v'])) ** p[0] - 1.0)

    def usual(self, p: FloatArray, settings: Settings) -> Mapping[str, float]:
        return {'battery': float(settings['reference_v'])}


class Propellers(Effect):
    """The thrust of propellers is a curve of their motor's speed, a lagged command."""

    term = 'command'

    def bend(
        self, m: FloatArray, p: FloatArray, settings: Settings
    ) -> tuple[FloatArray, FloatArray]:
        """What thrusts gain at lagged commands m (motors, n), and the slope of that over m.

        Nothing is gained at the usual throttle, so that the base keeps its bias.
        """
        raise NotImplementedError

    def actuate(self, data: AxisData, drive: Drive, p: FloatArray, settings: Settings) -> Drive:
        # f(m) of the lagged m follows the same lag where the command is f(m) + f'(m) (u - m)
        which = list(self.motors or range(data.motors.shape[1]))
        u = data.motors.T[which]
        m = np.stack([lagged(data, one, float(drive.lag[0, 0])) for one in u])
        thrust, slope = self.bend(m, p, settings)
        more = data.share[which] @ (thrust + slope * (u - m))
        return replace(drive, commands=np.vstack([drive.commands[:1] + more, drive.commands[1:]]))


class ThrustCurve(Propellers):
    """The thrust of each propeller is quadratic in its motor command."""

    name = 'thrust_curve'
    signals = ('command', 'throttle', 'motors')
    parameters = (Spec('curvature', '1', spread=0.4),)
    physics = 'thrust (1 - k) m + k m² of each motor command m'
    excite = 'throttle changes during the excitation, or large commands on two axes at once'

    def prepare(self, data: AxisData) -> Settings | str:
        if why := why_not(data):
            return why
        throttle = data.training(data.control[:, 0])
        others = [data.training(data.control[:, i + 1]) for i in range(3) if i != data.index]
        mean = float(np.mean(throttle))
        product = float(np.std(others[0] * others[1]))
        command = float(np.std(data.training(data.command)))
        if np.std(throttle) < MOVES * mean and product < MOVES * command:
            return f'the throttle stays at {mean:.2f}; fly with throttle changes'
        return {'throttle': mean}

    def bend(
        self, m: FloatArray, p: FloatArray, settings: Settings
    ) -> tuple[FloatArray, FloatArray]:
        k, away = float(p[0]), m - settings['throttle']
        bent = k / max(1.0 - k + 2.0 * k * settings['throttle'], 1e-3)
        return bent * away**2, 2.0 * bent * away


class MotorCurve(Propellers, Curve):
    """The slope of thrust over command is a smooth curve, of all motors or of one."""

    def __init__(self, smoothness: str, *motors: int) -> None:
        super().__init__('gain', 'command', smoothness)
        self.motors = motors
        who = f'motor {motors[0] + 1}' if motors else 'motors'
        self.term, self.variant = 'command', f'{smoothness}, {who}'
        self.signals = ('command', 'motors', 'throttle')
        self.parameters = tuple(
            Spec(f'slope_{i}', '1', spread=0.3) for i in range(self.count)
        )
        self.physics = 'thrust m + f(m) of a motor command m behind its lag; f has smooth slopes'
        self.excite = 'throttle changes during the excitation, large commands on two axes at once'

    def prepare(self, data: AxisData) -> Settings | str:
        why = why_not(data, single=len(self.motors) == 1)
        if why:
            return why
        low, high = np.percentile(data.training(data.motors), [0.5, 99.5])
        return {
            'knots': tuple(np.linspace(low, high, self.count).tolist()),
            'place': tuple(np.linspace(-1.0, 1.0, self.count).tolist()),
            # of all motors the mean slope is the gain; one may be weaker than the others
            'mean': (0.0 if self.motors else 1.0 / self.count,) * self.count,
            'throttle': float(np.mean(data.training(data.control[:, 0]))),
        }

    def bend(
        self, m: FloatArray, p: FloatArray, settings: Settings
    ) -> tuple[FloatArray, FloatArray]:
        knots, slopes = settings['knots'], p - float(np.dot(settings['mean'], p))
        area = make_interp_spline(knots, slopes, k=1).antiderivative()

        def thrust(m: FloatArray) -> FloatArray:
            inside = np.clip(m, knots[0], knots[-1])
            return area(inside) + np.interp(m, knots, slopes) * (m - inside)

        return thrust(m) - thrust(settings['throttle']), np.interp(m, knots, slopes)


class Saturation(Map):
    """Each motor command is limited on one side."""

    def __init__(self, side: str) -> None:
        limit, centre = (np.minimum, 1.0) if side == 'upper' else (np.maximum, 0.0)
        super().__init__(
            'saturation', ('command', 'motors'),
            (Spec(side, '1', spread=0.3, centre=centre, starts=(centre,)),),  # not linear in it
            lambda _, motors, p: limit(motors, p[0]), variant=side,
            physics='clip(m, lower, upper): the motors stop short of what is commanded',
            excite='large commands: a square wave of large amplitude',
        )

    def prepare(self, data: AxisData) -> Settings | str:
        why, motors = why_not(data), data.training(data.motors)
        return why or {'lowest': float(motors.min()), 'highest': float(motors.max())}

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        motors = data.training(data.motors)
        shares = (99.0, 95.0, 85.0) if self.variant == 'upper' else (1.0, 5.0, 15.0)
        return [np.array([value]) for value in np.percentile(motors, shares)]

    def readable(self, p: FloatArray, settings: Settings) -> dict[str, tuple[float, str]]:
        upper = self.variant == 'upper'
        return {
            'lower': (0.0 if upper else float(p[0]), '1'),
            'upper': (float(p[0]) if upper else 1.0, '1'),
        }

    def fitted(self, values: Mapping[str, float], settings: Settings) -> FloatArray:
        return np.array([values[self.variant]])

    def usual(self, p: FloatArray, settings: Settings) -> Mapping[str, float]:
        # in the middle of the motors' limits: as far to either side
        return {'throttle': 0.5 * float(p[0] + (0.0 if self.variant == 'upper' else 1.0))}


def differing(
    data: AxisData, drive: Drive, motors: Sequence[int], slow_s: float | None = None,
    factors: tuple[FloatArray, FloatArray] | None = None,
) -> Drive:
    """Some motors with a lag of their own: channels for these, and one that takes back the usual.

    The first channel, which all other effects act on, stays the command of the axis. factors:
    knots and values (k,), as in Drive.factors.
    """
    which = list(motors)
    share, own = drive.row[0] * data.share[which], data.motors.T[which]
    lag = np.repeat(drive.lag[:1], len(which) + 1, axis=0)
    if slow_s is not None:
        lag[:-1] = slow_s
    curves = [] if factors is None else [np.array([factors] * len(which))]
    return Drive(
        np.vstack([drive.commands, own, share @ own]), np.r_[drive.row, share, -1.0],
        np.vstack([drive.lag, lag]), np.concatenate([drive.factors, *curves]),
    )


class Motors(Row):
    """What happens between commands and torque: the law gives the Drive after it."""

    term = 'response'

    def prepare(self, data: AxisData) -> Settings | str:
        return (why_not(data, single=len(self.motors) == 1)
                if 'motors' in self.signals else '') or {}

    def actuate(self, data: AxisData, drive: Drive, p: FloatArray, settings: Settings) -> Drive:
        return self.law(data, drive, p)


def _slow_motor(motor: int) -> Effect:
    return Motors(
        'motor_lag', ('command', 'motors'), (replace(SLOW, starts=(0.07, 0.12, 0.25)),),
        lambda data, drive, p: differing(data, drive, [motor], slow_s=float(p[0])),
        motors=(motor,), variant=f'motor {motor + 1}',
        physics='one motor answers with a longer lag; the other axes then act here as well',
        excite='hover with all axes moving',
    )


def _slow_share(sign: float) -> Callable[[AxisData, Drive, FloatArray], Drive]:
    def shared(_: AxisData, drive: Drive, p: FloatArray) -> Drive:
        slow, share = np.maximum(p[0], drive.lag[:1]), sign * p[1]
        return Drive(
            np.vstack([drive.commands, drive.commands[:1]]),
            np.r_[drive.row[:1] * (1.0 - share), drive.row[1:], drive.row[:1] * share],
            np.vstack([drive.lag, slow]), np.vstack([drive.factors, drive.factors[:1]]),
        )

    return shared


def _reaction(_: AxisData, drive: Drive, p: FloatArray) -> Drive:
    """Torque T drive' beside the drive; as drive' = (u - drive) / lag, it is a share of u."""
    lag = drive.lag[:1]
    share = float(p[0]) / float(lag[0, 0])
    return Drive(
        np.vstack([drive.commands, drive.commands[:1]]),
        np.r_[drive.row[:1] * (1.0 - share), drive.row[1:], drive.row[:1] * share],
        np.vstack([drive.lag, np.full_like(lag, AT_ONCE_S)]),
        np.vstack([drive.factors, drive.factors[:1]]),
    )


def _asymmetric(variant: str, *motors: int, each: bool = True) -> Effect:
    """Of these motors, of each one (none named), or of the axis' command."""

    def uneven(data: AxisData, drive: Drive, p: FloatArray) -> Drive:
        factors = BOTH_WAYS, -float(p[0]) * np.sign(BOTH_WAYS)
        if each:
            return differing(data, drive, motors or range(data.motors.shape[1]), factors=factors)
        whole = drive.factors.copy()
        whole[0] = factors
        return replace(drive, factors=whole)

    return Motors(
        'shape:lag:direction', ('command', 'direction', *(('motors',) if each else ())),
        (Spec('asymmetry', '1', spread=0.5),), uneven, kind='shape', variant=variant,
        motors=motors, excite='steps of the command up and down',
        physics='a motor slows down with the lag times exp(a) and speeds up with the lag over '
        'exp(a)',
    )


class HasteCurve(Curve):
    """The lag of all motors follows how far each has to go, its command less its speed.

    A smooth curve of the logarithm of a factor.
    """

    def __init__(self) -> None:
        super().__init__('lag', 'command', 'smooth')
        self.name, self.variant, self.term = 'shape:lag:direction', 'smooth, motors', 'response'
        self.signals = ('command', 'direction', 'motors')
        self.parameters = tuple(replace(spec, spread=1.0) for spec in self.parameters)
        self.physics = 'the lag of a motor follows how far it has to go, as a smooth curve'
        self.excite = 'small and large steps of the command, up and down'

    def prepare(self, data: AxisData) -> Settings | str:
        why, usual = why_not(data), math.exp(BASE[1].centre)
        away = [data.training(m - lagged(data, m, usual)) for m in data.motors.T]
        # a motor that is late has further to go than by the usual lag
        return why or placed_around_zero(np.concatenate(away), self.count, reach=2.0)

    def actuate(self, data: AxisData, drive: Drive, p: FloatArray, settings: Settings) -> Drive:
        knots, values = np.array(settings['knots']), p - float(np.dot(settings['mean'], p))
        return differing(data, drive, range(data.motors.shape[1]), factors=(knots, values))


BOTH_WAYS = np.array([-3.0, -2.0, -1e-9, 1e-9, 2.0, 3.0])
"""Knots of a curve that only knows whether a motor slows down or speeds up."""
SLOW = Spec('slow_time_constant', 's', spread=0.7, centre=math.log(0.12), log=True,
            starts=(0.09, 0.15, 0.3))
SHARE = Spec('share', '1', spread=0.3, positive=True)
ACTUATORS: tuple[Effect, ...] = (
    *MAPS, BatterySag(), ThrustCurve(), MotorCurve('smooth'), MotorCurve('rough'),
    *(MotorCurve('smooth', i) for i in range(MOST_MOTORS)), Saturation('upper'),
    Saturation('lower'),
    Motors(
        'motor_lag', ('command',), (SLOW, SHARE), _slow_share(1.0),
        physics='a share of the motors answers with a longer lag than the others',
        excite='a PRBS that reaches beyond 1 / lag',
    ),
    Motors(
        'mode', ('command',), (SLOW, SHARE), _slow_share(-1.0), kind='mode', variant='lead',
        physics="the torque overshoots and falls back by a share: rotors' own reaction in yaw",
        excite='a PRBS that reaches beyond 1 / lag',
    ),
    Motors(
        'mode', ('command',),
        (Spec('lead_time', 's', spread=1.0, centre=math.log(0.1), log=True,
              starts=(0.03, 0.1, 0.3)),),
        _reaction, kind='mode', variant='lead of rotors',
        physics='T times the change of the drive: rotors that speed up push the body the other '
        'way, a true lead in yaw',
        excite='a PRBS that reaches beyond 1 / lag',
    ),
    *(_slow_motor(i) for i in range(MOST_MOTORS)), _asymmetric('motors'),
    _asymmetric('axis', each=False), HasteCurve(),
    *(_asymmetric(f'motor {i + 1}', i) for i in range(MOST_MOTORS)), *SLOW_MAPS,
)
