"""The table of effects: each map and torque against its equation by other means (scipy, by hand).

Friction, drag and the two springs are held against an ODE solver in test_pipeline_greybox.py.
"""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import linalg, signal
from scipy.integrate import solve_ivp

from quad_sysid.contract import MIXER, MIXER_INVERSE
from quad_sysid.effects import commands, curves, torques
from quad_sysid.effects.probes import probes_of
from quad_sysid.effects.shapes import SHAPES
from quad_sysid.effects.table import EFFECTS, by_name
from quad_sysid.greybox.data import AxisData, Windows
from quad_sysid.greybox.fit import fit_base, fit_structure
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Structure

DT = 0.004
ALL = EFFECTS + SHAPES
BASE = np.array([450.0, 0.042, 0.0, 0.4, 0.2])
each = pytest.mark.parametrize('effect', ALL, ids=lambda e: f'{e.name} {e.variant}'.strip())


def entry(name: str, variant: str = ''):
    return next(e for e in ALL if e.name == name and e.variant == variant)


def axis_of(command, axis='roll', **fields) -> AxisData:
    """Half a throttle, one axis' command, all else at rest; trained on the whole."""
    n = np.size(command)
    control = np.zeros((n, 4))
    control[:, 0] = 0.5
    control[:, ('roll', 'pitch', 'yaw').index(axis) + 1] = command
    given = {
        'rate': np.zeros(n), 'angle': np.zeros(n), 'control': control,
        'motors': control @ MIXER.T, 'other_rates': np.zeros((n, 2)), 'battery_v': None,
        'gyro_filter_hz': None, 'stretches': ((0, n),), 'train': ((0, n),), 'validation': (),
    }
    return AxisData(axis=axis, dt=DT, **{**given, **fields})


def moving(axis='roll', n=1500, seed=0) -> AxisData:
    """Everything that an effect may need moves: U1..U4, all rates, angle, voltage."""
    rng = np.random.default_rng(seed)
    smooth = signal.lfilter([0.1], [1.0, -0.98], rng.standard_normal((n, 8)), axis=0)
    control = np.array([0.45, 0.0, 0.0, 0.0]) + np.array([0.1, 0.15, 0.15, 0.1]) * smooth[:, :4]
    return axis_of(
        np.zeros(n), axis, control=control, motors=control @ MIXER.T, rate=2.0 * smooth[:, 4],
        angle=0.3 * smooth[:, 5], other_rates=2.0 * smooth[:, 6:],
        battery_v=np.linspace(12.4, 11.0, n),
    )


def mapped(effect, data, parameters, settings=None):
    return effect.command(data, data.command, np.array(parameters), settings or {}, BASE)


# the table itself

UNITS = {
    'coulomb_friction.torque': 'rad/s²', 'periodic_disturbance.amplitude': 'rad/s²',
    'quadratic_drag.coefficient': 'rad/s² per (rad/s)²',
    'pendulum_stiffness.stiffness': 'rad/s² per rad',
    'cubic_stiffness.stiffness': 'rad/s² per rad³', 'gyroscopic_coupling.coefficient': '1/s',
    'inertia_coupling.coefficient': '1', 'cross_axis_input.fraction': '1',
    'battery_sag.exponent': '1', 'thrust_curve.curvature': '1', 'step_event.change': '1',
    'dead_zone.half_width': '1', 'backlash.half_width': '1', 'saturation.lower': '1',
    'saturation.upper': '1', 'motor_lag.slow_time_constant': 's', 'step_event.time': 's',
    'resonance.frequency': 'Hz', 'periodic_disturbance.frequency': 'Hz',
}  # fmt: skip
"""What the contract promises, by effect and parameter (a normalised command is a pure number)."""


def test_the_contracts_names_stand_in_the_table_with_its_units():
    found = {f'{e.name}.{p.name}': p.unit for e in EFFECTS for p in e.parameters}
    assert {key: found.get(key) for key in UNITS} == UNITS
    assert {e.name for e in EFFECTS} == {key.split('.')[0] for key in UNITS}


def test_name_and_variant_are_unique():
    keys = [(e.name, e.variant) for e in ALL]
    assert len(set(keys)) == len(keys)
    kinds = {e.name: e.kind for e in ALL}
    assert all(e.kind == kinds[e.name] for e in ALL)


