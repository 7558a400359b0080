"""The implied torque: a planted friction shows in it, and nothing shows where none is planted."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from quad_sysid.effects.table import EFFECTS
from quad_sysid.greybox.data import axis_data
from quad_sysid.greybox.fit import simulator
from quad_sysid.greybox.structure import Structure
from quad_sysid.model import AxisModel, EffectEstimate, Parameter
from quad_sysid.record import Record, Segment
from quad_sysid.report import missing_torque, plots_effects
from quad_sysid.report.canvas import MOST_POINTS, thinned

DT, GAIN, LAG, DELAY_CYCLES, DAMPING, BIAS = 0.004, 100.0, 0.03, 2, 0.7, 0.2
BASE = (
    Parameter('gain', GAIN, 1.0, ''), Parameter('lag', LAG, 0.001, 's'),
    Parameter('delay', DELAY_CYCLES * DT, 0.001, 's'), Parameter('damping', DAMPING, 0.1, '1/s'),
    Parameter('bias', BIAS, 0.1, 'rad/s²'),
)


def data(friction: float):
    """20 s of a slow multisine through the base with dry friction, fine steps, 3 mrad/s noise."""
    rng = np.random.default_rng(5)
    n = round(20.0 / DT)
    t = np.arange(n) * DT
    command = 0.02 * sum(np.sin(2 * np.pi * f * t + f) for f in (0.4, 0.9, 1.7))
    rate, drive = 0.0, 0.0
    rates = np.zeros(n)
    for k in range(n):
        rates[k] = rate
        acting = command[max(k - DELAY_CYCLES, 0)]
        for _ in range(20):
            h = DT / 20
            drive += h * (GAIN * acting - drive) / LAG
            rate += h * (drive - DAMPING * rate + BIAS - friction * np.tanh(rate / 0.01))
    rates += 0.003 * rng.standard_normal(n)
    zero = np.zeros(n)
    record = Record(
        source='x', dt=DT, rates=np.stack([rates, zero, zero], axis=1),
        control=np.stack([zero, command, zero, zero], axis=1),
        segments=(Segment('train', 'multisine', 'roll', 'control', 0.0, 20.0),),
    )
    return axis_data([record], 'roll')


def effect(torque: float) -> tuple[EffectEstimate, AxisModel]:
    one = EffectEstimate('coulomb_friction', 'named', ('rate',),
                         (Parameter('torque', torque, 0.01, 'rad/s²'),))
    return one, AxisModel('roll', DT, None, BASE, (one,))


@pytest.mark.parametrize('friction', [0.0, 0.6])
def test_planted_friction_shows_over_the_rate(friction):
    axis = data(friction)
    points = missing_torque.binned(axis.rate, missing_torque.left_out(axis, BASE), axis.train, DT)
    away = np.abs(points.x) > 0.3
    assert away.sum() >= 6
    expected = -friction * np.sign(points.x[away])
    # 4 standard errors, and 0.03 rad/s² for the simulation's own steps
    assert np.all(np.abs(points.mean[away] - expected) < 4.0 * points.spread[away] + 0.03)


def test_effect_taken_along_leaves_nothing():
    axis = data(0.6)
    one, model = effect(0.6)
    curve = missing_torque.curve(one, model)
    friction = curve[1](axis.rate)
    rest = missing_torque.left_out(axis, BASE, [friction])
    points = missing_torque.binned(axis.rate, rest, axis.train, DT)
    assert np.max(np.abs(points.mean)) < 0.1
    assert curve[0] == 'rate'
    assert curve[1](np.array([-1.0, 1.0])) == pytest.approx([0.6, -0.6], abs=1e-6)


def test_curve_of_a_shape_and_of_what_is_no_curve():
    shape = EffectEstimate('shape:angle', 'shape', ('angle',), (),
                           {'knots': (-0.1, 0.0, 0.1), 'values': (-2.0, 0.0, 1.0)})
    name, function = missing_torque.curve(shape, effect(0.1)[1])
    assert name == 'angle'
    assert function(np.array([-0.05, 0.05])) == pytest.approx([-1.0, 0.5])
    event = EffectEstimate('step_event', 'event', (), ())
    assert missing_torque.curve(event, effect(0.1)[1]) is None


def test_too_little_data_gives_no_points():
    axis = data(0.0)
    rest = missing_torque.left_out(axis, BASE)
    assert missing_torque.binned(axis.rate, rest, (), DT) is None
    assert missing_torque.binned(axis.rate, rest, ((0, 100),), DT) is None
    assert missing_torque.binned(np.zeros(axis.rate.size), rest, axis.train, DT) is None


def test_thinned_line_keeps_extremes_and_gaps():
    n = 50_000
    signal = np.sin(np.arange(n) * 0.01)
    signal[12_345], signal[30_000:40_000] = 7.0, np.nan
    time_s, values = thinned(np.arange(n) * DT, signal)
    assert values.size <= MOST_POINTS + 2
    assert np.nanmax(values) == 7.0
    assert time_s[np.nanargmax(values)] == pytest.approx(12_345 * DT)
    assert np.isnan(values).any()
    assert np.all(np.diff(time_s) >= 0.0)


def answered(axis, name: str, theta, settings=None):
    """What the pictures need of an answer whose model is BASE and one effect of the table."""
    entry = next(e for e in EFFECTS if e.name == name)
    structure = Structure().with_effect(entry, settings or {})
    theta = np.array([p.value for p in BASE] + list(theta))
    estimate = EffectEstimate(
        name, entry.kind, entry.signals,
        tuple(Parameter(p.name, v, 0.1, p.unit)
              for p, v in zip(entry.parameters, theta[5:], strict=True)),
        settings=settings or {},
    )
    found = SimpleNamespace(
        data=axis, chosen=SimpleNamespace(structure=structure, theta=theta),
        chosen_simulator=simulator(axis, axis.train, np.zeros(4)), rivals={},
    )
    return SimpleNamespace(
        discovery=found, model=AxisModel('roll', DT, None, BASE, (estimate,))
    )


def test_contribution_of_a_command_effect_is_what_it_takes_away():
    axis = data(0.0)
    answer = answered(axis, 'dead_zone', [0.01])
    (own,) = missing_torque.contributions(answer.discovery, answer.model)
    command = axis.command
    cut = np.sign(command) * np.maximum(np.abs(command) - 0.01, 0.0)
    expected = GAIN * missing_torque.acting(axis, BASE, cut - command)
    inside = np.isfinite(own)
    assert inside.mean() > 0.99
    np.testing.assert_allclose(own[inside], expected[inside], atol=1e-9)
    assert missing_torque.contributions(
        answer.discovery, AxisModel('roll', DT, None, BASE)
    ) == ()


@pytest.mark.parametrize(
    ('name', 'theta', 'settings', 'label'),
    [
        ('coulomb_friction', [0.6], {}, 'rate, rad/s'),
        ('dead_zone', [0.004], {}, 'added by the effect, rad/s²'),
        ('periodic_disturbance', [0.5, 1.3, 0.2], {}, 'phase of the disturbance, rad'),
        ('gyroscopic_coupling', [0.5], {'column': 1.0}, 'rate of yaw, rad/s'),
    ],
)
def test_every_kind_of_effect_is_drawn_over_its_own_variable(name, theta, settings, label):
    axis = data(0.6)
    rng = np.random.default_rng(1)
    axis = dataclasses.replace(axis, other_rates=rng.standard_normal((axis.rate.size, 2)))
    answer = answered(axis, name, theta, settings)
    picture = plots_effects.effect_shapes(answer)
    assert picture.labels == ((label, 'torque / inertia, rad/s²'),)
    assert len(picture.figure.axes[0].lines) >= 2
    assert len(plots_effects.left_out(answer).figure.axes[0].containers) == 2


def test_gain_over_the_voltage_is_the_fitted_power_law():
    axis = data(0.0)
    volts = np.linspace(16.0, 14.0, axis.rate.size)
    axis = dataclasses.replace(axis, battery_v=volts)
    answer = answered(axis, 'battery_sag', [2.0], {'reference_v': 15.0})
    (panel,) = plots_effects.gain_over(answer).figure.axes
    line = next(one for one in panel.lines if one.get_label() == 'model')
    x, y = line.get_data()
    np.testing.assert_allclose(y, GAIN * (x / 15.0) ** 2, rtol=0.01)
    points = panel.containers[0].lines[0].get_ydata()
    # the data were made without sag: they ask for one gain, in 2 %
    np.testing.assert_allclose(points, GAIN, rtol=0.02)
