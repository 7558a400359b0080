"""From the identified AxisModel to the LoopPlant: the effects' physics as tables and memories.

An effect's `torque` over rate, angle or command gives curves, factors, damping and bias; its
`command` a curve of the command; its `actuate`, for a small step, shares of the drive with their
lags. What remembers is a linear memory: as it is, or as it answers to motion of the amplitudes at
which the loop is judged. `not_in_the_loop` names the effects that one axis' loop cannot hold.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
from scipy.linalg import logm

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.effects.hidden import Linear
from quad_sysid.effects.hidden import Memory as Warming
from quad_sysid.effects.maps import Following
from quad_sysid.estimate.stored import fitted_of, part_of
from quad_sysid.loop.plant import SHORTEST_LAG_S, Curve, LoopPlant, Memory, SlowMotors
from quad_sysid.model import AxisModel, EffectEstimate
from quad_sysid.model.effect import SMALL, Drive, Effect, Part, Signals, required

RATE_RANGE = 12.0
"""Half width of the rate tables, rad/s."""
ANGLE_RANGE = 1.6
"""Half width of the angle tables, rad."""
COMMAND_RANGE = 1.0
STEPS = {'rate': (0.02, 0.005), 'angle': (0.01,), 'command': (0.0005,)}
"""Steps of the tables; the later one where the first does not resolve a curve."""
RESOLVED = 1e-3
"""Largest error of interpolation, as a share of the curve."""
LINEAR = 1e-9
LATE_S = 1e9
"""A time after all events of the flight: the next flight begins there."""
HERE = {'rate', 'angle', 'command', 'throttle', 'battery', 'time', 'motors', 'history',
        'direction'}
"""Signals that one axis' loop contains or holds constant."""
OTHER_AXES, BY_ITSELF = 'it depends on the other axes', 'it changes by itself'
WIDE, NEAR_REST = (4.0, 0.35, 0.3), (0.3, 0.05, 0.03)
"""Amplitudes of rate (rad/s), angle (rad) and command at which a loop is linearised."""
TONES = (0.41, 1.0, 2.17)
"""Frequencies of the motion that a memory sees meanwhile, over rate / angle."""
SWINGS = 4
"""Number of swings of the slowest of them."""
SLOW_HZ = 10.0
"""What repeats itself slower than this is no vibration to a loop: its worst case counts."""
FEW_STATES = 2
"""Up to so many, a memory is linearised along a motion."""
SMALL_STEP = 0.02
"""Step of the command for the motors' shares."""

Function = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Placed:
    """An effect of a model with its parameters (p,), as on the next flight."""

    part: Part
    p: FloatArray

    @property
    def effect(self) -> Effect:
        """Its physics."""
        return self.part.effect

    @property
    def why_outside(self) -> str:
        """Why one axis' loop cannot hold it; '' where it does."""
        effect = self.effect
        if not set(effect.signals) <= HERE:
            return OTHER_AXES
        if effect.phased and effect.term == 'torque':
            return 'it is a disturbance, whatever the loop does'
        if effect.wanders and effect.term != 'gain':
            return BY_ITSELF
        return ''

    @property
    def remembers(self) -> bool:
        """Whether it has a memory that moves in a loop."""
        return bool(self.effect.states) and 'history' in self.effect.signals

    @property
    def curve(self) -> bool:
        """Whether it is a curve over knots."""
        return 'knots' in self.part.settings

    def signals(self, at: Mapping[str, float], n: int = 1, **moved: Any) -> Signals:
        """Signals (n,) at the usual values `at`, all but `moved` at rest."""
        usual = {'time': np.full(n, LATE_S), 'throttle': np.full(n, at['throttle']),
                 'battery_v': np.full(n, at['battery']), 'sent': np.zeros(n)}
        return Signals.at_rest(**(usual | moved))

    def torque(self, at: Mapping[str, float], n: int = 1, **moved: FloatArray) -> FloatArray:
        """(n,) acceleration, rad/s², at the usual values `at`, all signals but `moved` at rest.

        What it remembers is settled.
        """
        s, settings = self.signals(at, n, **moved), self.part.settings
        if self.effect.states:
            s = replace(s, hidden=self.effect.settled(s, self.p, settings))
        own = self.effect.torque(s, self.p, settings)
        return np.zeros(n) if own is None else np.broadcast_to(own, (n,))

    def factor(self, at: Mapping[str, float], **moved: FloatArray) -> FloatArray:
        """Factor on the drive in small motion."""
        n = max((x.size for x in moved.values()), default=1)
        with_drive = self.torque(at, n, drive=np.ones(n), **moved)
        out: FloatArray = 1.0 + with_drive - self.torque(at, n, **moved)
        return out


