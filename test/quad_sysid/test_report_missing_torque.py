"""The implied torque: a planted friction shows in it, and nothing shows where none is planted."""

import numpy as np
import pytest

from quad_sysid.greybox.data import axis_data
from quad_sysid.model import AxisModel, EffectEstimate, Parameter
from quad_sysid.record import Record, Segment
from quad_sysid.report import missing_torque
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
    rest = missing_torque.left_out(axis, BASE, [curve])
    points = missing_torque.binned(axis.rate, rest, axis.train, DT)
    assert np.max(np.abs(points.mean)) < 0.1
    assert curve[0] == 'rate'
    assert curve[1](np.array([-1.0, 1.0])) == pytest.approx([0.6, -0.6], abs=1e-6)


def test_curve_of_a_shape_and_of_the_command():
    x = (-0.1, 0.0, 0.1)
    shape = EffectEstimate('shape:command', 'shape', ('command',), (),
                           {'knots': x, 'values': (-0.12, 0.0, 0.12)})
    name, function = missing_torque.curve(shape, effect(0.1)[1])
    assert name == 'command'
    # the map is 1.2 times the command: it adds 0.2 * gain * u
    assert function(np.array([0.05])) == pytest.approx([0.2 * 0.05 * GAIN])
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
