"""The answer in plain words, from the report's tree alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from quad_sysid.axes import units_of
from quad_sysid.errors import p_in_words
from quad_sysid.model.identified import UNLISTED
from quad_sysid.units import in_units_of, with_error

Tree = Mapping[str, Any]

CLEARLY = 2.0
"""Factor by which a model must beat holding the last value to count as useful."""

UNSEEN_PCT = 0.5
"""Change of an error, %, that would be rounded to nothing."""

WORSE = 2.0
"""Factor by which an error on another flight exceeds that on the held-out part of the own one,
as a whole and beside the motion, before the aircraft is questioned: gusts and another battery
rarely double it."""

PLAIN = {
    'ground_effect': 'thrust that grows near the ground',
    'coulomb_friction': 'dry friction', 'quadratic_drag': 'drag that grows with speed squared',
    'pendulum_stiffness': 'a centre of mass off the axis (pendulum)',
    'cubic_stiffness': 'a spring that hardens with the angle',
    'battery_sag': 'thrust that falls with the battery voltage',
    'thrust_curve': 'a curved relation of command and thrust',
    'dead_zone': 'a dead zone of the command',
    'saturation': 'motor limits below the nominal ones', 'motor_lag': 'motors with different lags',
    'gyroscopic_coupling': "gyroscopic coupling to another axis' rate",
    'inertia_coupling': 'coupling to the product of the other rates',
    'cross_axis_input': "another axis' command", 'resonance': 'a lightly damped mode',
    'periodic_disturbance': 'a periodic disturbance', 'step_event': 'a sudden change in flight',
    'shape:lag:direction': 'motors that slow down unlike they speed up',
    'backlash': 'play between command and torque', 'transport_delay': 'a transport delay',
    'viscous_damping': 'viscous damping', 'bias_torque': 'a constant torque',
    UNLISTED: 'a cause that was not compared',
    'mode:second_lag': 'a second lag of the motors', 'mode:lead': 'motors that overshoot',
    'mode:rotor_lead': "a lead by the rotors' own reaction",
    'mode:second_order': 'a damped mode (such as motors under a speed controller)',
    'mode:slow_state': 'a spring on a damper, or a load that relaxes',
    'mode:swinging': 'something that swings', 'mode:hysteresis': 'friction that builds up',
    'mode:loose_load': 'a load with play',
    'mode:soft_mount': 'a mount or an arm whose spring hardens',
    'mode:yielding': 'a part that yields', 'mode:response': 'a late response to the drive',
    'event': 'an event in flight',
}
"""The contract's names of effects in everyday words."""

VERDICTS = {
    'effects_added': ('found', 'Something was missing, and it was found'),
    'no_missing_effect': ('good', 'The plain model suffices'),
    'unexplained_residual': (
        'open', 'Something is left without a name: an effect, or gusts that come and go'),
    'cannot_tell': ('none', 'The data cannot tell'),
    'not_searched': ('none', 'The plain model alone'),
}
"""Verdict → its style and headline."""

FIGURES = {
    'rise_time_s': ('rise time', 's', 1.0), 'overshoot_pct': ('overshoot', '%', 1.0),
    'settling_time_s': ('settling time', 's', 1.0),
    'rms_tracking_rad': ('RMS tracking error', 'deg', 57.29578),
    'disturbance_rms_rad': ('RMS error after a torque step', 'deg', 57.29578),
    'phase_margin_deg': ('phase margin', 'deg', 1.0), 'gain_margin_db': ('gain margin', 'dB', 1.0),
    'peak_sensitivity': ('peak sensitivity', '1', 1.0),
    'worst_phase_margin_deg': ('worst phase margin', 'deg', 1.0),
    'worst_gain_margin_db': ('worst gain margin', 'dB', 1.0),
    'worst_peak_sensitivity': ('worst peak sensitivity', '1', 1.0),
    'worst_peak_complementary': ('worst complementary peak', '1', 1.0),
    'crossover_rad_s': ('crossover', 'rad/s', 1.0), 'bandwidth_rad_s': ('bandwidth', 'rad/s', 1.0),
    'motor_noise_rms': ('RMS noise in the command', 'norm.', 1.0),
    'unstable_draws': ('unstable draws', '1', 1.0),
}
"""A designer's figure → its label, unit and factor into that unit, in order of reading."""


def figure(key: str, axis: str) -> tuple[str, str, float]:
    """Label, unit and factor into it of a designer's figure of an axis."""
    label, unit, factor = FIGURES[key]
    units = units_of(axis)
    if units is None:
        return label, unit, factor
    return in_units_of(units, label), *((units.motion, 1.0) if '_rad' in key and unit == 'deg'
                                        else (unit, factor))


