"""Pictures of what the base lacks: what is left out, the effects, the rivals."""

from __future__ import annotations

from quad_sysid.axes import units_of
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.pipeline.constants import Z99
from quad_sysid.report import canvas, missing_torque
from quad_sysid.report.canvas import Picture
from quad_sysid.report.plots_models import runs
from quad_sysid.units import scale

VARIABLES = ('rate', 'angle', 'command')


def left_out(answer: AxisAnswer) -> Picture | None:
    """Acceleration that base and completed model leave out, over rate, angle and command."""
    findings = answer.findings
    if findings is None:
        return None
    problem = findings.problem
    variables = missing_torque.variables(missing_torque.Replay(problem, findings.after.fit))
    names = [name for name in VARIABLES if name in variables]
    figure, axes = canvas.panels(len(names), height_in=0.8 + 1.6 * len(names), share_x=False,
                          spacing=0.72)
    drawn, torque = False, scale(answer.units, 'left out', 'rad/s²')
    over = {name: scale(answer.units, 'acting command' if name == 'command' else name,
                        missing_torque.OVER[name][1]) for name in names}
    for held_out, colour, _, label in runs(findings):
        values = missing_torque.Replay(problem, held_out.fit).left_out()
        for panel, name in zip(axes, names, strict=True):
            points = missing_torque.binned(variables[name], values, problem.spans, problem.data.dt)
            if points is None:
                continue
            drawn = True
            panel.errorbar(over[name](points.x), torque(points.mean), Z99 * torque(points.spread),
                           color=colour, label=label, marker='o', ms=3, capsize=1.5, lw=1.0,
                           elinewidth=0.8)
    for panel, name in zip(axes, names, strict=True):
        panel.axhline(0.0, color=canvas.MUTED, lw=0.8)
        panel.set_xlabel(over[name].label)
        panel.set_ylabel(torque.label)
    canvas.legend(axes[0])
    if not drawn:
        return None
    return Picture(
        'left_out', 'What the model leaves out',
        'Mean angular acceleration that the model does not explain, over rate, angle and command '
        'in the training segments; bars are 99 % of the mean. A model that lacks nothing lies on '
        'zero.' + ('' if findings.added else ' No effect was added: there is no after.'), figure,
    )


def effect_shapes(answer: AxisAnswer) -> Picture | None:
    """Each effect that is a curve, with its band, against what the data say without it."""
    findings = answer.findings
    parts = [] if findings is None or not findings.added else [
        (index, part) for index, part in enumerate(findings.after.fit.structure.parts)
        if missing_torque.is_curve(part)
    ]
    if findings is None or not parts:
        return None
    replay = missing_torque.Replay(findings.problem, findings.after.fit)
    rest = replay.left_out()
    figure, axes = canvas.panels(len(parts), height_in=0.9 + 2.0 * len(parts), share_x=False,
                          spacing=0.75)
    for panel, (index, part) in zip(axes, parts, strict=True):
        shape = missing_torque.drawn(replay, index)
        units = answer.units if shape.axis == answer.axis else units_of(shape.axis)
        x, y = scale(units, *shape.over), scale(answer.units, *shape.label)
        weights = missing_torque.weight(replay, part)
        if weights is not None:
            points = missing_torque.binned(missing_torque.over(replay, part).values,
                                           replay.added(index) + rest, findings.problem.spans,
                                           findings.data.dt, 25, weights)
            if points is not None:
                panel.errorbar(x(points.x), y(points.mean), Z99 * y(points.spread), lw=0, ms=3,
                               color=canvas.INK, marker='o', elinewidth=0.8, capsize=1.5,
                               label='data')
        if shape.plain is not None:
            panel.plot(x(shape.x), y(shape.plain), color=canvas.BEFORE, ls='--', lw=1.0,
                       label='base')
        panel.fill_between(x(shape.x), y(shape.y - shape.band), y(shape.y + shape.band),
                           color=canvas.AFTER, alpha=0.25, lw=0)
        panel.plot(x(shape.x), y(shape.y), color=canvas.AFTER, lw=1.6, label=part.effect.name)
        if shape.plain is None:
            panel.axhline(0.0, color=canvas.MUTED, lw=0.8)
        panel.set_xlabel(x.label)
        panel.set_ylabel(y.label)
        canvas.legend(panel)
    return Picture(
        'effect_shape', 'The effect against the data',
        'Line: the fitted effect, its band 95 %. Points, where a single number can be read off '
        'the data: what they require when this effect alone is removed and the rest of the model '
        'stays; bars are 99 % of the mean. Beside a jump they lie nearer to zero than the line: '
        'the measured rate is noisy and filtered, so both sides of the jump mix there.', figure,
    )


def rivals(answer: AxisAnswer) -> Picture | None:
    """Probability of each effect and of what could stand in its place."""
    lists = []
    for effect in answer.model.effects if answer.model else ():
        others = sorted(effect.rivals, key=lambda rival: -rival[1])
        if others:
            lists.append([(effect.name, effect.probability), *others[:5]])
    if not lists:
        return None
    rows = sum(len(entries) for entries in lists)
    figure, axes = canvas.panels(len(lists), height_in=0.8 + 0.24 * rows + 0.35 * (len(lists) - 1),
                          left_in=1.6, ratios=[len(entries) for entries in lists])
    for panel, entries in zip(axes, lists, strict=True):
        names = [name for name, _ in entries][::-1]
        values = [p for _, p in entries][::-1]
        colours = [canvas.OTHER] * (len(entries) - 1) + [canvas.AFTER]
        panel.barh(names, values, color=colours, height=0.62)
        for row, value in enumerate(values):
            panel.text(value + 0.012, row, f'{value:.2f}', va='center', fontsize=8)
        panel.set_xlim(0.0, 1.1)
        panel.grid(visible=False, axis='y')
        panel.set_ylabel('explanation')
    axes[-1].set_xlabel('probability, 1')
    return Picture(
        'rivals', 'Rival explanations',
        'Blue: the chosen effect. Green: its alternatives, each fitted in its place; the '
        'probabilities of one panel sum to 1 over all rivals.', figure,
    )


DRAWINGS = (
    canvas.Drawing('effect_shape', 'What the base lacks', effect_shapes),
    canvas.Drawing('left_out', 'What the base lacks', left_out),
    canvas.Drawing('rivals', 'What the base lacks', rivals),
)