def placed(model: AxisModel, effect: EffectEstimate) -> Placed:
    """An effect of a model. Raises BadInputError for one that this version does not know."""
    part = part_of(model, effect)
    return Placed(part, fitted_of(part, effect))


def _inside(model: AxisModel) -> list[Placed]:
    return [one for one in (placed(model, e) for e in model.effects) if not one.why_outside]


def _usual(model: AxisModel, effects: list[Placed]) -> dict[str, float]:
    """Throttle and battery voltage (V) at which the loop is judged: the flight's means.

    Where the model does not know them, those at which its effects count as usual.
    """
    at = {'throttle': 0.5, 'battery': 1.0}
    for one in reversed(effects):
        at |= one.effect.usual(one.p, one.part.settings)
    known = {'throttle': model.mean_throttle, 'battery': model.mean_battery_v}
    return at | {name: value for name, value in known.items() if value is not None}


def usual_signals(model: AxisModel) -> dict[str, float]:
    """Throttle (`throttle`) and voltage (`battery`, V) at which a model counts as flown."""
    return _usual(model, [placed(model, effect) for effect in model.effects])


def loop_plant(model: AxisModel, level: tuple[float, float, float] = WIDE) -> LoopPlant:
    """The plant that the controller sees at the flight's mean battery voltage.

    What remembers is linear, as it answers to motion of the amplitudes `level`. Raises
    BadInputError for effects that are not known and parameters that are not finite.
    """
    effects = _inside(model)
    at = _usual(model, effects)
    gain, bias, damping = model.value('gain'), model.value('bias'), model.value('damping')
    pushing = [one for one in effects if not one.effect.moves_command]
    beside = [memory for one in pushing if one.remembers
              for memory in _beside(model, one, at, level)]
    delay = model.value('delay') + sum(
        one.effect.longest_s(one.p) for one in effects if one.effect.phased and one.p[0] < SLOW_HZ
    )
    tables: dict[str, list[Function]] = {'rate': [], 'angle': [], 'command': []}
    factor = schedule_factor(model)
    for one in pushing:
        effect = one.effect
        if one.remembers or effect.wanders or effect.phased:  # the last two are in gain_range
            continue
        rest = float(one.torque(at)[0])
        bias += rest
        delay -= float(one.torque(at, change=np.ones(1))[0]) - rest
        if effect.term == 'damping':
            damping -= float(one.torque(at, rate=np.ones(1))[0]) - rest
        elif 'rate' in effect.signals and effect.term != 'gain':
            tables['rate'].append(_over('rate', one, at))
        if 'angle' in effect.signals and effect.term == 'torque':
            tables['angle'].append(_over('angle', one, at))
        if effect.term in ('torque', 'gain') and 'command' in effect.signals:
            passed = _passed(one, at, gain or 1.0)
            slope = float(passed(np.ones(1))[0])
            u = np.linspace(-COMMAND_RANGE, COMMAND_RANGE, 41)
            if np.max(np.abs(passed(u) - slope * u)) < LINEAR * (1.0 + abs(slope)):
                factor *= slope
            else:
                tables['command'].append(passed)
    mapped = _mapped(model, effects, at)
    if mapped is not None:
        tables['command'].insert(0, mapped)
    share, lag, slow_motors = _drive(model, effects, at, level[2])
    before = [_before(model, one, at, level[2]) for one in effects
              if one.effect.moves_command and one.remembers]
    return LoopPlant(gain=gain * factor * share, lag_s=lag, delay_s=max(0.0, delay),
                     damping=damping, bias=bias, gyro_filter_hz=model.gyro_filter_hz, dt=model.dt,
                     rate_curve=_sum(tables['rate'], RATE_RANGE, STEPS['rate']),
                     angle_curve=_sum(tables['angle'], ANGLE_RANGE, STEPS['angle']),
                     command_curve=_chain(tables['command']), slow=slow_motors,
                     before=tuple(before), beside=tuple(beside))


