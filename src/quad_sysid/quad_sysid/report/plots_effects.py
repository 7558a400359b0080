"""Pictures of what the base lacks: what is left out, the effects, the rivals."""

from __future__ import annotations

import itertools

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.greybox.data import AxisData
from quad_sysid.model import EffectEstimate
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.report import missing_torque
from quad_sysid.report.canvas import (
    AFTER,
    BEFORE,
    INK,
    MUTED,
    OTHER,
    Picture,
    legend,
    panels,
)

MOST_RIVALS = 5
Z99 = 2.576


def left_out(answer: AxisAnswer) -> Picture | None:
    """What base and completed model leave out, over rate, angle and command."""
    found, model = answer.discovery, answer.model
    if found is None or model is None:
        return None
    data = found.data
    at = missing_torque.variables(data, model.base)
    runs = [(missing_torque.left_out(data, model.plain or model.base), BEFORE, 'base')]
    added = missing_torque.contributions(found, model)
    if added:
        runs.append((missing_torque.left_out(data, model.base, added), AFTER, 'completed'))
    names = [name for name in missing_torque.UNITS if name in at]
    figure, axes = panels(len(names), height_in=0.8 + 1.6 * len(names), share_x=False)
    figure.subplots_adjust(hspace=0.72)
    drawn = False
    for one, name in zip(axes, names, strict=True):
        for values, colour, label in runs:
            points = missing_torque.binned(at[name], values, data.train, data.dt)
            if points is None:
                continue
            drawn = True
            one.errorbar(points.x, points.mean, Z99 * points.spread, color=colour, label=label,
                         marker='o', ms=3, capsize=1.5, lw=1.0, elinewidth=0.8)
        one.axhline(0.0, color=MUTED, lw=0.8)
        where = 'acting command' if name == 'command' else name
        one.set_xlabel(f'{where}, {missing_torque.UNITS[name]}')
        one.set_ylabel('left out, rad/s²')
    legend(axes[0])
    if not drawn:
        return None
    return Picture(
        'left_out', 'What the model leaves out',
        'Mean angular acceleration that the model does not explain, over rate, angle and command '
        'in the training segments; bars are 99 % of the mean. A model that lacks nothing lies on '
        'zero.' + ('' if model.effects else ' No effect was added, so there is no after.'),
        figure,
    )


def effect_shapes(answer: AxisAnswer) -> Picture | None:
    """Each effect over its variable, against what the data say without it."""
    found, model = answer.discovery, answer.model
    added = missing_torque.contributions(found, model) if found and model else ()
    if found is None or model is None or not added:
        return None
    rest = missing_torque.left_out(found.data, model.base, added)
    figure, axes = panels(len(added), height_in=0.9 + 2.0 * len(added), share_x=False)
    figure.subplots_adjust(hspace=0.75)
    for one, effect, own in zip(axes, model.effects, added, strict=True):
        label, x = _variable(effect, own, found.data)
        points = missing_torque.binned(x, own + rest, found.data.train, found.data.dt, 25)
        line = missing_torque.binned(x, own, found.data.train, found.data.dt, 25)
        if points is not None and line is not None:
            one.errorbar(points.x, points.mean, Z99 * points.spread, color=INK, marker='o',
                         ms=3, lw=0, elinewidth=0.8, capsize=1.5, label='data')
            shape = missing_torque.curve(effect, model)
            grid = np.linspace(points.x[0], points.x[-1], 400)
            one.plot(*((grid, shape[1](grid)) if shape else (line.x, line.mean)),
                     color=AFTER, lw=1.6, label=effect.name)
        one.axhline(0.0, color=MUTED, lw=0.8)
        one.set_xlabel(label)
        one.set_ylabel('torque / inertia, rad/s²')
        legend(one)
    return Picture(
        'effect_shape', 'The effect against the data',
        'Line: the fitted effect. Points: what the data ask for when the rest of the model stays '
        'and this effect alone is taken out; bars are 99 % of the mean.', figure,
    )


def _variable(
    effect: EffectEstimate, own: FloatArray, data: AxisData
) -> tuple[str, FloatArray]:
    """Label and values (n,) of what an effect is drawn over; its own size where nothing fits."""
    time_s = np.asarray(np.arange(data.rate.size) * data.dt, dtype=np.float64)
    values = {p.name: p.value for p in effect.parameters}
    column = effect.settings.get('column', 0.0)
    which = min(int(column), 1) if isinstance(column, int | float) else 0
    turns = 2.0 * np.pi * values.get('frequency', 0.0) * time_s + values.get('phase', 0.0)
    known: dict[str, tuple[str, FloatArray]] = {
        'rate': ('rate, rad/s', data.rate),
        'other rate': (f'rate of {data.other_axes[which]}, rad/s', data.other_rates[:, which]),
        'product of other rates': (
            'product of other rates, (rad/s)²', data.other_rates[:, 0] * data.other_rates[:, 1]
        ),
    }
    if data.angle is not None:
        known['angle'] = 'angle, rad', data.angle
    if {'frequency', 'phase'} <= values.keys():
        known['time'] = 'phase of the disturbance, rad', np.asarray(turns % (2.0 * np.pi))
    elif 'torque' in values:
        known['time'] = 'time, s', time_s
    signal = effect.signals[0] if effect.signals else ''
    return known.get(signal, ('added by the effect, rad/s²', own))


