"""From the identified AxisModel to the LoopPlant: the effects' physics as tables.

An effect's `torque` over rate, angle or command gives curves, factors, damping and bias; its
`command` a curve of the command; its `actuate`, for a small step, shares of the drive with their
lags; its `dynamics` a second lag or a mode. `not_in_the_loop` names the effects that one axis'
loop cannot hold: those of other axes, of a phase, or of a nonlinear past.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from quad_sysid.contract import AXES, FloatArray
from quad_sysid.estimate.stored import fitted_of, part_of
from quad_sysid.loop.plant import Curve, LightMode, LoopPlant, SlowMotors
from quad_sysid.model import AxisModel, EffectEstimate
from quad_sysid.model.data import AxisData
from quad_sysid.model.effect import Drive, Dynamics, Effect, Part, Signals

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
HERE = {'rate', 'angle', 'command', 'throttle', 'battery', 'time', 'motors', 'history'}
"""Signals that one axis' loop contains or holds constant."""
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
    def dynamics(self) -> Dynamics | None:
        """Linear dynamics of an effect with memory, else None."""
        return self.effect.dynamics(self.p)

    @property
    def inside(self) -> bool:
        """Whether one axis' loop can hold it."""
        signals = set(self.effect.signals)
        remembered = 'history' not in signals or self.dynamics is not None
        return signals <= HERE and remembered and not self.effect.phased

    @property
    def curve(self) -> bool:
        """Whether it is a curve over knots."""
        return 'knots' in self.part.settings

    def torque(self, at: Mapping[str, float], n: int = 1, **moved: FloatArray) -> FloatArray:
        """(n,) acceleration, rad/s², at the usual values `at`, all signals but `moved` at rest."""
        rest = np.zeros(n)
        signals: dict[str, Any] = {
            'rate': rest, 'angle': rest, 'drive': rest, 'command': rest, 'change': rest,
            'lagged': rest, 'time': np.full(n, LATE_S), 'throttle': np.full(n, at['throttle']),
            'battery_v': np.full(n, at['battery']), 'other_rates': (rest, rest),
            'other_commands': (rest, rest), 'other_angles': (rest, rest),
        } | moved
        own = self.effect.torque(Signals(**signals), self.p, self.part.settings)
        return rest if own is None else np.broadcast_to(own, (n,))

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
    return [one for one in (placed(model, e) for e in model.effects) if one.inside]


def _usual(model: AxisModel, effects: list[Placed]) -> dict[str, float]:
    """Throttle and battery voltage (V) at which the loop is judged."""
    at = {'throttle': 0.5, 'battery': 1.0}
    for one in reversed(effects):
        at |= one.effect.usual(one.p, one.part.settings)
    return at | ({'battery': model.mean_battery_v} if model.mean_battery_v else {})


def loop_plant(model: AxisModel) -> LoopPlant:
    """The plant that the controller sees at the flight's mean battery voltage.

    Raises BadInputError for effects that are not known and parameters that are not finite.
    """
    effects = _inside(model)
    at = _usual(model, effects)
    gain, bias, damping = model.value('gain'), model.value('bias'), model.value('damping')
    delay = model.value('delay')
    tables: dict[str, list[Function]] = {'rate': [], 'angle': [], 'command': []}
    factor = schedule_factor(model)
    for one in effects:
        rest = float(one.torque(at)[0])
        bias += rest
        delay -= float(one.torque(at, change=np.ones(1))[0]) - rest
        if one.effect.term == 'damping':
            damping -= float(one.torque(at, rate=np.ones(1))[0]) - rest
        elif 'rate' in one.effect.signals and one.effect.term != 'gain':
            tables['rate'].append(_over('rate', one, at))
        if 'angle' in one.effect.signals and one.effect.term == 'torque':
            tables['angle'].append(_over('angle', one, at))
        if one.effect.term in ('torque', 'gain') and 'command' in one.effect.signals:
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
    share, lag, slow, mode = _drive(model, effects, at)
    return LoopPlant(gain=gain * factor * share, lag_s=lag, delay_s=max(0.0, delay),
                     damping=damping, bias=bias, gyro_filter_hz=model.gyro_filter_hz, dt=model.dt,
                     rate_curve=_sum(tables['rate'], RATE_RANGE, STEPS['rate']),
                     angle_curve=_sum(tables['angle'], ANGLE_RANGE, STEPS['angle']),
                     command_curve=_chain(tables['command']), slow=slow, mode=mode)