def _beside(model: AxisModel, one: Placed, at: Mapping[str, float],
            level: tuple[float, float, float]) -> list[Memory]:
    """A torque with a memory as a linear one of rate, angle and drive, at these amplitudes.

    What it remembers and gives along a motion of some tones, by least squares: for sines that is
    its describing function, and what is linear stays as it is. A response of many states, which
    is linear, is so by small steps.
    """
    effect, p, settings, dt = one.effect, one.p, one.part.settings, model.dt
    m, gain = effect.states, model.value('gain') or 1.0
    if isinstance(effect, Warming) and not effect.leans:  # what is warm stays so in a loop
        return []

    def seen(rate: FloatArray, angle: FloatArray, drive: FloatArray) -> Signals:
        command = drive / gain
        wrench = np.zeros((rate.size, 4))
        wrench[:, 0], wrench[:, AXES.index(model.axis) + 1] = at['throttle'], command
        return one.signals(at, rate.size, rate=rate, angle=angle, drive=drive, command=drive,
                           lagged=command, sent=command, dt=dt, lag=model.value('lag'),
                           motors=tuple(model.craft.commands(wrench).T), share=_share(model))

    hover = np.full((_share(model).size, 1), at['throttle'])
    start = one.signals(at, 1, dt=dt, motors=tuple(hover))
    rest = effect.settled(start, p, settings)[:, 0]

    def after(x: FloatArray, s: Signals) -> FloatArray:
        """(n, m + 1) the states a cycle later, and the torque meanwhile."""
        torque = required(effect.torque(replace(s, hidden=x), p, settings))
        return np.column_stack([effect.advance(x, s, p, settings).T, torque])

    steps = SMALL * np.eye(m + 3)
    still = after(rest[:, None], seen(*np.zeros((3, 1))))
    slopes = (after(rest[:, None] + steps[:, :m].T, seen(*steps[:, m:].T)) - still) / SMALL
    if m <= FEW_STATES:
        w = level[0] / level[1]
        t = dt * np.arange(max(64, math.ceil(SWINGS * 2.0 * np.pi / (w * TONES[0] * dt))))
        phases = np.outer(t, w * np.array(TONES))
        size = 1.0 / math.sqrt(len(TONES))
        angle = level[1] * size * np.sin(phases).sum(axis=1)
        rate = level[0] * size * (np.cos(phases) * TONES).sum(axis=1)
        drive = gain * level[2] * size * np.sin(1.13 * phases + 1.0).sum(axis=1)
        s = seen(rate, angle, drive)
        begun = np.repeat(rest[:, None], t.size, axis=1)
        x = effect.trace(s, p, settings, ((0, t.size),), begun)[:m]
        known = np.column_stack([(x - rest[:, None]).T, rate, angle, drive, np.ones(t.size)])
        sizes = np.maximum(np.linalg.norm(known, axis=0), 1e-300)
        moved = np.linalg.lstsq(known / sizes, after(x, s), rcond=None)[0][:-1] / sizes[:-1, None]
        first = m if isinstance(effect, Linear) else 0  # whose states are linear as they are
        slopes[:, first:] = moved[:, first:]
    return [_continuous(slopes[:m, :m].T, slopes[m:, :m].T, slopes[:m, m], slopes[m:, m], dt)]


