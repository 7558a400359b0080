"""How a design uses each effect, in words, and how it handles the battery's voltage.

A firmware that offers it multiplies commands by (reference / voltage) ** exponent
(`<axis>.sag.*`), so one set of gains suits all voltages; for another firmware there is a table of
gains by voltage.
quad_sysid.loop and ensemble.py put the effects into the plant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.from_model import Placed, battery_factor, placed
from quad_sysid.model import AxisModel
from quad_tuning.bounds import BOUNDS, STEP_FACTOR, told
from quad_tuning.ensemble import LEAST_PROBABILITY, VOLTAGE_RANGE

EFFECT = 'battery_sag'


def settings(model: AxisModel) -> dict[str, float]:
    """Exponent and reference by the contract's names; empty without sag or such a firmware.

    Commands are not scaled at the reference: the active one, else the flight's mean voltage.
    """
    exponent, reference = (f'{model.axis}.sag.{name}' for name in ('exponent', 'reference_v'))
    mean = model.mean_battery_v
    found = any(effect.name == EFFECT for effect in model.effects)
    if not (found and mean and exponent in model.active_gains and reference in model.active_gains):
        return {}
    bound, volts = BOUNDS['sag.exponent'], BOUNDS['sag.reference_v']
    power = min(max(model.value(f'{EFFECT}.exponent'), bound.lower), bound.upper)
    at = model.active_gains[reference] if model.active_gains[exponent] > 0.0 else mean
    if power == bound.lower or not volts.lower <= at <= volts.upper:
        return {}
    return {exponent: power, reference: at}


def scheduled(model: AxisModel, chosen: Mapping[str, float]) -> AxisModel:
    """The model with the schedule active."""
    return replace(model, active_gains={**model.active_gains, **chosen}) if chosen else model


def along(steps: Sequence[Mapping[str, float]], chosen: Mapping[str, float],
          active: Mapping[str, float]) -> tuple[dict[str, float], ...]:
    """The steps with the schedule, its exponent in each as far as the gate allows."""
    path = [{**step, **chosen} for step in steps]
    name = next((key for key in chosen if key.endswith('sag.exponent')), None)
    if name is None or not path:
        return tuple(path)
    now, wanted, small = active[name], chosen[name], BOUNDS['sag.exponent'].small_step
    k = 0
    while now != wanted:
        low, high = min(now / STEP_FACTOR, now - small), max(now * STEP_FACTOR, now + small)
        now = min(max(wanted, low), high)
        if k == len(path):
            path.append(dict(path[-1]))
        path[k][name] = now
        k += 1
    return tuple(path)


VOLTAGES = 5
"""Rows of the schedule over VOLTAGE_RANGE."""
WORDS: Mapping[str, str] = {
    'rate': 'simulated with it; in the margins by its gain in wide motion and near rest',
    'angle': 'simulated with it; in the margins by its stiffness at large and small angles',
    'command': 'simulated with it; in the margins by its gain for large and small commands',
    'torque': 'simulated with it as a constant torque',
    'throttle': 'margins hold over the throttle of the next flight, 0.85 to 1.15 of the mean',
    'time': 'the plant as it is after the event',
    'battery': 'margins hold over the whole voltage range; the schedule gives gains by voltage',
    'gain': 'margins hold over the whole curve of the gain',
    'response': 'a second lag of the plant, in simulation and margins',
    'mode': 'a mode of the plant, in simulation and margins; a notch is not used',
    'usual': 'the plant with its usual value, in simulation and margins',
}
"""How a design uses an effect, by its place in the loop."""
OUTSIDE = 'left out of the loop; the margins allow for it'
NO_FEED_FORWARD = '; feed-forward would improve the tracking by less than 1 %'


def uses(model: AxisModel) -> tuple[tuple[str, str], ...]:
    """(name, use) of the bias, each effect and each rival that remains possible."""
    out = [('bias_torque', 'simulated with it; the integrator compensates it' + NO_FEED_FORWARD)]
    for effect in model.effects:
        if effect.name == EFFECT and settings(model):
            words = 'the firmware schedules the command on the voltage (sag.exponent)'
        else:
            words = _words(placed(model, effect))
        if effect.name == 'coulomb_friction':
            words += NO_FEED_FORWARD
        out.append((effect.name, words))
        out += [(name, f'rival of {effect.name}: {100 * p:.0f} % of the draws have it instead')
                for name, p in effect.rivals
                if p >= LEAST_PROBABILITY]
    return tuple(out)


def _words(one: Placed) -> str:  # noqa: PLR0911
    """Use of one effect."""
    term, signals = one.effect.term, one.effect.signals
    if not one.inside:
        return OUTSIDE
    if term in ('torque', 'friction', 'damping'):
        return WORDS[next((s for s in ('rate', 'angle', 'command') if s in signals), 'torque')]
    if term == 'gain':
        if one.curve:
            return WORDS['command' if signals[0] == 'command' else 'gain']
        return WORDS[next(s for s in ('battery', 'time') if s in signals)]
    if term == 'command':
        return WORDS['throttle' if 'throttle' in signals else 'command']
    if term == 'response':
        return WORDS['mode' if one.dynamics and one.dynamics.frequency_rad_s else 'response']
    return WORDS['usual']


def schedule(model: AxisModel,
             gains: CascadeGains) -> tuple[tuple[float, Mapping[str, float]], ...]:
    """(battery voltage V, gains): rate gains that keep the loop gain over the voltage.

    For a firmware without a schedule of its own. Empty without battery sag.
    """
    mean = model.mean_battery_v
    if mean is None or all(effect.name != 'battery_sag' for effect in model.effects):
        return ()
    rows = []
    low, high = VOLTAGE_RANGE
    for k in range(VOLTAGES):
        volts = mean * (low + (high - low) * k / (VOLTAGES - 1))
        factor = battery_factor(model) / battery_factor(model, volts)
        row = {}
        for name, value in told(gains, model.axis, model.active_gains).items():
            bound = BOUNDS[name.partition('.')[2]]
            scaled = value * (factor if '.rate.k' in name else 1.0)
            row[name] = min(max(scaled, bound.lower), bound.upper)
        rows.append((float(volts), row))
    return tuple(rows)
