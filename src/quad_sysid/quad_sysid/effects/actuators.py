"""Effects between command and torque: maps of the command, motors, propellers, voltage."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.effects.constants import SAG_SHOWS
from quad_sysid.effects.curves import COUNT, Smooth, placed_around_zero
from quad_sysid.effects.hidden import Linked, System, behind_lag, followed, ring, step_of
from quad_sysid.effects.torques import Row
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import (
    SHORTEST_S,
    UNITS,
    Drive,
    Effect,
    FitResidual,
    Settings,
    Signals,
    Spec,
    required,
)
from quad_sysid.model.structure import BASE

MOVES = 0.02
"""Least scatter for the curvature of thrust: of the throttle, as a share of its mean, or of the
product of the other axes' commands, as a share of this axis' command."""
VOLTAGE_MOVES = 0.002
"""Least change of the voltage, as a share of its mean, for its effect."""
MOST_MOTORS = 12
"""Motors that may each have an effect of their own."""
LIGHT = 0.3
"""Damping ratio up to which a mode counts as lightly damped."""
SLOPING = 0.05
"""Share of a step over which one level gives way to the next."""


class Map(Row):
    """A map of the command; of every motor's command where it depends on the motors.

    Its law takes the signals, the commands (1, …) or those of the motors (k, …), and the
    parameters.
    """

    term = 'command'

    def commands(self, s: Signals) -> FloatArray:
        """The commands that it maps: (1, …) the axis', or (k, …) those of the motors."""
        return np.stack(required(s.motors) if 'motors' in self.signals else [required(s.sent)])

    def command(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        sent_now = self.commands(s)
        mapped: FloatArray = self.law(s, sent_now, p)
        if 'motors' not in self.signals:
            return mapped[0]
        return required(s.sent) + np.tensordot(required(s.share), mapped - sent_now, 1)


class WithMemory(Map):
    """A map that keeps what it gave in the last cycle."""

    states = 1

    def mapped(self, s: Signals, p: FloatArray) -> FloatArray:
        """The commands (k, …) as its law takes them."""
        return self.commands(s)

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return self.mapped(s, p)

    def advance(self, x: FloatArray, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return self.law(s.replaced(hidden=x), self.mapped(s, p), p)


class Steps(WithMemory):
    """Motors that take whole steps; one level lies p[1] steps of p[0] above half of the range.

    A level is held until the command is p[2] steps further away from it than half of one. Around
    that point two steps share the cycle over a short slope, for a smooth likelihood.
    """

    def mapped(self, s: Signals, p: FloatArray) -> FloatArray:
        return (self.commands(s) - 0.5) / p[0] - p[1]

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return np.floor(self.mapped(s, p) + 0.5)

    def starts_by_residual(self, fit: FitResidual, settings: Settings) -> Sequence[FloatArray]:
        starts = self.starts(fit.data, settings)
        return [np.r_[step, start[2:]] for step in fit.steps() for start in starts]

    def command(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        x, states = self.mapped(s, p), required(s.hidden)
        beyond = x - states
        over = np.abs(beyond) - 0.5 - p[2]
        new = np.where(over > 0.0, np.floor(x + 0.5),
                       states + np.where(over > -0.5 * SLOPING, np.sign(beyond), 0.0))
        level = new + np.maximum(0.5 - over / SLOPING, 0.0) * (states - new)
        mapped = 0.5 + p[0] * (p[1] + level) - self.commands(s)
        return required(s.sent) + np.tensordot(required(s.share), mapped, 1)


class Following(Linked, Map):
    """A map with linear states that the command drives."""

    def inputs(self, s: Signals, settings: Settings) -> Sequence[FloatArray]:
        return (required(s.sent),)

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        sent = required(s.sent)
        return np.stack([sent, *[np.zeros_like(sent)] * (self.states - 1)])


def over_cycle(x: FloatArray, u: FloatArray, tau: float, dt: float) -> FloatArray:
    """A command u that is held over a cycle behind a lag of `tau` s, its mean over the cycle.

    x: the lagged command at the start of the cycle.
    """
    return u + (x - u) * (tau / dt * -math.expm1(-dt / tau))


def _ringing(s: Signals, u: FloatArray, p: FloatArray) -> FloatArray:
    """Command plus the response of a damped mode at mid-cycle."""
    a, b = step_of(*_mode(p, s.dt), 0.5 * s.dt)
    z = np.tensordot(a, required(s.hidden), 1) + np.multiply.outer(b, u[0])
    return u + p[2] * z[0] + p[3] * z[1]


def _mode(p: FloatArray, dt: float) -> System:
    return ring(min(float(p[0]), 0.4 / dt), float(p[1]))


def _lightly(p: FloatArray) -> FloatArray:
    """(4,) with no more damping than a resonance has."""
    return np.r_[p[0], min(float(p[1]), LIGHT), p[2:]]


HALF_WIDTH = (
    Spec('half_width', '1', spread=2.0, centre=math.log(0.003), log=True,
         starts=(0.0003, 0.001, 0.003, 0.01)),
)


def _cross_axis(other: int) -> Effect:
    """Motors or gyro out of line: a fraction of another axis' command acts here."""
    return Map(
        'cross_axis_input', ('other command',), (Spec('fraction', '1', spread=0.2),),
        lambda s, u, p: u + p[0] * s.other_commands[other],
        others=(other,), variant=f'other axis {other + 1}')


MAPS = (
    _cross_axis(0), _cross_axis(1),
    Map(
        'dead_zone', ('command',), HALF_WIDTH,
        lambda _, u, p: np.sign(u) * np.maximum(np.abs(u) - p[0], 0.0)),
    WithMemory(
        'backlash', ('command', 'history'), HALF_WIDTH,
        lambda s, u, p: np.clip(s.hidden, u - p[0], u + p[0])),
    WithMemory(
        'shape:lag:command', ('command', 'motors', 'history'),
        (
            Spec('slew', '1/s', spread=1.5, centre=math.log(3.0), log=True,
                 starts=(0.5, 1.5, 4.0, 10.0)),
        ),
        lambda s, u, p: s.hidden + np.clip(u - s.hidden, -p[0] * s.dt, p[0] * s.dt),
        kind='shape', variant='slew limit', term='response'),
    Steps(
        'shape:gain:command', ('command', 'motors'),
        (
            Spec('step', '1', spread=1.5, centre=math.log(0.01), log=True),
            Spec('level', '1', spread=0.3, starts=(0.0,)),
            Spec('hysteresis', '1', spread=0.3, positive=True, starts=(0.0, 0.25)),
        ),
        lambda s, u, p: np.where(np.abs(u - s.hidden) - 0.5 > p[2], np.floor(u + 0.5), s.hidden),
        kind='shape', variant='steps'),
    Following(
        'mode:second_lag', ('command', 'history'),
        (
            Spec('time_constant', 's', spread=1.0, centre=math.log(0.02), log=True,
                 starts=(0.01, 0.03, 0.1)),
        ),
        lambda s, u, p: over_cycle(s.hidden, u, p[0], s.dt), states=1,
        kind='mode', term='response'),
    Following(  # motors under a speed controller
        'mode:second_order', ('command', 'history'),
        (
            Spec('frequency', 'Hz', spread=0.8, centre=math.log(3.0), log=True,
                 starts=(1.0, 2.0, 4.0, 8.0)),
            Spec('damping_ratio', '1', spread=0.4, centre=math.log(0.8), log=True, starts=(0.8,)),
            Spec('in_phase', '1', spread=0.3), Spec('quadrature', '1', spread=0.3),
        ),
        _ringing, kind='mode', term='response', states=2, system=lambda p, s: _mode(p, s.dt)),
    Following(
        'resonance', ('command', 'history'),
        (
            Spec('frequency', 'Hz', spread=0.8, centre=math.log(5.0), log=True,
                 starts=tuple(np.geomspace(1.5, 16.0, 12))),
            Spec('damping_ratio', '1', spread=0.7, centre=math.log(0.06), log=True,
                 starts=(0.06,)),
            # at its peak a mode adds half of what is commanded: share / (2 damping ratio)
            Spec('in_phase', '1', spread=0.06), Spec('quadrature', '1', spread=0.06),
        ),
        lambda s, u, p: _ringing(s, u, _lightly(p)), term='response', states=2,
        system=lambda p, s: _mode(_lightly(p), s.dt)),
)


class BatterySag(Effect):
    """The gain follows a power of the battery's voltage."""

    name = 'battery_sag'
    signals = ('battery', 'command')
    term = 'gain'
    parameters = (Spec('exponent', '1', spread=1.5),)

    def prepare(self, data: AxisData) -> Settings | str:
        volts = data.signal('battery')
        if isinstance(volts, str):
            return volts
        used = data.training(volts)
        if not np.ptp(used) > VOLTAGE_MOVES * np.mean(used):
            return (f'the voltage moves by {np.ptp(used):.3f} V only; fly until it has sunk by '
                    f'{SAG_SHOWS:.0%}')
        return {'reference_v': float(np.mean(used))}

    def torque(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return s.drive * ((required(s.battery_v) / float(settings['reference_v'])) ** p[0] - 1.0)

    def usual(self, p: FloatArray, settings: Settings) -> Mapping[str, float]:
        return {'battery': float(settings['reference_v'])}


class Propellers(Linked):
    """The thrust of propellers is a curve of their motor's speed, a lagged command."""

    term = 'command'
    states = 1

    def system(self, p: FloatArray, s: Signals) -> System:
        """The base's lag as a system."""
        return behind_lag(s.lag)

    def inputs(self, s: Signals, settings: Settings) -> Sequence[FloatArray]:
        return [required(s.motors)[i] for i in of_motors(s, self.motors)]

    def bend(self, m: FloatArray, p: FloatArray,
             settings: Settings) -> tuple[FloatArray, FloatArray]:
        """Additional thrust (motors, n) at lagged commands m (motors, n), and its slope over m.

        Nothing is gained at the usual throttle, so that the base keeps its bias.
        """
        raise NotImplementedError

    def begin(self, s: Signals, p: FloatArray, settings: Settings) -> FloatArray:
        return np.stack(self.inputs(s, settings))

    def actuate(self, drive: Drive, s: Signals, p: FloatArray, settings: Settings) -> Drive:
        # f(m) of the lagged m follows the same lag where the command is f(m) + f'(m) (u - m)
        u = self.begin(s, p, settings)
        m = over_cycle(required(s.hidden), u, s.lag, s.dt)
        thrust, slope = self.bend(m, p, settings)
        share = required(s.share)[list(of_motors(s, self.motors))]
        more = np.tensordot(share, thrust + slope * (u - m), 1)
        commands = np.concatenate([drive.commands[:1] + more, drive.commands[1:]])
        return replace(drive, commands=commands)


class ThrustCurve(Propellers):
    """The thrust of each propeller is quadratic in its motor command."""

    name = 'thrust_curve'
    signals = ('command', 'throttle', 'motors')
    parameters = (Spec('curvature', '1', spread=0.4),)

    def prepare(self, data: AxisData) -> Settings | str:
        if why := self.lacking(data):
            return why
        throttle = data.training(data.control[:, 0])
        others = [data.training(data.control[:, i + 1]) for i in range(3) if i != data.index]
        mean = float(np.mean(throttle))
        product = float(np.std(others[0] * others[1]))
        command = float(np.std(data.training(data.command)))
        if np.std(throttle) < MOVES * mean and product < MOVES * command:
            return f'the throttle stays at {mean:.2f}; fly with throttle changes'
        return {'throttle': mean}

    def bend(self, m: FloatArray, p: FloatArray,
             settings: Settings) -> tuple[FloatArray, FloatArray]:
        k, beyond = float(p[0]), m - settings['throttle']
        curvature = k / max(1.0 - k + 2.0 * k * settings['throttle'], 1e-3)
        return curvature * beyond**2, 2.0 * curvature * beyond


class MotorCurve(Propellers, Smooth):
    """The slope of thrust over command is a smooth curve, of all motors or of one."""

    name = 'shape:gain:command'
    signals = ('command', 'motors', 'throttle')

    def __init__(self, *motors: int) -> None:
        self.motors = motors
        self.variant = f'smooth, motor {motors[0] + 1}' if motors else 'smooth, motors'
        self.parameters = self.valued(Spec('slope_', '1', spread=0.3))

    def prepare(self, data: AxisData) -> Settings | str:
        if why := self.lacking(data):
            return why
        low, high = np.percentile(data.training(data.motors), [0.5, 99.5])
        return {
            'knots': tuple(np.linspace(low, high, COUNT).tolist()),
            # of all motors the mean slope is the gain; one may be weaker than the others
            'mean': (0.0 if self.motors else 1.0 / COUNT,) * COUNT,
            'throttle': float(np.mean(data.training(data.control[:, 0]))),
        }

    def bend(self, m: FloatArray, p: FloatArray,
             settings: Settings) -> tuple[FloatArray, FloatArray]:
        knots, slopes = settings['knots'], p - float(np.dot(settings['mean'], p))
        width = np.diff(knots)
        bends = 0.5 * np.diff(slopes) / width

        def thrust(m: FloatArray) -> FloatArray:
            inside = np.clip(m, knots[0], knots[-1])
            into = np.stack([
                np.clip(inside - a, 0.0, b) for a, b in zip(knots, width, strict=False)
            ])
            areas = np.tensordot(slopes[:-1], into, 1) + np.tensordot(bends, into**2, 1)
            return areas + np.interp(m, knots, slopes) * (m - inside)

        return thrust(m) - thrust(np.array(settings['throttle'])), np.interp(m, knots, slopes)


class Saturation(Map):
    """Each motor command is limited on one side."""

    def __init__(self, side: str) -> None:
        limit, centre = (np.minimum, 1.0) if side == 'upper' else (np.maximum, 0.0)
        super().__init__(
            'saturation', ('command', 'motors'),
            (Spec(side, '1', spread=0.3, centre=centre, starts=(centre,)),),  # not linear in it
            lambda _, motors, p: limit(motors, p[0]), variant=side,
        )

    def starts(self, data: AxisData, settings: Settings) -> Sequence[FloatArray]:
        motors = data.training(data.motors)
        shares = (99.0, 95.0, 85.0) if self.variant == 'upper' else (1.0, 5.0, 15.0)
        return [np.array([value]) for value in np.percentile(motors, shares)]

    def readable(self, p: FloatArray, settings: Settings) -> dict[str, tuple[float, str]]:
        ends = {'lower': 0.0, 'upper': 1.0} | {self.variant: float(p[0])}
        return {name: (end, '1') for name, end in ends.items()}

    def fitted(self, values: Mapping[str, float], settings: Settings) -> FloatArray:
        return np.array([values[self.variant]])

    def usual(self, p: FloatArray, settings: Settings) -> Mapping[str, float]:
        # in the middle of the motors' limits: as far to either side
        return {'throttle': 0.5 * float(p[0] + (0.0 if self.variant == 'upper' else 1.0))}


def of_motors(s: Signals, motors: Sequence[int]) -> Sequence[int]:
    """These motors; none named: all."""
    return motors or range(len(required(s.motors)))


def differing(s: Signals, drive: Drive, motors: Sequence[int], slow_s: float | None = None,
              factors: tuple[FloatArray, FloatArray] | None = None) -> Drive:
    """Some motors with a lag of their own: channels for these, and one that takes back the usual.

    The first channel, which all other effects act on, stays the command of the axis. factors:
    knots and values (k,), as in Drive.factors.
    """
    indices = list(motors)
    share = drive.row[0] * required(s.share)[indices]
    commands = np.stack([required(s.motors)[i] for i in indices])
    lag = np.repeat(drive.lag[:1], len(indices) + 1, axis=0)
    if slow_s is not None:
        lag[:-1] = slow_s
    curves = [] if factors is None else [np.array([factors] * len(indices))]
    return replace(
        drive,
        commands=np.concatenate(
            [drive.commands, commands, np.tensordot(share, commands, 1)[None]]),
        row=np.r_[drive.row, share, -1.0], lag=np.concatenate([drive.lag, lag]),
        factors=np.concatenate([drive.factors, *curves]),
    )


class Motors(Row):
    """An effect between commands and torque: the law gives the Drive behind it."""

    term = 'response'

    def actuate(self, drive: Drive, s: Signals, p: FloatArray, settings: Settings) -> Drive:
        return self.law(s, drive, p)


def _slow_motor(motor: int) -> Effect:
    return Motors(
        'motor_lag', ('command', 'motors'), (replace(SLOW, starts=(0.07, 0.12, 0.25)),),
        lambda s, drive, p: differing(s, drive, [motor], slow_s=float(p[0])),
        motors=(motor,), variant=f'motor {motor + 1}')


def _shared(drive: Drive, share: float, lag: FloatArray) -> Drive:
    """A share of the axis' command behind a lag (1, n) of its own."""
    return replace(
        drive, commands=np.concatenate([drive.commands, drive.commands[:1]]),
        row=np.r_[drive.row[:1] * (1.0 - share), drive.row[1:], drive.row[:1] * share],
        lag=np.concatenate([drive.lag, lag]),
        factors=np.concatenate([drive.factors, drive.factors[:1]]),
    )


def _slow_share(sign: float) -> Callable[[Signals, Drive, FloatArray], Drive]:
    return lambda _, drive, p: _shared(drive, sign * p[1], np.maximum(p[0], drive.lag[:1]))


def _reaction(_: Signals, drive: Drive, p: FloatArray) -> Drive:
    """Torque T drive' beside the drive; as drive' = (u - drive) / lag, it is a share of u."""
    lag = drive.lag[:1]
    return _shared(drive, float(p[0]) / float(lag[0, 0]), np.full_like(lag, SHORTEST_S))


class HasteCurve(Smooth):
    """The lag of all motors follows how far each has to go, its command less its speed.

    A smooth curve of the logarithm of a factor.
    """

    name = 'shape:lag:direction'
    variant = 'smooth, motors'
    term = 'response'
    signals = ('command', 'direction', 'motors')

    def __init__(self) -> None:
        self.parameters = self.valued(Spec('y', UNITS['lag'], spread=1.0))

    def prepare(self, data: AxisData) -> Settings | str:
        why, usual = self.lacking(data), math.exp(BASE[1].centre)
        step, beyond = step_of(*behind_lag(usual), data.dt), []
        for m in data.motors.T:
            followed(data.stretches, m, *step, x := m[None].copy())
            beyond.append(data.training(m - over_cycle(x[0], m, usual, data.dt)))
        # a motor that is late has further to go than by the usual lag
        return why or placed_around_zero(np.concatenate(beyond), reach=2.0)

    def actuate(self, drive: Drive, s: Signals, p: FloatArray, settings: Settings) -> Drive:
        knots, values = np.array(settings['knots']), p - float(np.dot(settings['mean'], p))
        return differing(s, drive, of_motors(s, ()), factors=(knots, values))


SLOW = Spec('slow_time_constant', 's', spread=0.7, centre=math.log(0.12), log=True,
            starts=(0.09, 0.15, 0.3))
SHARE = Spec('share', '1', spread=0.3, positive=True)
ACTUATORS: tuple[Effect, ...] = (
    *MAPS, BatterySag(), ThrustCurve(), MotorCurve(),
    *(MotorCurve(i) for i in range(MOST_MOTORS)), Saturation('upper'), Saturation('lower'),
    Motors('motor_lag', ('command',), (SLOW, SHARE), _slow_share(1.0)),
    Motors('mode:lead', ('command',), (SLOW, SHARE), _slow_share(-1.0), kind='mode'),
    Motors(
        'mode:rotor_lead', ('command',),
        (Spec('lead_time', 's', spread=1.0, centre=math.log(0.1), log=True,
              starts=(0.03, 0.1, 0.3)),),
        _reaction),  # a law of known physics without a hidden state, for all its name
    *(_slow_motor(i) for i in range(MOST_MOTORS)), HasteCurve(),
)