def _continuous(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, dt: float) -> Memory:
    """The memory whose step over `dt` s is a (m, m), b (m, inputs)."""
    m, k = b.shape
    block = np.eye(m + k)
    block[:m, :m], block[:m, m:] = a, b
    values = np.linalg.eigvals(a)
    if m and np.all((np.abs(values.imag) > 0.0) | (values.real > 1e-6)):
        slope = np.real(logm(block)) / dt
        return Memory(slope[:m, :m], slope[:m, m:], c, d)
    back = np.linalg.inv(a + (1.0 + 1e-9) * np.eye(m))  # where no such step exists: trapezoidal
    return Memory(np.asarray(2.0 / dt * (a - np.eye(m)) @ back, dtype=np.float64),
                  np.asarray(2.0 / dt * back @ b, dtype=np.float64), c, d)


def _before(model: AxisModel, one: Placed, at: Mapping[str, float], size: float) -> Memory:
    """A memory in the way of the command as a linear one, at this amplitude of the command."""
    effect, p, settings, dt = one.effect, one.p, one.part.settings, model.dt
    if isinstance(effect, Following):
        a, b = effect.system(p, dt)
        c, direct = effect.output(p)
        return Memory(a, b[:, None], c, np.array([direct]))
    phases = np.outer(np.arange(2000) * dt, 2.0 * np.pi * np.array((0.43, 1.0, 2.3)))
    u = size / math.sqrt(3.0) * np.sin(phases).sum(axis=1)
    s = commanded(model, at, u)
    s = replace(s, hidden=effect.trace(s, p, settings, ((0, u.size),)))
    out = effect.command(s, p, settings)
    (keep, into), *_ = np.linalg.lstsq(np.column_stack([out[:-1], u[1:]]), out[1:], rcond=None)
    keep = float(np.clip(keep, 1e-6, 1.0 - 1e-6))
    pole = math.log(keep) / dt
    return Memory(np.array([[pole]]), np.array([[-pole * into / (1.0 - keep)]]), np.ones(1),
                  np.zeros(1))


def _over(signal: str, one: Placed, at: Mapping[str, float]) -> Function:
    """Its torque over rate or angle, relative to rest."""
    return lambda x: one.torque(at, x.size, **{signal: x}) - one.torque(at)


def _passed(one: Placed, at: Mapping[str, float], gain: float) -> Function:
    """Command plus an effect's torque of command or drive, expressed as a command."""

    def through(u: FloatArray) -> FloatArray:
        pushed = one.torque(at, u.size, drive=gain * u, command=gain * u, lagged=u)
        return np.asarray(u + (pushed - one.torque(at)) / gain)

    return through


def _share(model: AxisModel) -> FloatArray:
    return np.asarray(model.craft.inverse[AXES.index(model.axis) + 1])


def commanded(model: AxisModel, at: Mapping[str, float], command: FloatArray) -> Signals:
    """What acts before the torque sees of commands (n,) at the usual throttle."""
    n = command.size
    wrench = np.zeros((n, 4))
    wrench[:, 0], wrench[:, AXES.index(model.axis) + 1] = at['throttle'], command
    return Signals.at_rest(
        np.full(n, LATE_S), np.full(n, at['throttle']), battery_v=np.full(n, at['battery']),
        motors=tuple(model.craft.commands(wrench).T), sent=command, share=_share(model),
        lag=max(model.value('lag'), SHORTEST_LAG_S), delay=model.value('delay'), dt=model.dt,
    )


def _settled(one: Placed, s: Signals) -> Signals:
    """The same with what an effect remembers of a command that has long been given."""
    if not one.effect.states:
        return s
    return replace(s, hidden=one.effect.begin(s, one.p, one.part.settings))


