"""The loop's plant: exact steps against scipy and python-control, curves, effects as curves."""

import dataclasses

import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from quad_sysid.errors import BadInputError
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.from_model import (
    battery_factor,
    gain_range,
    loop_plant,
    not_in_the_loop,
    throttle_factor,
)
from quad_sysid.loop.plant import (
    Curve,
    LightMode,
    LoopPlant,
    Slopes,
    SlowMotors,
    exact_cycles,
    exact_step,
    slopes_at,
    state_space,
)
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.model import AxisModel, EffectEstimate, Parameter

PLANT = LoopPlant(450.0, 0.043, 0.0094, 0.4, 0.0, 42.0, 0.004)


def test_state_space_is_the_exact_zero_order_hold_of_python_control():
    """Whole delay of 2 cycles: lag, damping and Butterworth against control.c2d(zoh)."""
    plant = LoopPlant(450.0, 0.043, 0.008, 0.4, 0.0, 42.0, 0.004)
    wc = 2 * np.pi * 42.0
    s = control.tf('s')
    rate = 450.0 / (0.043 * s + 1) / (s + 0.4) * wc**2 / (s**2 + np.sqrt(2) * wc * s + wc**2)
    exact = control.c2d(rate, 0.004, 'zoh')
    ours = state_space(plant)
    omega = np.geomspace(0.5, 600.0, 40)
    z = np.exp(1j * omega * 0.004)
    n = ours.a.shape[0]
    mine = np.array([(ours.c @ np.linalg.solve(v * np.eye(n) - ours.a, ours.b))[0, 0] for v in z])
    np.testing.assert_allclose(mine, exact(z) * z**-2, rtol=1e-6)


@pytest.mark.parametrize('delay_s', [0.0, 0.0013, 0.004, 0.0094])
@pytest.mark.parametrize('filter_hz', [None, 42.0])
def test_batched_response_and_state_space_agree(delay_s, filter_hz):
    plant = LoopPlant(450.0, 0.043, delay_s, 0.4, 0.0, filter_hz, 0.004)
    slopes = Slopes(-2.0, -9.0, 0.8)
    ours = state_space(plant, slopes)
    omega = np.geomspace(0.5, 700.0, 30)
    response = exact_cycles([plant, PLANT if filter_hz else plant], [slopes, Slopes()])
    mine = response.response(omega)[:, 0]
    n = ours.a.shape[0]
    for k, v in enumerate(np.exp(1j * omega * 0.004)):
        want = (ours.c @ np.linalg.solve(v * np.eye(n) - ours.a, ours.b))[:, 0]
        np.testing.assert_allclose(mine[:, k], want, rtol=1e-9)


def test_fractional_delay_matches_an_integration_that_knows_the_switching_times():
    rng = np.random.default_rng(1)
    u = rng.normal(size=12) * 0.1
    model = state_space(PLANT)
    x = np.zeros(model.a.shape[0])
    rates = []
    for value in u:
        rates.append((model.c @ x)[0])
        x = model.a @ x + model.b[:, 0] * value
    wc = 2 * np.pi * 42.0

    def f(t, y):
        k = int(np.floor((t - PLANT.delay_s) / PLANT.dt))
        v = u[k] if 0 <= k < u.size else 0.0
        return [
            (450.0 * v - y[0]) / 0.043,
            y[0] - 0.4 * y[1],
            y[3],
            wc**2 * (y[1] - y[2]) - np.sqrt(2) * wc * y[3],
        ]

    t = np.arange(12) * PLANT.dt
    reference = solve_ivp(f, (0, t[-1]), np.zeros(4), t_eval=t, max_step=1e-5, rtol=1e-8)
    np.testing.assert_allclose(rates, reference.y[2], atol=2e-4 * np.max(np.abs(rates)))


def test_curve_interpolates_and_goes_on_or_holds_outside():
    extend = Curve(np.array([-1.0, 0.0, 1.0]), np.array([-2.0, 0.0, 4.0]))
    np.testing.assert_allclose(extend([-2.0, -0.5, 0.25, 3.0]), [-4.0, -1.0, 1.0, 12.0])
    hold = Curve(extend.x, extend.y, 'hold')
    np.testing.assert_allclose(hold([-2.0, 3.0]), [-2.0, 4.0])
    assert extend.steepest == 4.0
    with pytest.raises(BadInputError, match='equal steps'):
        Curve(np.array([0.0, 1.0, 3.0]), np.zeros(3))
    with pytest.raises(BadInputError, match='finite'):
        Curve(np.array([0.0, 1.0]), np.array([0.0, np.nan]))