def test_by_name_gives_the_first_and_refuses_what_is_not_there():
    assert by_name('step_event').variant == 'gain'
    with pytest.raises(KeyError):
        by_name('mode')


@pytest.fixture(scope='module')
def moved():
    """Data where everything moves, a simulator over them and a base as if it had been fitted."""
    data = moving()
    sim = Simulator(data, data.train, data.windows(data.train), np.zeros(4))
    return data, sim, fit_structure(sim, Structure(), BASE, max_iterations=1)


@each
def test_each_entry_is_complete(effect):
    """Words for people, one kind of action, signals, and starts inside the bounds."""
    assert effect.physics.strip()
    assert effect.excite.strip()
    assert effect.signals
    assert effect.command is not None or effect.torque is not None
    assert effect.kind in {'named', 'shape', 'mode', 'event'}
    names = [p.name for p in effect.parameters]
    assert len(set(names)) == len(names) > 0
    for spec in effect.parameters:
        assert spec.unit
        assert spec.scale > 0.0
        assert spec.lower < spec.upper
        assert spec.starts
        assert all(spec.lower <= start <= spec.upper for start in spec.starts)


@each
def test_each_entry_can_be_prepared_started_and_run(effect, moved):
    """On data where everything moves: settings, starts, a finite run.

    A start that changes nothing would leave the fit without a slope, so away from it (by a
    tenth of a scale per parameter) the errors must move.
    """
    data, sim, fit = moved
    settings = effect.prepare(data) if effect.prepare else {}
    assert not isinstance(settings, str)
    lower = np.array([p.lower for p in effect.parameters])
    upper = np.array([p.upper for p in effect.parameters])
    starts = [tuple(p.starts[0] for p in effect.parameters)]
    if effect.starts:
        starts = list(effect.starts(sim, fit, effect))
        assert starts
    for start in starts:
        assert len(start) == len(effect.parameters)
        assert np.isfinite(start).all()
    structure = Structure().with_effect(effect, settings)
    scale = np.array([p.scale for p in effect.parameters])
    plain = sim.run(Structure(), BASE).errors
    theta = np.clip(np.array(starts[0]) + 0.1 * scale, lower, upper)
    errors = sim.run(structure, np.r_[BASE, theta]).errors
    assert np.isfinite(errors).all()
    assert np.abs(errors - plain).max() > 1e-9


# what happens to the command


def test_held_step_is_the_exponential():
    """Ten random systems, slow to stiff: 1e-11 of scipy's expm."""
    rng = np.random.default_rng(2)
    for size in np.logspace(-2, 3, 10):
        a, b = size * rng.standard_normal((2, 2)) - size * np.eye(2), rng.standard_normal(2)
        block = linalg.expm(np.block([[a, b[:, None]], [np.zeros((1, 3))]]) * DT)
        step, drive = commands.held_step(a, b, DT)
        np.testing.assert_allclose(step, block[:2, :2], rtol=0, atol=1e-11)
        np.testing.assert_allclose(drive, block[:2, 2], rtol=0, atol=1e-11)


def test_dead_zone_by_hand():
    data = axis_of([-0.03, -0.01, -0.004, 0.0, 0.01, 0.02])
    out = mapped(by_name('dead_zone'), data, [0.01])
    np.testing.assert_allclose(out, [-0.02, 0.0, 0.0, 0.0, 0.0, 0.01], atol=1e-15)


def test_play_by_hand():
    """Up, back within the play, further back, up again; play of +-1."""
    data = axis_of([0.0, 3.0, 2.0, 1.5, 0.5, -2.0, -1.5, 1.0])
    out = mapped(by_name('backlash'), data, [1.0])
    np.testing.assert_allclose(out, [0.0, 2.0, 2.0, 2.0, 1.5, -1.0, -1.0, 0.0])