def _mapped(model: AxisModel, effects: list[Placed], at: Mapping[str, float]) -> Function | None:
    """Map of the command on its way to the motors; None where it does not change."""
    maps = [
        one for one in effects
        if type(one.effect).command is not Effect.command and not one.remembers
    ]
    if not maps:
        return None

    def through(u: FloatArray) -> FloatArray:
        s = commanded(model, at, u)
        if any('motors' in one.effect.signals for one in maps):  # which stop at 0 and 1
            s = replace(s, sent=np.tensordot(_share(model), np.stack(required(s.motors)), 1))
        for one in maps:
            own = _settled(one, s)
            s = replace(s, sent=one.effect.command(own, one.p, one.part.settings))
        return required(s.sent)

    return through


def _drive(model: AxisModel, effects: list[Placed], at: Mapping[str, float],
           size: float = SMALL_STEP) -> tuple[float, float, tuple[SlowMotors, ...]]:
    """Factor on the gain in small motion, lag (s), and motors with another lag.

    size: of the command, over which a lag that follows how far a motor has to go counts with its
    largest value.
    """
    s = commanded(model, at, np.array([-SMALL_STEP, SMALL_STEP]))
    drive = Drive(required(s.sent)[None], np.ones(1), np.full((1, 2), model.value('lag')))
    for one in effects:
        drive = one.effect.actuate(drive, _settled(one, s), one.p, one.part.settings)
    weights = drive.row * (drive.commands[:, 1] - drive.commands[:, 0]) / (2.0 * SMALL_STEP)
    longer = [float(np.max(np.interp(np.linspace(-size, size, 41), *curve)))
              for curve in drive.factors]
    lags, whole = np.mean(drive.lag, axis=1) * np.exp(longer), float(np.sum(weights))
    usual = float(lags[int(np.argmax(np.abs(weights)))])
    slow = []
    for lag in np.unique(lags[np.abs(lags - usual) > LINEAR]):
        part = float(np.sum(weights[lags == lag]))
        if abs(part) > LINEAR:
            slow.append(SlowMotors(part / whole, float(lag)))
    return whole, usual, tuple(slow)


def throttle_factor(model: AxisModel, share: float) -> float:
    """Factor on the gain where the throttle is `share` times the flight's mean."""
    effects = [one for one in _inside(model) if not one.curve]
    at = _usual(model, effects)
    moved = {**at, 'throttle': share * at['throttle']}
    return _drive(model, effects, moved)[0] / _drive(model, effects, at)[0]


def battery_factor(model: AxisModel, battery_v: float | None = None) -> float:
    """Factor on the gain at `battery_v` (V; None: the flight's mean); 1 without sag."""
    effects = [one for one in _inside(model) if not one.curve and 'battery' in one.effect.signals]
    at = _usual(model, effects) | ({'battery': battery_v} if battery_v else {})
    return float(np.prod([one.factor(at)[0] for one in effects]))


def schedule_factor(model: AxisModel, battery_v: float | None = None) -> float:
    """The firmware's factor on commands at `battery_v` (V; None: the flight's mean).

    From its schedule on the voltage (`<axis>.sag.*`); 1 without one.
    """
    volts = model.mean_battery_v if battery_v is None else battery_v
    exponent, reference = (model.active_gains.get(f'{model.axis}.sag.{name}', 0.0)
                           for name in ('exponent', 'reference_v'))
    return float((reference / volts) ** exponent) if volts and reference > 0.0 else 1.0


