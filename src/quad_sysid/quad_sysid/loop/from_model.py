"""From the identified AxisModel to the LoopPlant: each effect becomes a curve or a factor.

One table, `CURVES`; slow motors and a resonance become states, sag, throttle and events factors.
An effect that has no place in one axis' loop (coupling, periodic torque, play) is named in
`not_in_the_loop`. No fitting; the effects' physics stands in effects/table.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.greybox.drive import STEPPED_ADVANCE_S
from quad_sysid.loop.plant import Curve, LightMode, LoopPlant, SlowMotors
from quad_sysid.model import AxisModel, EffectEstimate

STICTION_RATE = 0.01
"""Rate over which dry friction changes its sign, rad/s (effects/table.py)."""
RATE_RANGE = 12.0
"""Half width of the rate tables, rad/s."""
ANGLE_RANGE = 1.6
"""Half width of the angle tables, rad."""
COMMAND_RANGE = 1.0

Function = Callable[[FloatArray], FloatArray]


def _coulomb(p: Mapping[str, float], dt: float) -> Function:
    width = max(STICTION_RATE, abs(p['torque']) * dt)
    return lambda rate: -p['torque'] * np.tanh(rate / width)


def _drag(p: Mapping[str, float], _: float) -> Function:
    return lambda rate: -p['coefficient'] * rate * np.abs(rate)


def _pendulum(p: Mapping[str, float], _: float) -> Function:
    return lambda angle: -p['stiffness'] * np.sin(angle)


def _cubic(p: Mapping[str, float], _: float) -> Function:
    return lambda angle: -p['stiffness'] * angle**3


def _dead_zone(p: Mapping[str, float], _: float) -> Function:
    return lambda u: np.sign(u) * np.maximum(np.abs(u) - p['half_width'], 0.0)


def _saturation(p: Mapping[str, float], _: float) -> Function:
    # the motors' own limits leave this much to either side of a throttle in their middle
    reach = 0.5 * max(0.0, min(p.get('upper', 1.0), 1.0) - max(p.get('lower', 0.0), 0.0))
    return lambda u: np.clip(u, -reach, reach)


CURVES: Mapping[str, tuple[str, Callable[[Mapping[str, float], float], Function]]] = {
    'coulomb_friction': ('rate', _coulomb),
    'quadratic_drag': ('rate', _drag),
    'pendulum_stiffness': ('angle', _pendulum),
    'cubic_stiffness': ('angle', _cubic),
    'dead_zone': ('command', _dead_zone),
    'saturation': ('command', _saturation),
}
"""Effect to the signal it depends on and its curve; parameters as the contract names them."""

FACTORS = ('battery_sag', 'thrust_curve', 'step_event')
"""Effects that scale the gain: with the voltage, with the throttle (the thrust curve's quadratic
part cancels between the motors of an axis), once and for good."""
GAIN_SHAPE = 'shape:gain:'
STATES = ('motor_lag', 'resonance')
"""Effects that add states to the plant."""


def loop_plant(model: AxisModel) -> LoopPlant:
    """The plant that the controller sees at the flight's mean battery voltage.

    Shapes (`shape:rate`, `shape:angle` as torques, `shape:command` added to the command) are taken
    from settings `knots` and `values` where both are there. Raises BadInputError for parameters
    that are not finite.
    """
    tables: dict[str, list[Function]] = {'rate': [], 'angle': [], 'command': []}
    finest = RATE_RANGE / 600.0
    for effect in model.effects:
        parameters = {p.name: p.value for p in effect.parameters}
        entry = CURVES.get(effect.name)
        if entry is not None:
            tables[entry[0]].append(entry[1](parameters, model.dt))
            if effect.name == 'coulomb_friction':
                finest = min(finest, max(STICTION_RATE, abs(parameters['torque']) * model.dt) / 2)
        else:
            shape = _shape(effect)
            if shape is not None:
                tables[effect.name.split(':')[-1]].append(shape)
    stepped = 1.0 + _parameter(model, 'step_event.change')
    advance = STEPPED_ADVANCE_S if model.realisation == 'stepped' else 0.0
    return LoopPlant(
        gain=model.value('gain') * battery_factor(model) * schedule_factor(model) * stepped
        * gain_range(model)[1],
        lag_s=model.value('lag'),
        delay_s=max(0.0, model.value('delay') - advance),
        damping=model.value('damping'),
        bias=model.value('bias') + _parameter(model, 'step_event.torque'),
        gyro_filter_hz=model.gyro_filter_hz,
        dt=model.dt,
        rate_curve=_sum(tables['rate'], RATE_RANGE, finest),
        angle_curve=_sum(tables['angle'], ANGLE_RANGE, 0.01),
        command_curve=_chain(tables['command']),
        slow=_slow_motors(model),
        mode=_mode(model),
    )


def _parameter(model: AxisModel, name: str) -> float:
    """Value of `<effect>.<parameter>`, 0 where the model has no such effect."""
    try:
        return model.value(name)
    except KeyError:
        return 0.0


def _slow_motors(model: AxisModel) -> SlowMotors | None:
    lag = _parameter(model, 'motor_lag.slow_time_constant')
    single = any(e.name == 'motor_lag' and 'motor' in e.settings for e in model.effects)
    share = 0.25 if single else min(max(_parameter(model, 'motor_lag.share'), 0.0), 1.0)
    return SlowMotors(share, lag) if lag > 0.0 else None


def _mode(model: AxisModel) -> LightMode | None:
    frequency = _parameter(model, 'resonance.frequency')
    if frequency <= 0.0:
        return None
    names = ('damping_ratio', 'in_phase', 'quadrature')
    damping, in_phase, quadrature = (_parameter(model, f'resonance.{n}') for n in names)
    return LightMode(2.0 * np.pi * frequency, max(damping, 1e-3), in_phase, quadrature)


def throttle_factor(model: AxisModel, share: float) -> float:
    """What the gain is multiplied by where the throttle is `share` of the flight's mean."""
    for effect in model.effects:
        mean = effect.settings.get('throttle')
        if effect.name == 'thrust_curve' and isinstance(mean, int | float):
            k = model.value('thrust_curve.curvature')
            return float((1.0 - k + 2.0 * k * mean * share) / max(1.0 - k + 2.0 * k * mean, 1e-3))
    return 1.0