FORMS = {'steps': 'motors that take their command in whole steps',
         'held': 'motors that hold a command for several cycles',
         'shown by the gyro': 'what the gyro shows beside the rate'}
"""A variant → everyday words."""


def named(effect: Tree) -> str:
    """An effect in everyday words, with the signal of a shape spelled out."""
    name, variant = str(effect['name']), str(effect.get('variant', ''))
    kind, *rest = name.replace('_', ' ').split(':')
    if variant in FORMS:
        return FORMS[variant]
    if kind != 'shape' or name in PLAIN:
        return PLAIN.get(name, kind)
    motors = variant.partition(', ')[2]
    if motors:
        return f'a curved thrust of {motors.replace("motors", "the motors")}'
    term = rest[0] if len(rest) == 2 else 'friction' if 'friction' in variant else 'torque'
    if variant.startswith('memory'):
        late = f'follows what the {rest[-1]} has lately been'
        return f'a {term} that {"warms up" if rest[-1] == "time" else late}'
    second = variant.partition('with ')[2]
    suffix = f' and the {second}' if second else ''
    return f'a {term} that depends on the {rest[-1]}{suffix}'


def likeliest(effect: Tree) -> str:
    """The effect in everyday words, or a rival that is more probable."""
    rival = max(effect.get('rivals') or [effect], key=lambda r: r['probability'])
    return named(rival if rival['probability'] > effect['probability'] else effect)


def values(effect: Tree) -> str:
    """The parameters of an effect, or where its curve is."""
    first = effect['parameters'][0]['name'] if effect['parameters'] else ''
    if first == 'y0' and effect['name'] != 'shape:lag:direction':
        return 'a curve, drawn below'
    if 'curve' in effect:
        y, what = effect['curve']['y'], 'slopes' if first == 'slope_0' else 'values'
        return f'{what} {number(min(y))} to {number(max(y))}'
    if len(effect['parameters']) > 6:
        return parameter(effect['parameters'][0]) + '; the others stand in report.json'
    return '; '.join(parameter(p) for p in effect['parameters'])


def number(value: float | None, digits: int = 3) -> str:
    """A number as text, a dash for none; 1380 and not 1.38e+03."""
    return '–' if value is None else f'{float(f"{value:.{digits}g}"):g}'


def yes(value: bool) -> str:
    """`yes` or `no`."""
    return 'yes' if value else 'no'


def chance(p: float | None) -> str:
    """A p-value or probability without false precision."""
    return '–' if p is None else p_in_words(p).removeprefix('= ')


def lowered(percent: float, *, several: bool = False) -> str:
    """Words on the change of the error by one effect or `several`, from the percentage."""
    end = '' if several else 's'
    if abs(percent) < UNSEEN_PCT:
        return f'hardly change{end} the error'
    return f'{"lower" if percent >= 0.0 else "raise"}{end} the error by {abs(percent):.0f} %'


def on_this_flight(tree: Tree) -> str:
    """Words on a stored model's error on another flight; '' where it has no effects and does."""
    names, error = [effect.name for effect in tree['effects']], tree['error']
    before, after, hold = error['before'], error['after'], error['hold_last_value']
    lower_pct, sentences = 100.0 * (1.0 - after / before), []
    if after >= hold:
        sentences.append('On this flight the model predicts no better than holding the last value '
                         f'({number(after)} to {number(hold)} {error["unit"]}).')
    if names:
        sentences.append(f'On this flight {joined(names)} '
                         f'{lowered(lower_pct, several=len(names) > 1)}.')
    if after >= hold or lower_pct <= -UNSEEN_PCT:
        sentences.append('The model does not hold here: is it the same aircraft, as it was?')
    elif (own := error.get('own')) and after > WORSE * own[0] * max(1.0, hold / own[1]):
        sentences.append(f'Its error is {100.0 * after / hold:.0f} % of the motion here and was '
                         f'{100.0 * own[0] / own[1]:.0f} % on the held-out part of its own '
                         'flight: is it the same aircraft, as it was?')
    return ' '.join(sentences)


def headline(tree: Tree) -> tuple[str, str]:
    """Style and headline of the verdict."""
    style, text = VERDICTS.get(tree['verdict'], ('none', tree['verdict']))
    if tree['verdict'] == 'effects_added' and tree['effects']:
        effects = dict.fromkeys(map(likeliest, tree['effects']))
        return style, f'The plain model lacks {joined([*effects])}'
    if tree['verdict'] == 'no_missing_effect' and any(
            rung['answer'] for rung in tree.get('explanation', ())):
        return 'none', 'No missing effect is confirmed'
    return style, text