def _over(signal: str, one: Placed, at: Mapping[str, float]) -> Function:
    """Its torque over rate or angle, relative to rest."""
    return lambda x: one.torque(at, x.size, **{signal: x}) - one.torque(at)


def _passed(one: Placed, at: Mapping[str, float], gain: float) -> Function:
    """Command plus an effect's torque of command or drive, expressed as a command."""

    def through(u: FloatArray) -> FloatArray:
        pushed = one.torque(at, u.size, drive=gain * u, command=gain * u, lagged=u)
        return np.asarray(u + (pushed - one.torque(at)) / gain)

    return through


def _flown(model: AxisModel, at: Mapping[str, float], command: FloatArray) -> AxisData:
    """AxisData of n commands at the usual throttle, each a stretch by itself."""
    n, index = command.size, AXES.index(model.axis)
    control = np.zeros((n, 4))
    control[:, 0], control[:, index + 1] = at['throttle'], command
    motors = model.craft.commands(control)
    nothing = np.zeros(n)
    return AxisData(axis=model.axis, dt=model.dt, rate=nothing, angle=nothing, control=control,
                    motors=motors, other_rates=np.zeros((n, 2)),
                    battery_v=np.full(n, at['battery']), gyro_filter_hz=model.gyro_filter_hz,
                    craft=model.craft, stretches=tuple((i, i + 1) for i in range(n)),
                    train=((0, n),), validation=())


def _mapped(model: AxisModel, effects: list[Placed], at: Mapping[str, float]) -> Function | None:
    """Map of the command on its way to the motors; None where it does not change."""
    maps = [
        one for one in effects
        if type(one.effect).command is not Effect.command and one.dynamics is None
    ]
    if not maps:
        return None

    def through(u: FloatArray) -> FloatArray:
        data = _flown(model, at, u)
        if any('motors' in one.effect.signals for one in maps):  # which stop at 0 and 1
            u = data.motors @ data.share
        for one in maps:
            u = one.effect.command(data, u, one.p, one.part.settings)
        return u

    return through


def _drive(model: AxisModel, effects: list[Placed],
           at: Mapping[str, float]) -> tuple[float, float, SlowMotors | None, LightMode | None]:
    """Factor on the gain in small motion, lag (s), motors with another lag, and a mode."""
    data = _flown(model, at, np.array([-SMALL_STEP, SMALL_STEP]))
    lag = np.full((1, 2), model.value('lag'))
    drive = Drive(data.command[None, :], np.ones(1), lag)
    for one in effects:
        drive = one.effect.actuate(data, drive, one.p, one.part.settings)
    weights = drive.row * (drive.commands[:, 1] - drive.commands[:, 0]) / (2.0 * SMALL_STEP)
    lags, whole = np.mean(drive.lag, axis=1), float(np.sum(weights))
    usual = float(lags[int(np.argmax(np.abs(weights)))])
    others = np.abs(lags - usual) > LINEAR
    part = float(np.sum(weights[others]))
    slow = None
    if abs(part) > LINEAR:
        slow = SlowMotors(part / whole, float(np.sum((weights * lags)[others])) / part)
    mode = None
    for found in (one.dynamics for one in effects):
        if found is None:
            continue
        if found.frequency_rad_s > 0.0 and mode is None:
            mode = LightMode(found.frequency_rad_s, max(found.damping_ratio, 1e-3), found.in_phase,
                             found.quadrature)
        elif found.lag_s > 0.0 and slow is None:
            # partial fractions of two lags in series
            second = found.lag_s if abs(found.lag_s / usual - 1.0) > 1e-3 else 1.001 * usual
            slow = SlowMotors(second / (second - usual), second)
        else:
            usual += found.lag_s
    return whole, usual, slow, mode


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

    Curves over the command are left out: the loop simulates them.
    """
    low = usual = high = 1.0
    effects = _inside(model)
    at = _usual(model, effects)
    for one in effects:
        signal = one.effect.signals[0]
        if one.curve and one.effect.term == 'gain' and signal != 'command':
            field = {'battery': 'battery_v'}.get(signal, signal)
            knots = np.array(one.part.settings['knots'], dtype=float)
            factors = np.maximum(one.factor(at, **{field: knots}), 0.1)
            low, high = low * float(factors.min()), high * float(factors.max())
            usual *= float(one.factor(at)[0])
    return low, usual, high


def not_in_the_loop(model: AxisModel) -> tuple[str, ...]:
    """Names of the effects that the loop plant leaves out."""
    return tuple(e.name for e in model.effects if not placed(model, e).inside)


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