def test_play_has_its_defining_properties_and_starts_anew_after_a_gap():
    """Never further than w from the command, and moving only where it is pushed."""
    u = np.cumsum(np.random.default_rng(4).standard_normal(2000)) * 0.001
    data = axis_of(u, stretches=((0, 900), (1000, 2000)))
    w = 0.004
    out = mapped(by_name('backlash'), data, [w])
    for start, stop in data.stretches:
        x, y = u[start:stop], out[start:stop]
        assert y[0] == x[0]
        assert np.all(np.abs(x - y) <= w + 1e-15)
        moved = np.diff(y)
        pushed = np.abs(np.abs(x - y)[1:] - w) < 1e-12
        assert np.all(pushed[moved != 0.0])
        assert np.all((moved * np.diff(x))[moved != 0.0] > 0.0)
        assert 0.05 < np.mean(moved != 0.0) < 0.9


@pytest.mark.parametrize('axis', ['roll', 'pitch', 'yaw'])
@pytest.mark.parametrize('k', [-0.4, 0.7])
def test_thrust_curve_is_the_motors_curve_behind_the_mixer(axis, k):
    """(1 - k) m + k m² of each motor, back through the mixer, by the slope at mean throttle."""
    data = moving(axis)
    effect = by_name('thrust_curve')
    settings = effect.prepare(data)
    m = data.motors
    thrust = ((1.0 - k) * m + k * m**2) @ MIXER_INVERSE.T
    mean = float(np.mean(data.control[:, 0]))
    expected = thrust[:, data.index + 1] / (1.0 - k + 2.0 * k * mean)
    np.testing.assert_allclose(mapped(effect, data, [k], settings), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize('axis', ['roll', 'pitch', 'yaw'])
def test_saturation_is_the_motors_clip_behind_the_mixer(axis):
    data = moving(axis)
    out = mapped(by_name('saturation'), data, [0.35, 0.55])
    expected = (np.clip(data.motors, 0.35, 0.55) @ MIXER_INVERSE.T)[:, data.index + 1]
    np.testing.assert_allclose(out, expected, rtol=0, atol=1e-14)
    assert np.abs(out - data.command).max() > 0.01
    low, high = float(data.motors.min()), float(data.motors.max())
    np.testing.assert_array_equal(mapped(by_name('saturation'), data, [low, high]), data.command)


def test_battery_sag_follows_the_voltage():
    """Twice the reference voltage to the power 2 is four times the command."""
    data = axis_of(np.full(3, 0.01), battery_v=np.array([6.0, 12.0, 24.0]))
    out = mapped(by_name('battery_sag'), data, [2.0], {'reference_v': 12.0})
    np.testing.assert_allclose(out, [0.0025, 0.01, 0.04])


@pytest.mark.parametrize(('axis', 'which', 'column'), [
    ('roll', 0, 2), ('roll', 1, 3), ('pitch', 0, 1), ('pitch', 1, 3), ('yaw', 0, 1), ('yaw', 1, 2),
])  # fmt: skip
def test_cross_axis_adds_the_other_axis_command(axis, which, column):
    data = moving(axis)
    effect = entry('cross_axis_input', f'other axis {which + 1}')
    out = mapped(effect, data, [0.3], effect.prepare(data))
    np.testing.assert_allclose(out, data.command + 0.3 * data.control[:, column], atol=1e-15)


def test_a_gain_steps_in_the_middle_of_a_cycle():
    """From 10.25 cycles on 1.5 times: the tenth cycle has three quarters of it."""
    data = axis_of(np.full(20, 0.01))
    out = mapped(entry('step_event', 'gain'), data, [10.25 * DT, 0.5])
    np.testing.assert_allclose(out[:10], 0.01)
    assert out[10] == pytest.approx(0.01 * 1.375)
    np.testing.assert_allclose(out[11:], 0.015)


SLOW, SHARE = 0.2, 0.25


def test_slow_motors_step_as_two_lags_side_by_side():
    """Behind the common lag: 1 - (1 - share) exp(-t/lag) - share exp(-t/slow), within 2e-4.

    What is left is the command held at its mean over each cycle: (dt / lag)² / 24.
    """
    u = np.r_[np.zeros(5), np.ones(1000)]
    out = mapped(by_name('motor_lag'), axis_of(u), [SLOW, SHARE])
    keep = math.exp(-DT / BASE[1])
    found = signal.lfilter([0.0, 1.0 - keep], [1.0, -keep], out)
    t = np.arange(-5, 1000) * DT
    expected = 1.0 - (1.0 - SHARE) * np.exp(-t / BASE[1]) - SHARE * np.exp(-t / SLOW)
    np.testing.assert_allclose(found[5:], expected[5:], rtol=0, atol=2e-4)
    assert np.ptp(out[6:]) > 0.1


def test_slow_motors_leave_the_standing_gain():
    """A constant command passes unchanged from the first sample on, also after a gap."""
    data = axis_of(np.r_[np.full(50, 0.02), np.full(50, -0.01)], stretches=((0, 50), (50, 100)))
    np.testing.assert_allclose(
        mapped(by_name('motor_lag'), data, [SLOW, SHARE]), data.command, rtol=1e-13
    )


def test_resonance_is_the_modes_exact_answer_at_half_a_cycle():
    """z'' + 2 d w z' + w² z = w² u by scipy's zero-order hold at half the cycle: 1e-11."""
    rng = np.random.default_rng(7)
    u = np.repeat(rng.choice([-0.02, 0.02], 80), 10)
    f, d, a, b = 6.0, 0.05, 0.3, -0.2
    w = 2.0 * math.pi * f
    system = (
        np.array([[0.0, 1.0], [-(w**2), -2.0 * d * w]]), np.array([[0.0], [w**2]]),
        np.array([[a, b / w]]), np.zeros((1, 1)),
    )
    half = signal.cont2discrete(system, 0.5 * DT, method='zoh')
    _, y, _ = signal.dlsim(half, np.repeat(u, 2), x0=[u[0], 0.0])
    out = mapped(by_name('resonance'), axis_of(u), [f, d, a, b])
    np.testing.assert_allclose(out, u + y[1::2, 0], rtol=0, atol=1e-11)
    assert np.abs(out - u).max() > 0.01


def test_curve_of_the_command_is_linear_between_its_knots():
    data = moving()
    effect = entry('shape:command')
    settings = effect.prepare(data)
    p = 0.01 * np.random.default_rng(5).standard_normal(len(effect.parameters))
    x, y = curves.curve_of(effect, p, settings)
    inside = (data.command >= x[0]) & (data.command <= x[-1])
    assert inside.mean() > 0.95
    np.testing.assert_allclose(
        mapped(effect, data, p, settings)[inside], np.interp(data.command, x, y)[inside],
        rtol=0, atol=1e-14,
    )


@pytest.mark.parametrize('name', ['time', 'battery', 'throttle'])
def test_a_gain_curve_scales_the_command_along_its_signal(name):
    data = moving()
    effect = entry(f'shape:gain:{name}')
    settings = effect.prepare(data)
    p = 0.1 * np.random.default_rng(5).standard_normal(len(effect.parameters))
    x, y = curves.curve_of(effect, p, settings)
    along = {
        'time': np.arange(1500) * DT, 'battery': data.battery_v, 'throttle': data.control[:, 0]
    }[name]
    np.testing.assert_allclose(
        mapped(effect, data, p, settings), data.command * (1.0 + np.interp(along, x, y)),
        rtol=0, atol=1e-14,
    )


# what turns the axis besides the drive: free runs against an ODE solver

N = 500
HELD = np.random.default_rng(8).choice([-0.02, -0.005, 0.01, 0.02], N // 5).repeat(5)


def flown(torque, hidden=0, derivative=lambda _x, _rate: []):
    """(rate, angle) (N,) of the base with a torque(t, rate, angle, x) and hidden states x."""
    gain, lag, _, damping, bias = BASE
    state = np.r_[HELD[0], 0.3, 0.1, np.zeros(hidden)]
    rows = [state]
    for k in range(N - 1):
        def slope(t, s, u=HELD[k]):
            turn = gain * s[0] - damping * s[1] + bias + torque(t, s[1], s[2], s[3:])
            return [(u - s[0]) / lag, turn, s[1], *derivative(s[3:], s[1])]

        state = solve_ivp(
            slope, (k * DT, (k + 1) * DT), state, method='DOP853', rtol=1e-9, atol=1e-10
        ).y[:, -1]
        rows.append(state)
    table = np.array(rows)
    return table[:, 1], table[:, 2]


def free_run(effect, parameters, rate, angle, settings=None, **fields):
    """The simulator from the first sample on; nothing measured is used after it."""
    data = axis_of(HELD, rate=rate, angle=angle, **fields)
    sim = Simulator(data, ((0, N),), Windows(np.array([1]), N - 1, np.array([0])), np.zeros(4))
    structure = Structure().with_effect(effect, settings or {})
    with_it = sim.run(structure, np.r_[BASE, parameters]).errors[0]
    without = sim.run(Structure(), BASE).errors[0]
    return with_it, without


def others(t):
    return np.stack([2.0 * np.sin(3.0 * t), 1.5 * np.cos(5.0 * t)], axis=-1)


OMEGA = 2.0 * math.pi * 2.0
KNOWN = {
    'periodic_disturbance': (
        ('periodic_disturbance', ''), [0.8, 2.3, 0.7], {},
        lambda t, *_: 0.8 * math.sin(2.0 * math.pi * 2.3 * t + 0.7),
    ),
    'step_torque': (
        ('step_event', 'torque'), [0.401, 1.2], {}, lambda t, *_: 1.2 * (t >= 0.401)
    ),
    'first other rate': (
        ('gyroscopic_coupling', 'other axis 1'), [0.6], {'column': 0.0},
        lambda t, *_: 0.6 * others(t)[0],
    ),
    'second other rate': (
        ('gyroscopic_coupling', 'other axis 2'), [-0.6], {'column': 1.0},
        lambda t, *_: -0.6 * others(t)[1],
    ),
    'product of rates': (
        ('inertia_coupling', ''), [0.5], {}, lambda t, *_: 0.5 * others(t)[0] * others(t)[1]
    ),
}  # fmt: skip


@pytest.mark.parametrize('case', KNOWN)
def test_torques_known_over_time_run_as_the_ode_says(case):
    """Held at its mid value over each cycle: 1e-3 of what the torque does in two seconds."""
    key, parameters, settings, torque = KNOWN[case]
    rate, angle = flown(torque)
    left, without = free_run(
        entry(*key), parameters, rate, angle, settings, other_rates=others(np.arange(N) * DT)
    )
    assert np.abs(without).max() > 0.05
    assert np.abs(left).max() < 1e-3 * np.abs(without).max()


HIDDEN = {
    'slow state': (
        [9.0, 0.6], 1, lambda x, rate: [-9.0 * rate - x[0] / 0.6], lambda _t, _r, _a, x: x[0]
    ),
    'oscillation': (
        [2.0, 0.1, 1.5, -0.8], 2,
        lambda x, rate: [x[1], OMEGA * rate - OMEGA**2 * x[0] - 0.2 * OMEGA * x[1]],
        lambda _t, _r, _a, x: 1.5 * OMEGA * x[0] - 0.8 * x[1],
    ),
}  # fmt: skip


@pytest.mark.parametrize('variant', HIDDEN)
def test_hidden_states_run_as_the_ode_says(variant):
    """The state is driven by the mean rate of each cycle: 5e-3 of what it does in two seconds."""
    parameters, count, derivative, torque = HIDDEN[variant]
    rate, angle = flown(torque, count, derivative)
    left, without = free_run(entry('mode', variant), parameters, rate, angle)
    assert np.abs(without).max() > 0.05
    assert np.abs(left).max() < 5e-3 * np.abs(without).max()


@pytest.mark.parametrize('name', ['shape:rate', 'shape:angle'])
def test_curves_run_as_the_ode_says(name):
    """Straight between knots even in x / (|x| + w), the ODE solver's own way to them: 1e-3."""
    effect = entry(name)
    wide = np.linspace(-1.5, 1.5, N)
    settings = effect.prepare(axis_of(HELD, rate=wide, angle=wide))
    p = 2.0 * np.random.default_rng(6).standard_normal(len(effect.parameters))
    x, y = curves.curve_of(effect, p, settings)
    warp = settings['warp']

    def even(s):
        return s if warp == 0.0 else s / (np.abs(s) + warp)

    def torque(_t, rate, angle, _x):
        return float(np.interp(even(rate if name == 'shape:rate' else angle), even(x), y))

    rate, angle = flown(torque)
    left, without = free_run(effect, p, rate, angle, settings)
    assert np.abs(without).max() > 0.05
    assert np.abs(left).max() < 1e-3 * np.abs(without).max()


def test_friction_stays_stable_where_it_could_chatter():
    """The slope at rest is never steeper than one integration step can follow."""
    for size in (0.1, 50.0):
        term = torques.coulomb(axis_of(np.zeros(3)), np.array([size]), {})
        assert term.values[0] / term.values[1] * DT <= 1.0 + 1e-12


# what the curves span


CURVES = [(e.name, e.variant) for e in SHAPES if e.kind == 'shape']


@pytest.mark.parametrize(('name', 'variant'), CURVES)
def test_curves_hold_all_but_what_the_base_has(name, variant):
    """No constant, no line of rate or command (gain and damping); else any curve on the knots."""
    effect = entry(name, variant)
    settings = effect.prepare(moving())
    known = [np.ones_like] + [lambda x: x] * (name in {'shape:rate', 'shape:command'})
    known = [] if variant == 'friction' else known  # the base has no friction
    columns = []
    for p in np.eye(len(effect.parameters)):
        x, y = curves.curve_of(effect, p, settings)
        columns.append(y - x if name == 'shape:command' else y)
    basis, base = np.stack(columns, axis=1), np.array([f(x) for f in known]).reshape(-1, x.size).T
    assert np.linalg.matrix_rank(np.hstack([basis, base])) == x.size
    np.testing.assert_allclose(base.T @ basis / np.abs(base).max(axis=0)[:, None], 0, atol=1e-12)
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-12)


def test_knots_of_a_rate_curve_lie_over_the_data_dense_and_even_around_zero():
    effect = entry('shape:rate')
    data = moving()
    x, _ = curves.curve_of(effect, np.zeros(10), effect.prepare(data))
    far = np.abs(np.percentile(data.rate, [1.0, 99.0])).max()
    np.testing.assert_allclose(x, -x[::-1], atol=1e-12)
    np.testing.assert_allclose(x[-1], far, rtol=1e-9)
    assert np.all(x != 0.0)
    assert np.all(np.diff(x[x.size // 2 :], 2) > 0.0)


@pytest.mark.parametrize(('name', 'besides', 'curve'), [
    ('shape:rate', 'coulomb_friction', np.sign),
    ('shape:rate', 'quadratic_drag', lambda x: x * abs(x)),
    ('shape:angle', 'pendulum_stiffness', np.sin),
    ('shape:angle', 'cubic_stiffness', lambda x: x**3),
])  # fmt: skip
def test_a_refining_curve_leaves_out_what_the_name_says_itself(name, besides, curve):
    effect = entry(name)
    settings = effect.prepare(moving())
    less, refined = curves.besides(effect, settings, (besides,))
    assert len(less.parameters) == len(effect.parameters) - 1
    for p in np.eye(len(less.parameters)):
        x, y = curves.curve_of(less, p, refined)
        assert abs(y @ curve(x)) < 1e-9 * np.linalg.norm(curve(x))


@pytest.mark.parametrize(('name', 'variant'), CURVES)
def test_the_curves_prior_is_on_their_bends_alone(name, variant):
    """Its rows are the second differences of the knots' values, all of one weight."""
    effect = entry(name, variant)
    settings = effect.prepare(moving())
    rows = effect.prior(settings)
    p = np.random.default_rng(3).standard_normal(len(effect.parameters))
    x, y = curves.curve_of(effect, p, settings)
    values = y - x if name == 'shape:command' else y
    bend = np.diff(values, 2)
    ratio = np.linalg.norm(rows @ p) / np.linalg.norm(bend)
    np.testing.assert_allclose(rows @ p, ratio * bend, rtol=1e-9, atol=1e-9 * ratio)


# what the data must show


def without(**fields) -> AxisData:
    return dataclasses.replace(moving(), **fields)


def still(column: int) -> np.ndarray:
    control = moving().control.copy()
    control[:, column] = 0.0
    return control


def quiet_throttle() -> np.ndarray:
    control = moving().control.copy()
    control[:, 0], control[:, 2:] = 0.5, 0.0
    return control


NAN = np.full((1500, 2), np.nan)
REFUSED = [
    ('pendulum_stiffness', '', {'angle': None}, 'no orientation'),
    ('cubic_stiffness', '', {'angle': None}, 'no orientation'),
    ('shape:angle', '', {'angle': None}, 'no orientation'),
    ('shape:rate', '', {'rate': np.zeros(1500)}, 'does not move'),
    ('shape:rate', '', {'rate': np.full(1500, np.nan)}, 'not measured'),
    ('shape:command', '', {'control': still(1)}, 'does not move'),
    ('battery_sag', '', {'battery_v': None}, 'no battery voltage'),
    ('battery_sag', '', {'battery_v': np.linspace(12.0, 12.01, 1500)}, 'moves by 0.010 V only'),
    ('thrust_curve', '', {'control': quiet_throttle()}, 'the throttle stays at 0.50'),
    ('cross_axis_input', 'other axis 1', {'control': still(2)}, 'command of pitch hardly moves'),
    ('cross_axis_input', 'other axis 2', {'control': still(3)}, 'command of yaw hardly moves'),
    ('gyroscopic_coupling', 'other axis 1', {'other_rates': np.zeros((1500, 2))}, 'pitch hardly'),
    ('gyroscopic_coupling', 'other axis 2', {'other_rates': NAN}, 'rate of yaw was not measured'),
    ('inertia_coupling', '', {'other_rates': np.zeros((1500, 2))}, 'hardly turns'),
]


@pytest.mark.parametrize(('name', 'variant', 'fields', 'words'), REFUSED)
def test_what_the_data_cannot_show_is_refused_in_words(name, variant, fields, words):
    answer = entry(name, variant).prepare(without(**fields))
    assert isinstance(answer, str)
    assert words in answer


# where the fits start


def test_lines_start_at_the_strongest_line_of_the_errors():
    """A line of 0.2 of the noise's RMS at 3.2 Hz over 40 s, four phases within 0.03 Hz; 25 Hz no.

    A line beyond 15 Hz is the sensor's vibration, however strong.
    """
    n = 10_000
    t = np.arange(n) * DT
    errors = np.random.default_rng(9).standard_normal(n)
    errors += 0.2 * np.sin(2.0 * np.pi * 3.2 * t + 1.0) + 2.0 * np.sin(2.0 * np.pi * 25.0 * t)
    sim = SimpleNamespace(
        data=axis_of(np.zeros(n)), run=lambda *_: SimpleNamespace(innovations=errors)
    )
    effect = by_name('periodic_disturbance')
    starts = effect.starts(sim, SimpleNamespace(structure=None, theta=None), effect)
    first = starts[:4]
    assert all(abs(f - 3.2) < 0.03 for _, f, _ in first)
    np.testing.assert_allclose([p for _, _, p in first], np.arange(4) * np.pi / 2)
    assert all(0.2 <= f <= 15.0 for _, f, _ in starts)
    assert all(abs(f - 3.2) > 0.05 for _, f, _ in starts[4:])


@pytest.mark.parametrize('variant', ['gain', 'torque'])
def test_events_start_near_where_they_happened(variant):
    """A load shifts, or a blade chips, 7.3 s into 16 s of training: the best start within 0.5 s.

    Its size, to first order, within a third.
    """
    n, size = 4000, {'gain': -0.3, 'torque': 0.8}[variant]
    t = np.arange(n) * DT
    u = np.random.default_rng(12).choice([-0.02, -0.005, 0.01, 0.02], n // 25).repeat(25)
    u -= np.linspace(0.0, 2.0 * u.mean(), n)
    struck = np.where((t >= 7.3) & (variant == 'gain'), 1.0 + size, 1.0)
    push = np.where((t >= 7.3) & (variant == 'torque'), size, 0.0)
    keep, fade = math.exp(-DT / 0.042), math.exp(-0.4 * DT)
    drive = signal.lfilter([0.0, 1.0 - keep], [1.0, -keep], 450.0 * u * struck) + push
    rate = signal.lfilter([0.0, DT], [1.0, -fade], drive)
    rate += 0.004 * np.random.default_rng(13).standard_normal(n)
    fit, _, sim = fit_base(axis_of(u, rate=rate, angle=np.cumsum(rate) * DT), ((0, n),))
    effect = entry('step_event', variant)
    time, change = effect.starts(sim, fit, effect)[0]
    assert abs(time - 7.3) <= 0.5
    assert change == pytest.approx(size, rel=0.35)


def test_events_have_a_start_where_training_is_in_short_pieces(moved):
    """Pieces of 1.8 s, each long enough for a window: the fit needs a start all the same."""
    data, sim, fit = moved
    pieces = tuple((k, k + 450) for k in range(0, 1500 - 450, 500))
    short = dataclasses.replace(data, train=pieces)
    sim = Simulator(short, pieces, short.windows(pieces), np.zeros(4))
    assert sim.windows.count == len(pieces)
    fit = fit_structure(sim, Structure(), BASE, max_iterations=1)
    effect = entry('step_event', 'torque')
    starts = effect.starts(sim, fit, effect)
    assert starts
    assert all(any(a * DT <= time <= b * DT for a, b in pieces) for time, _ in starts)


def test_limits_start_inside_the_motors_range(moved):
    data, sim, fit = moved
    low, high = data.motors.min(), data.motors.max()
    effect = by_name('saturation')
    for lower, upper in effect.starts(sim, fit, effect):
        assert low <= lower < upper <= high
        assert (lower, upper) != (low, high)


# probes of the residual scan


def test_probes_are_partitions_of_one_over_every_signal_that_moves():
    """Hats add up to one; with the drive they add up to the drive; what rests gives no group."""
    data = without(battery_v=np.full(1500, 12.0))
    groups = probes_of(data, BASE, data.rate, data.angle)
    assert 'voltage' not in groups
    assert {'rate', 'angle', 'command', 'throttle', 'pitch rate', 'yaw rate', 'command pitch',
            'command yaw', 'product of other rates', 'time', 'memory'} <= set(groups)  # fmt: skip
    keep = math.exp(-DT / BASE[1])
    drive = signal.lfilter([1.0 - keep], [1.0, -keep], BASE[0] * data.command)
    drive += BASE[0] * data.command[0] * keep ** np.arange(1, 1501)
    for name, members in groups.items():
        if name == 'memory':
            continue
        whole = drive if name.startswith('gain:') else np.ones(1500)
        np.testing.assert_allclose(sum(p.signal for p in members), whole, atol=1e-9)


# the page about it


def test_the_page_tells_the_table_and_nothing_else():
    """Every name in docs/what_is_missing.md with its parameters and units; curves by number."""
    page = Path(__file__).resolve().parents[2] / 'docs' / 'what_is_missing.md'
    rows = {}
    for line in page.read_text(encoding='utf-8').splitlines():
        cells = [cell.strip() for cell in line.strip('|').split('|')]
        if len(cells) == 5 and cells[0].startswith('`'):
            rows[cells[0].strip('`')] = cells[2]
    assert set(rows) == {e.name for e in ALL}
    for name, told in rows.items():
        entries = [e for e in ALL if e.name == name]
        if entries[0].kind == 'shape':
            counts = sorted({len(e.parameters) for e in entries})
            some = ' or '.join(map(str, counts))
            assert told == f'{some} values ({entries[0].parameters[0].unit})'
        else:
            found = set(re.findall(r'`(\w+)` \(((?:[^()]|\([^()]*\))+)\)', told))
            assert found == {(p.name, p.unit) for e in entries for p in e.parameters}, name


# the simulator's memory of what it has run


def test_two_variants_of_one_name_are_not_taken_for_each_other():
    """The same numbers for pitch's and for yaw's share of the command: two different runs."""
    data = moving()
    shared = Simulator(data, data.train, data.windows(data.train), np.zeros(4))
    theta = np.r_[BASE, 0.1]
    for variant in ('other axis 1', 'other axis 2'):
        effect = entry('cross_axis_input', variant)
        structure = Structure().with_effect(effect, effect.prepare(data))
        alone = Simulator(data, data.train, data.windows(data.train), np.zeros(4))
        np.testing.assert_array_equal(
            shared.run(structure, theta).errors, alone.run(structure, theta).errors
        )