def story(axis: str, tree: Tree) -> list[tuple[str, str]]:
    """(question, answer) pairs in the order a reader asks."""
    if tree['error'].get('after') is None:
        reason = _bare(axis, tree.get('reason', ''))
        return [('Why?', f'{reason[:1].upper()}{reason[1:]}.')]
    return [('How well does the model predict?', _accuracy(tree)),
            ('What was missing, and how sure is that?', ' '.join(_missing(tree))),
            ('Which gains, and why?', _gains(axis, tree))]


def _accuracy(tree: Tree) -> str:
    error = tree['error']
    after, hold = float(error['after']), error.get('hold_last_value')
    unit = error['unit']
    text = (f'Over half a second of held-out data its free run is off by '
            f'{number(after)} '
            f'{unit} RMS{_interval(error.get("after_interval_95"))}.')
    if tree['verdict'] == 'cannot_tell':  # what a model gains is no merit of the commands then
        return f'{text} This does not show that the commands contribute to it.'
    if hold:
        text += (f' Holding the last value would be off by {number(hold)} {unit}, so the model '
                 f'removes {100.0 * (1.0 - after / hold):.0f} % of that error.')
    text += horizon_words(error)
    if error.get('noise_floor') is not None:
        text += f' The measurement noise alone is about {number(error["noise_floor"])} {unit}.'
    blackbox = error.get('blackbox')
    if blackbox is not None:
        text += f' The selected black-box model is off by {number(blackbox)} {unit}.'
    band = tree.get('trusted_band_rad_s')
    if band:
        text += f' Trust it from {number(band[0], 2)} to {number(band[1])} rad/s.'
    return text


def reach(error: Tree) -> float | None:
    """Longest horizon, s, at which the model at most halves the error of holding the rate."""
    horizons = [
        h['horizon_s'] for h in error.get('horizons', ())
        if h['after'] is not None and h['hold'] is not None
        and CLEARLY * h['after'] <= h['hold']
    ]
    return max(horizons, default=None)


def horizon_words(error: Tree) -> str:
    """The horizon up to which the model is useful, in words."""
    listed = [h for h in error.get('horizons', ()) if h['after'] is not None]
    if not listed:
        return ''
    reach_s = reach(error)
    if reach_s is None:
        best = max(listed, key=lambda h: (h['hold'] or 0.0) / max(h['after'], 1e-12))
        return (
            f' At no horizon does it halve the error of holding the last value; it comes nearest '
            f'{best["horizon_s"]:g} s ahead, off by {number(best["after"])} where holding is off '
            f'by {number(best["hold"])} {error["unit"]}.'
        )
    horizon = next(h for h in listed if h['horizon_s'] == reach_s)
    last = listed[-1]['horizon_s']
    beyond = '' if reach_s == last else f'; further ahead, up to {last:g} s, it predicts less well'
    return (f' It at least halves the error of holding the last value up to {reach_s:g} s ahead '
            f'(off by {number(horizon["after"])} instead of {number(horizon["hold"])} '
            f'{error["unit"]})'
            f'{beyond}.')


def causes(tree: Tree) -> str:
    """A sentence on the missing effects and their share of the error; '' without effects."""
    parts = []
    for effect in tree.get('effects', ()):
        size, of = next(iter(effect['parameters']), None), ''
        if size and size['value'] and effect['kind'] == 'named':
            name, value = size['name'].replace('_', ' '), number(size['value'])
            of = f' ({name} {value})' if size['unit'] == '1' else \
                f' {"at" if name == "time" else "of"} {value} {size["unit"]}'
        for p in effect['parameters']:
            if p['name'] == 'frequency' and not (of and p is size):
                of += f' at {number(p["value"])} Hz'
        words = named(effect)
        verb = 'explain' if words.startswith('motor') else 'explains'  # the motors' own are plural
        parts.append(f'{words}{of} {verb} {effect["explains_pct"]:.0f} %')
    if not parts:
        return ''
    reproducible = tree.get('reproducible', {})
    least = min((reproducible.get(effect['name'], 1.0) for effect in tree['effects']), default=1.0)
    finer = any(rung['effects'] != [e['name'] for e in tree['effects']]
                for rung in tree.get('explanation', ())[-1:])
    text = (f'{joined(parts)} of what the base misses. That is found again in '
            f'{100.0 * least:.0f} % of resampled flights.')
    return text[0].upper() + text[1:] + (' Finer effects explain the rest.' if finer else '')