def test_describing_gains_are_those_of_the_textbook():
    """Relay 4M/(pi A); dead zone of half width d at A = 2d: 1 - 2/pi (asin .5 + .5 sqrt(.75))."""
    relay = Curve.sampled(lambda x: 3.0 * np.tanh(x / 1e-3), 5.0, 1e-3)
    assert relay.describing_gain(2.0) == pytest.approx(4 * 3.0 / (np.pi * 2.0), rel=1e-2)
    dead = Curve.sampled(lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.05, 0), 1.0, 1e-3)
    want = 1 - 2 / np.pi * (np.arcsin(0.5) + 0.5 * np.sqrt(0.75))
    assert dead.describing_gain(0.1) == pytest.approx(want, rel=5e-3)
    plant = LoopPlant(1.0, 0.1, 0.0, 0.0, 0.0, None, 0.01, command_curve=dead)
    assert slopes_at(plant, 1.0, 0.2, 0.1).command == dead.describing_gain(0.1)
    assert slopes_at(plant, 1.0, 0.2, 0.1).rate == 0.0


@pytest.mark.parametrize(
    'change', [{'gain': np.nan}, {'delay_s': -0.001}, {'dt': 0.0}, {'gyro_filter_hz': np.nan}]
)
def test_a_plant_that_cannot_be_is_refused(change):
    numbers = {
        'gain': 450.0, 'lag_s': 0.04, 'delay_s': 0.008, 'damping': 0.4, 'bias': 0.0,
        'gyro_filter_hz': 42.0, 'dt': 0.004,
    } | change  # fmt: skip
    with pytest.raises(BadInputError):
        LoopPlant(**numbers)


def _model(*effects):
    return AxisModel(
        axis='roll', dt=0.004, gyro_filter_hz=42.0,
        base=tuple(
            Parameter(name, value, 0.01, '')
            for name, value in [
                ('gain', 450.0), ('lag', 0.043), ('delay', 0.008), ('damping', 0.4), ('bias', 0.2),
            ]
        ),
        effects=effects, mean_battery_v=11.0,
    )  # fmt: skip


def _effect(name, settings=None, **values):
    parameters = tuple(Parameter(n, v, 0.01, '') for n, v in values.items())
    return EffectEstimate(name, 'named', ('rate',), parameters, settings or {})


def test_effects_become_curves_with_the_contracts_signs():
    plant = loop_plant(
        _model(
            _effect('coulomb_friction', torque=3.0),
            _effect('quadratic_drag', coefficient=0.1),
            _effect('pendulum_stiffness', stiffness=12.0),
            _effect('cubic_stiffness', stiffness=5.0),
            _effect('dead_zone', half_width=0.01),
            _effect('battery_sag', {'reference_v': 12.0}, exponent=2.0),
            _effect('gyroscopic_coupling', coefficient=1.0),
            _effect('shape:rate', {'knots': [-1.0, 0.0, 1.0], 'values': [0.5, 0.0, -0.5]}),
            _effect('shape:command', {'knots': [-0.2, 0.2], 'values': [-0.22, 0.22]}),
        )
    )
    assert plant.gain == pytest.approx(450.0 * (11.0 / 12.0) ** 2)
    np.testing.assert_allclose(
        plant.rate_curve([-2.0, 0.5]), [3.0 + 0.4 + 0.75, -3.0 - 0.025 - 0.25], atol=1e-3
    )
    np.testing.assert_allclose(
        plant.angle_curve([0.3]), [-12 * np.sin(0.3) - 5 * 0.027], atol=1e-3
    )
    np.testing.assert_allclose(plant.command_curve([-0.1, 0.005]), [-0.099, 0.0], atol=1e-6)
    assert plant.bias == 0.2


def test_what_has_no_place_in_the_loop_is_named():
    model = _model(_effect('gyroscopic_coupling', coefficient=1.0), _effect('dead_zone'))
    assert not_in_the_loop(model) == ('gyroscopic_coupling',)
    assert battery_factor(model) == 1.0
    plain = loop_plant(_model())
    assert plain.rate_curve is None
    assert plain.angle_curve is None
    assert plain.command_curve is None


def test_exact_step_is_scipys_matrix_exponential():
    """A stiff stack (lag 10 us beside 40 ms): to 1e-9 of the largest entry."""
    rng = np.random.default_rng(4)
    a = rng.normal(size=(3, 4, 4)) * np.array([1.0, 50.0, 1e4])[:, None, None]
    a -= np.eye(4) * np.max(np.abs(a), axis=(1, 2))[:, None, None] * 3
    b = rng.normal(size=(3, 4, 1))
    phi, gamma = exact_step(a, b, np.array([0.004, 0.004, 0.0]))
    for i, h in enumerate([0.004, 0.004, 0.0]):
        block = np.block([[a[i], b[i]], [np.zeros((1, 5))]]) * h
        want = expm(block)
        np.testing.assert_allclose(phi[i], want[:4, :4], atol=1e-9)
        np.testing.assert_allclose(gamma[i], want[:4, 4:], atol=1e-9)


