"""Pictures of what the base lacks: what is left out, the effects, the rivals."""

from __future__ import annotations

import itertools

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.greybox.data import AxisData
from quad_sysid.model import AxisModel
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


def left_out(answer: AxisAnswer) -> Picture | None:
    """What base and completed model leave out, over rate, angle and command."""
    found, model = answer.discovery, answer.model
    if found is None or model is None:
        return None
    data = found.data
    at = missing_torque.variables(data, model.base)
    before, after = _before_after(data, model)
    names = [name for name in missing_torque.UNITS if name in at]
    figure, axes = panels(len(names), height_in=0.8 + 1.6 * len(names), share_x=False)
    figure.subplots_adjust(hspace=0.72)
    drawn = False
    for one, name in zip(axes, names, strict=True):
        for values, colour, label in ((before, BEFORE, 'base'), (after, AFTER, 'completed')):
            if values is None:
                continue
            points = missing_torque.binned(at[name], values, data.train, data.dt)
            if points is None:
                continue
            drawn = True
            one.errorbar(points.x, points.mean, 2.58 * points.spread, color=colour, label=label,
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
        'zero.' + ('' if after is not None else ' No effect was added, so there is no after.'),
        figure,
    )


def _before_after(data: AxisData, model: AxisModel) -> tuple[FloatArray, FloatArray | None]:
    before = missing_torque.left_out(data, model.plain or model.base)
    if not model.effects:
        return before, None
    curves = [c for e in model.effects if (c := missing_torque.curve(e, model)) is not None]
    if len(curves) < len(model.effects):
        return before, None
    return before, missing_torque.left_out(data, model.base, curves)


def effect_shapes(answer: AxisAnswer) -> Picture | None:
    """Each effect's curve over its variable, against what the data say without it."""
    found, model = answer.discovery, answer.model
    if found is None or model is None:
        return None
    curves = [(e, c) for e in model.effects if (c := missing_torque.curve(e, model)) is not None]
    if not curves:
        return None
    data = found.data
    at = missing_torque.variables(data, model.base)
    curves = [(e, c) for e, c in curves if c[0] in at]
    figure, axes = panels(len(curves), height_in=0.9 + 1.9 * len(curves), share_x=False)
    figure.subplots_adjust(hspace=0.62)
    for one, (effect, (name, function)) in zip(axes, curves, strict=True):
        others = [c for e, c in curves if e is not effect]
        alone = missing_torque.left_out(data, model.base, others)
        points = missing_torque.binned(at[name], alone, data.train, data.dt, 25)
        if points is not None:
            one.errorbar(points.x, points.mean, 2.58 * points.spread, color=INK, marker='o',
                         ms=3, lw=0, elinewidth=0.8, capsize=1.5, label='data')
            grid = np.linspace(points.x[0], points.x[-1], 400)
        else:
            low, high = np.nanpercentile(at[name], [1.0, 99.0]).tolist()
            grid = np.linspace(low, high, 400)
        one.plot(grid, function(grid), color=AFTER, lw=1.6, label=effect.name)
        one.axhline(0.0, color=MUTED, lw=0.8)
        where = 'acting command' if name == 'command' else name
        one.set_xlabel(f'{where}, {missing_torque.UNITS[name]}')
        one.set_ylabel('torque / inertia, rad/s²')
        legend(one)
    return Picture(
        'effect_shape', 'The effect against the data',
        'Line: the fitted effect. Points: what the data ask for when the rest of the model stays '
        'and this effect alone is taken out; bars are 99 % of the mean.', figure,
    )


def sag(answer: AxisAnswer) -> Picture | None:
    """The gain over the pack voltage, where the model has a battery sag."""
    found, model = answer.discovery, answer.model
    effect = next((e for e in model.effects if e.name == 'battery_sag'), None) if model else None
    if found is None or model is None or effect is None or found.data.battery_v is None:
        return None
    data, volts = found.data, found.data.battery_v
    curves = [c for e in model.effects if (c := missing_torque.curve(e, model)) is not None]
    rest = missing_torque.left_out(data, model.base, curves)
    command = missing_torque.variables(data, model.base)['command']
    inside = np.concatenate([np.arange(a, b) for a, b in data.train])
    inside = inside[np.isfinite(rest[inside]) & np.isfinite(volts[inside])]
    edges = np.quantile(volts[inside], np.linspace(0.0, 1.0, 9))
    x, y, bars = [], [], []
    for low, high in itertools.pairwise(edges.tolist()):
        own = inside[(volts[inside] >= low) & (volts[inside] <= high)]
        power = float(np.sum(command[own] ** 2)) if own.size else 0.0
        if own.size < 100 or power <= 0.0:
            continue
        slope = float(command[own] @ rest[own]) / power
        spread = float(np.std(rest[own] - slope * command[own]))
        span = max(2.0 * missing_torque.HALF_SPAN_S / data.dt, 1.0)
        x.append(float(np.mean(volts[own])))
        y.append(model.value('gain') + slope)
        bars.append(2.58 * spread * np.sqrt(span / power))
    if len(x) < 3:
        return None
    figure, (one,) = panels(height_in=2.6)
    one.errorbar(x, y, bars, color=INK, marker='o', ms=3, lw=0, elinewidth=0.8, label='data')
    grid = np.linspace(min(x), max(x), 100)
    reference = effect.settings.get('reference_v')
    if isinstance(reference, int | float):
        exponent = model.value('battery_sag.exponent')
        one.plot(grid, model.value('gain') * (grid / reference) ** exponent, color=AFTER,
                 lw=1.6, label='battery_sag')
    one.set_xlabel('pack voltage, V')
    one.set_ylabel('gain, rad/s² per command')
    legend(one)
    return Picture('battery_sag', 'Gain over the pack voltage',
                   'Points: the gain that the data ask for at this voltage, with 99 % bars. Line: '
                   'the fitted power law.', figure)


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