def battery_factor(model: AxisModel, battery_v: float | None = None) -> float:
    """What the gain is multiplied by at `battery_v` (None: the flight's mean), 1 without sag."""
    volts = model.mean_battery_v if battery_v is None else battery_v
    for effect in model.effects:
        reference = effect.settings.get('reference_v')
        if effect.name == 'battery_sag' and isinstance(reference, int | float) and volts:
            return float((volts / reference) ** model.value('battery_sag.exponent'))
    return 1.0


def schedule_factor(model: AxisModel, battery_v: float | None = None) -> float:
    """What the firmware multiplies commands by at `battery_v` (None: the flight's mean).

    Its schedule on the voltage (`<axis>.sag.*`); 1 without one.
    """
    volts = model.mean_battery_v if battery_v is None else battery_v
    exponent, reference = (
        model.active_gains.get(f'{model.axis}.sag.{name}', 0.0)
        for name in ('exponent', 'reference_v')
    )
    return float((reference / volts) ** exponent) if volts and reference > 0.0 else 1.0


def gain_range(model: AxisModel) -> tuple[float, float, float]:
    """Least, usual and largest factor of the gain under curves of it (`shape:gain:<signal>`).

    Usual is where a curve of time ends, for other signals its mean; 1, 1, 1 without any.
    """
    low = usual = high = 1.0
    for effect in model.effects:
        values = np.asarray(effect.settings.get('values', ()), dtype=float)
        if effect.name.startswith(GAIN_SHAPE) and values.ndim == 1 and values.size:
            factors = np.maximum(1.0 + values, 0.1)
            low, high = low * float(factors.min()), high * float(factors.max())
            usual *= float(factors[-1] if effect.name.endswith(':time') else factors.mean())
    return low, usual, high


def not_in_the_loop(model: AxisModel) -> tuple[str, ...]:
    """Names of the model's effects that the loop plant leaves out."""
    return tuple(
        effect.name
        for effect in model.effects
        if effect.name not in {*CURVES, *FACTORS, *STATES}
        and not effect.name.startswith(GAIN_SHAPE)
        and _shape(effect) is None
    )


def _shape(effect: EffectEstimate) -> Function | None:
    """A curve of the rate, angle or command that has no name, from its knots."""
    kind, _, signal = effect.name.partition(':')
    knots, values = effect.settings.get('knots'), effect.settings.get('values')
    if kind != 'shape' or signal not in ('rate', 'angle', 'command'):
        return None
    if effect.settings.get('variant') == 'friction':  # acts against the rate
        return None
    x = np.asarray(knots if knots is not None else (), dtype=float)
    y = np.asarray(values if values is not None else (), dtype=float)
    if x.ndim != 1 or x.size < 2 or x.shape != y.shape:
        return None
    if signal == 'command':  # the knots hold the whole map; outside them it goes on beside u
        return lambda u: u + np.interp(u, x, y - x)
    # a torque goes on for half a knot outside, then is held (greybox/kernels.py, curve)
    first, last = 0.5 * (x[1] - x[0]), 0.5 * (x[-1] - x[-2])
    x_wide = np.concatenate(([x[0] - first], x, [x[-1] + last]))
    y_wide = np.concatenate(([1.5 * y[0] - 0.5 * y[1]], y, [1.5 * y[-1] - 0.5 * y[-2]]))
    return lambda at: np.asarray(np.interp(at, x_wide, y_wide))


def _sum(functions: list[Function], half_width: float, step: float) -> Curve | None:
    if not functions:
        return None
    return Curve.sampled(lambda x: np.sum([f(x) for f in functions], axis=0), half_width, step)


def _chain(functions: list[Function]) -> Curve | None:
    """Command curves one after the other, in the model's order."""
    if not functions:
        return None

    def through(u: FloatArray) -> FloatArray:
        for function in functions:
            u = function(u)
        return u

    return Curve.sampled(through, COMMAND_RANGE, 0.0005)