def _missing(tree: Tree) -> list[str]:
    error = tree['error']
    if tree['verdict'] != 'effects_added':
        return [f'{headline(tree)[1]}: {tree.get("reason", "")}.']
    out = []
    for effect in tree['effects']:
        text = f'{named(effect).capitalize()} ({effect["name"]}): {values(effect)}.'
        text += (f' If it predicted nothing, the held-out data would favour it so much with p '
                 f'{p_in_words(effect["p_value"])}')
        rivals = effect.get('rivals') or []
        if rivals:
            best = max(rivals, key=lambda r: r['probability'])
            text += (f'; among its rivals it has a probability of {effect["probability"]:.2f} '
                     f'(next: {best["name"]}, {best["probability"]:.2f})')
        it = 'It' if len(tree['effects']) == 1 else 'Beside the others it'
        out.append(f'{text}. {it} {lowered(effect["error_reduction_pct"])}.')
    before, after = error.get('before'), error.get('after')
    if before and after is not None:
        raised = len(out) > 1 and all(e['error_reduction_pct'] < 0.0 for e in tree['effects'])
        out.append(
            f'With {"it" if len(out) == 1 else "them together"} the held-out error goes from '
            f'{number(before)}{_interval(error.get("before_interval_95"))} to {number(after)} '
            f'{error["unit"]}{_interval(error.get("after_interval_95"))}: '
            f'{100.0 * abs(1.0 - after / before):.0f} % {"less" if after <= before else "more"}'
            f'{", though none lowers it beside the others" if after < before and raised else ""}.'
        )
    return out


def listed_gains(gains: Mapping[str, float]) -> str:
    """Names and values in a line."""
    return ', '.join(f'{name} {number(value, 4)}' for name, value in gains.items())


def target(tree: Tree) -> Mapping[str, float]:
    """The gains that a design leads to, whose figures it states; `gains` may lie on the way."""
    own: Mapping[str, float] = tree.get('gains') or {}
    steps: Sequence[Mapping[str, float]] = tree.get('gain_steps') or [own]
    return steps[-1]


def _gains(axis: str, tree: Tree) -> str:
    gains = tree.get('gains')
    if not gains:
        because = _bare(axis, tree.get('gains_refused_because') or 'none were designed')
        return f'No new gains: {because}.'
    listed = listed_gains(gains) + (
        '' if target(tree) == gains else f'; then, step by step, {listed_gains(target(tree))}')
    figures = tree.get('gain_figures') or {}
    changes = []
    for key in ('rise_time_s', 'overshoot_pct', 'rms_tracking_rad', 'worst_phase_margin_deg'):
        label, unit, factor = figure(key, axis)
        old, new = figures.get(f'{key}_before'), figures.get(key)
        if old is not None and new is not None:
            changes.append(f'{label} from {number(old * factor)} to {number(new * factor)} {unit}')
    because = f' In simulation with this model: {", ".join(changes)}.' if changes else ''
    return f'{listed}.{because}'


def parameter(p: Tree) -> str:
    """One estimated number with its standard error and unit."""
    torque = p.get('torque')
    more = f' ({torque["value"]:.3g} {torque["unit"]})' if torque else ''
    unit = '' if p['unit'] == '1' else f' {p["unit"]}'
    return f'{p["name"].replace("_", " ")} {estimate(p)}{unit}{more}'


def estimate(p: Tree, *, brief: bool = False) -> str:
    """A value with its standard error, or with what stands in its place; brief: for a table."""
    std, limits = p.get('std'), p.get('interval_95')
    if std is not None:
        return with_error(p['value'], std)
    if brief:
        return f'< {limits[1]:.2g}' if limits else f'{number(p["value"], 4)} ± –'
    below = f'; below {limits[1]:.2g}' if limits else ''
    return f'{number(p["value"], 4)} (no standard error{below})'


def joined(parts: Sequence[str]) -> str:
    """`a, b and c`."""
    return parts[0] if len(parts) == 1 else ', '.join(parts[:-1]) + ' and ' + parts[-1]


def by_reason(reasons: Mapping[str, str]) -> str:
    """Axis → reason, in one line: the axes of one reason together."""
    axes: dict[str, list[str]] = {}
    for axis, reason in reasons.items():
        axes.setdefault(_bare(axis, reason), []).append(axis)
    return '; '.join(f'{", ".join(names)}: {reason}' for reason, names in axes.items())


def _bare(axis: str, reason: str) -> str:
    """A reason without the axis, which the headline names, and without a full stop."""
    return reason.removeprefix(f'{axis}: ').rstrip('.')


def _interval(interval: Sequence[float] | None) -> str:
    return f' (95 %: {number(interval[0])} to {number(interval[1])})' if interval else ''


def left_out(effects: Mapping[str, str]) -> str:
    """Words on the effects that the margins of a design leave out; '' where they have all."""
    reasons = '; '.join(f'{name}, since {why}' for name, why in effects.items())
    return reasons and f'not in the margins: {reasons}'