def test_slow_motors_and_a_mode_against_python_control():
    """A quarter of the drive behind 0.1 s and a mode at 7 Hz, both in the drive: c2d(zoh)."""
    plant = LoopPlant(
        450.0, 0.043, 0.008, 0.4, 0.0, None, 0.004,
        slow=SlowMotors(0.25, 0.1), mode=LightMode(44.0, 0.05, 0.1, 0.2),
    )  # fmt: skip
    s = control.tf('s')
    drive = 450.0 * (0.75 / (0.043 * s + 1) + 0.25 / (0.1 * s + 1))
    light = 44.0**2 / (s**2 + 2 * 0.05 * 44.0 * s + 44.0**2)
    exact = control.c2d(drive * (1 + light * (0.1 + 0.2 * s / 44.0)) / (s + 0.4), 0.004, 'zoh')
    omega = np.geomspace(0.5, 700.0, 60)
    mine = exact_cycles([plant], [Slopes()]).response(omega)[0, 0]
    z = np.exp(1j * omega * 0.004)
    np.testing.assert_allclose(mine, exact(z) * z**-2, rtol=1e-5)


def test_the_simulation_runs_the_same_states_as_the_linear_plant():
    """Command steps through simulate_cascade with zero gains against the state space."""
    plant = LoopPlant(
        300.0, 0.03, 0.0062, 0.4, 0.0, 42.0, 0.004,
        slow=SlowMotors(0.25, 0.1), mode=LightMode(44.0, 0.05, 0.1, 0.2),
    )  # fmt: skip
    u = 0.02 * np.sign(np.sin(np.arange(200) / 9.0))
    silent = CascadeGains(0.0, 0.0, 0.0, 0.0)
    run = simulate_cascade(plant, silent, np.zeros(200), 0.004, control_excitation=u)
    model = state_space(plant)
    x, rates = np.zeros(model.a.shape[0]), []
    for value in u:
        rates.append((model.c @ x)[0])
        x = model.a @ x + model.b[:, 0] * value
    np.testing.assert_allclose(run.rate, rates, atol=1e-9)


def test_plants_with_and_without_a_mode_do_not_mix():
    other = dataclasses.replace(PLANT, mode=LightMode(44.0, 0.05, 0.1, 0.2))
    with pytest.raises(BadInputError, match='slow motors and mode'):
        exact_cycles([PLANT, other], [Slopes(), Slopes()])


def test_events_throttle_and_motor_limits_come_from_the_model():
    """After an event its values hold; the thrust curve is a factor; limits clip both sides."""

    def found(name, settings=None, **parameters):
        values = tuple(Parameter(k, v, 0.01, '') for k, v in parameters.items())
        return EffectEstimate(name, 'named', ('command',), values, settings or {})

    def plant_of(*effects):
        return loop_plant(dataclasses.replace(model_of(), effects=effects))

    plain = plant_of()
    assert plant_of(found('step_event', change=-0.2)).gain == pytest.approx(0.8 * plain.gain)
    assert plant_of(found('step_event', torque=0.3)).bias == pytest.approx(plain.bias + 0.3)
    curve = found('thrust_curve', {'throttle': 0.4}, curvature=0.5)
    bent = dataclasses.replace(model_of(), effects=(curve,))
    assert throttle_factor(bent, 1.0) == 1.0
    assert throttle_factor(bent, 1.2) == pytest.approx((0.5 + 0.48) / (0.5 + 0.4))
    assert loop_plant(bent).command_curve is None
    limited = plant_of(found('saturation', lower=0.1, upper=0.5)).command_curve
    np.testing.assert_allclose(limited([-0.5, 0.1, 0.5]), [-0.2, 0.1, 0.2], atol=1e-12)
    assert not_in_the_loop(bent) == ()
    along = EffectEstimate('shape:gain:time', 'shape', ('time',), (), {'values': (0.1, 0.0, -0.2)})
    drifted = dataclasses.replace(model_of(), effects=(along,))
    assert gain_range(drifted) == pytest.approx((0.8, 0.8, 1.1))
    assert loop_plant(drifted).gain == pytest.approx(0.8 * plain.gain)
    assert not_in_the_loop(drifted) == ()


def model_of():
    names = ('gain', 'lag', 'delay', 'damping', 'bias')
    values = (450.0, 0.043, 0.008, 0.4, 0.1)
    base = tuple(Parameter(n, v, 0.01, '') for n, v in zip(names, values, strict=True))
    return AxisModel('roll', 0.004, 42.0, base)