def gain_range(model: AxisModel) -> tuple[float, float, float]:
    """Least, usual and largest factor on the gain by its curves; 1, 1, 1 without any.

    Also by what it remembers, from cold on, and by what swings or wanders. Curves over the command
    are left out: the loop simulates them.
    """
    low = usual = high = 1.0
    effects = _inside(model)
    at = _usual(model, effects)
    for one in effects:
        signal, effect = one.effect.signals[0], one.effect
        if effect.term != 'gain' or effect.moves_command:
            continue
        now = float(one.factor(at)[0])
        if effect.phased:
            size = float(np.hypot(*one.p[1:3]))
            factors = np.array([1.0 - size, 1.0 + size])
        elif effect.wanders:
            size = 2.0 * float(one.p[0]) * float(one.part.settings['unit'])
            factors = np.array([1.0 - size, 1.0 + size])
        elif isinstance(effect, Warming):
            factors = effect.factors(one.p, one.part.settings)
        elif one.curve and signal != 'command':
            field = {'battery': 'battery_v'}.get(signal, signal)
            knots = np.array(one.part.settings['knots'], dtype=float)
            factors = one.factor(at, **{field: knots})
        else:
            continue
        factors = np.maximum(factors, 0.1)
        low, high = low * float(factors.min()), high * float(factors.max())
        usual *= now
    return low, usual, high


def not_in_the_loop(model: AxisModel) -> dict[str, str]:
    """The effects that the loop of one axis leaves out, and why."""
    found = ((e.name, placed(model, e).why_outside) for e in model.effects)
    return {name: why for name, why in found if why}


def share_outside(model: AxisModel) -> dict[str, float]:
    """Of those that depend on more than disturbances, the largest acceleration over the drive's.

    Both over the signals' ranges in the training; none where the model does not know these.
    """
    out: dict[str, float] = {}
    gain, command = model.value('gain'), np.abs(model.ranges.get('command', (0.0, 0.0))).max()
    at = usual_signals(model)
    for found in model.effects:
        one = placed(model, found)
        if one.why_outside not in (OTHER_AXES, BY_ITSELF) or not gain * command > 0.0:
            continue
        moved: dict[str, Any] = {}
        for name, field in (('other rate', 'other_rates'), ('other angle', 'other_angles'),
                            ('other command', 'other_commands')):
            ends = [np.array(model.ranges.get(f'{name} {i}', (0.0, 0.0))) for i in (1, 2)]
            moved[field] = tuple(np.meshgrid(*ends)[i].ravel() for i in (0, 1))
        rate = np.repeat(np.abs(model.ranges.get('rate', (0.0, 0.0))).max(), 4)
        s = one.signals(at, 4, rate=rate, drive=np.repeat(gain * command, 4), **moved)
        if one.effect.wanders:
            s = replace(s, hidden=np.full((1, 4), 2.0 * float(one.p[0])))
        elif one.effect.states:
            continue
        pushed = one.effect.torque(s, one.p, one.part.settings)
        if pushed is None:
            pushed = gain * one.effect.command(s, one.p, one.part.settings)
        out[found.name] = float(np.abs(pushed).max() / (gain * command))
    return out


def _sum(functions: list[Function], half_width: float, steps: tuple[float, ...]) -> Curve | None:
    if not functions:
        return None
    step = next((s for s in steps[:-1] if all(_resolves(f, half_width, s) for f in functions)),
                steps[-1])
    return Curve.sampled(lambda x: np.sum([f(x) for f in functions], axis=0), half_width, step)


def _resolves(function: Function, half_width: float, step: float) -> bool:
    """Whether a table of that step interpolates the function well enough."""
    x = np.arange(-half_width, half_width, step)
    y, between = function(x), function(x[:-1] + 0.5 * step)
    away = np.max(np.abs(between - 0.5 * (y[1:] + y[:-1])), initial=0.0)
    return bool(away <= RESOLVED * np.max(np.abs(y), initial=0.0))


def _chain(functions: list[Function]) -> Curve | None:
    """Command curves one after the other, in the model's order."""
    if not functions:
        return None
    return Curve.sampled(lambda u: reduce(lambda x, function: function(x), functions, u),
                         COMMAND_RANGE, STEPS['command'][0])