def gain_over(answer: AxisAnswer) -> Picture | None:
    """The gain over voltage or time, where the model says that it depends on one of them."""
    found, model = answer.discovery, answer.model
    if found is None or model is None:
        return None
    data = found.data
    time_s = np.asarray(np.arange(data.rate.size) * data.dt, dtype=np.float64)
    for effect, own in zip(
        model.effects, missing_torque.contributions(found, model), strict=False
    ):
        changes = any(p.name == 'change' for p in effect.parameters)
        if effect.name == 'battery_sag' and data.battery_v is not None:
            label, over = 'pack voltage, V', data.battery_v
        elif effect.name == 'step_event' and changes:
            label, over = 'time, s', time_s
        else:
            continue
        return _gain_picture(answer, own, label, over)
    return None


def _gain_picture(
    answer: AxisAnswer, own: FloatArray, label: str, over: FloatArray
) -> Picture | None:
    """Gain by regression on the acting command in stretches of `over` (n,), data and model."""
    found, model = answer.discovery, answer.model
    if found is None or model is None:
        return None
    data = found.data
    added = missing_torque.contributions(found, model)
    rest = missing_torque.left_out(data, model.base, added)
    command = missing_torque.acting(data, model.base, data.command)
    inside = missing_torque.settled(data.train, data.dt)
    inside = inside[np.isfinite((rest + over + command)[inside])]
    if inside.size < 800 or np.ptp(over[inside]) <= 0.0:
        return None
    gain = model.value('gain')
    rows = []
    for low, high in itertools.pairwise(np.quantile(over[inside], np.linspace(0, 1, 11)).tolist()):
        at = inside[(over[inside] >= low) & (over[inside] <= high)]
        power = float(np.sum(command[at] ** 2))
        if at.size < 100 or power <= 0.0:
            continue
        fitted = gain + float(command[at] @ own[at]) / power
        off = float(command[at] @ rest[at]) / power
        spread = float(np.std(rest[at] - off * command[at]))
        span = max(2.0 * missing_torque.HALF_SPAN_S / data.dt, 1.0)
        bar = Z99 * spread * float(np.sqrt(span / power))
        rows.append((float(np.mean(over[at])), fitted + off, bar, fitted))
    if len(rows) < 3:
        return None
    x, points, bars, fits = (np.array(column) for column in zip(*rows, strict=True))
    figure, (one,) = panels(height_in=2.6)
    one.errorbar(x, points, bars, color=INK, marker='o', ms=3, lw=0, elinewidth=0.8,
                 capsize=1.5, label='data')
    one.plot(x, fits, color=AFTER, lw=1.6, label='model')
    one.set_xlabel(label)
    one.set_ylabel('gain, rad/s² per command')
    legend(one)
    return Picture('gain', 'The gain that changes',
                   'Points: the gain that the data ask for in each stretch, with 99 % bars. '
                   'Line: what the fitted effect says.', figure)


def rivals(answer: AxisAnswer) -> Picture | None:
    """Probability of each effect and of what could stand in its place."""
    model, found = answer.model, answer.discovery
    weighed = found.rivals if found is not None else {}
    lists = []
    for effect in model.effects if model else ():
        others = [r for r in weighed.get(effect.name, effect.rivals) if r[0] != effect.name]
        others.sort(key=lambda rival: -rival[1])
        if others:
            lists.append([(effect.name, effect.probability), *others[:MOST_RIVALS]])
    if not lists:
        return None
    rows = sum(len(one) for one in lists)
    figure, axes = panels(
        len(lists), height_in=0.8 + 0.24 * rows + 0.35 * (len(lists) - 1), left_in=1.6,
        ratios=[len(one) for one in lists],
    )
    for one, entries in zip(axes, lists, strict=True):
        names = [name for name, _ in entries][::-1]
        values = [p for _, p in entries][::-1]
        colours = [OTHER] * (len(entries) - 1) + [AFTER]
        one.barh(names, values, color=colours, height=0.62)
        for at, value in enumerate(values):
            one.text(value + 0.012, at, f'{value:.2f}', va='center', fontsize=8)
        one.set_xlim(0.0, 1.1)
        one.grid(visible=False, axis='y')
        one.set_ylabel('explanation')
    axes[-1].set_xlabel('probability, 1')
    return Picture(
        'rivals', 'Rival explanations',
        'Blue: what was chosen. Green: what could stand in its place, each refitted; the '
        'probabilities of one panel sum to 1 over all rivals.', figure,
    )
