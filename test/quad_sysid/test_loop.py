"""The closed loop: margins against python-control, its cascade against the firmware in C."""

from dataclasses import replace

import control
import numpy as np
import pytest
from flown_axis import model_of

from quad_bridge.virtual.profile import load_profile
from quad_bridge.virtual.simulation import Excited, fly
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.estimate.stored import estimate_of
from quad_sysid.loop import cascade, kernels
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.figures import square_figures, square_wave, step_figures
from quad_sysid.loop.from_model import gain_range, loop_plant, not_in_the_loop
from quad_sysid.loop.linear import STILL, linear, loops_of
from quad_sysid.loop.plant import plant_like
from quad_sysid.loop.simulation import simulate_cascade, simulate_polynomial_cascade
from quad_sysid.model import EffectEstimate
from quad_sysid.pipeline.selection import approaches, controller, reproduced
from quad_sysid.record import IOData
from quad_sysid.signals.waveforms import prbs

DT = 0.004
BASE = {'gain': 450.0, 'lag': 0.043, 'delay': 0.008, 'damping': 0.4, 'bias': 0.0}


def plant_of(gyro_filter_hz=42.0, dt=DT, **changes):
    """The base, with some numbers changed."""
    return plant_like('roll', np.array([*(BASE | changes).values()]), dt, gyro_filter_hz)


PLANT = plant_of()
GAINS = CascadeGains.default('roll')


def response(plant, omega):
    """Rate and angle per command over frequency, (2, n)."""
    return loops_of([(plant, STILL)]).response(omega)[:, 0]


def loop_of(plant, gains, omega):
    return cascade.open_loop(gains, loops_of([(plant, STILL)]).response(omega), omega, plant.dt)


def test_gains_have_the_contracts_names_and_the_papers_defaults():
    values = GAINS.to_mapping('roll', constants=True)
    wanted = {'roll.angle.kp': 3.0, 'roll.rate.kp': 1.3 * 0.0572957795,
              'roll.rate.d_filter_hz': 30.0}
    assert {name: values[name] for name in wanted} == pytest.approx(wanted)
    assert CascadeGains.from_mapping(values, 'roll') == GAINS
    assert set(GAINS.to_mapping('yaw')) == {
        f'yaw.{name}' for name in ('angle.kp', 'rate.kp', 'rate.ki', 'rate.kd')
    }
    yaw = CascadeGains.from_mapping({}, 'yaw')
    assert (yaw.angle_kp, yaw.rate_kp, yaw.rate_kd) == (2.0, 3.0 * cascade.FIRMWARE_UNIT, 0.0)


S = control.tf('s')
FILTER = (2 * np.pi * 42.0) ** 2 / (
    S**2 + np.sqrt(2) * 2 * np.pi * 42.0 * S + (2 * np.pi * 42.0) ** 2
)
MODE = 44.0**2 / (S**2 + 2 * 0.05 * 44.0 * S + 44.0**2)
RINGING = ('resonance', 44.0 / (2.0 * np.pi), 0.05, 0.1, 0.2)


@pytest.mark.parametrize(
    ('hz', 'found', 'drive', 'tolerance', 'most'),
    [
        (None, (), 1 / (0.043 * S + 1), 3e-4, 350.0),
        (42.0, (), FILTER / (0.043 * S + 1), 1e-3, 350.0),
        (None, (('motor_lag', 0.1, 0.25), RINGING),
         (0.75 / (0.043 * S + 1) + 0.25 / (0.1 * S + 1)) * (1 + MODE * (0.1 + 0.2 * S / 44.0)),
         6e-3, 350.0),
        # to the motors each cycle of the command is its mean
        (None, (('mode:second_lag', 0.02),), 1 / (0.02 * S + 1) / (0.043 * S + 1), 5e-3, 50.0),
    ],
    ids=['lag', 'filter', 'slow motors and a mode', 'a second lag of the command'],
)
def test_the_plant_is_the_zero_order_hold_of_python_control(hz, found, drive, tolerance, most):
    """Two cycles of delay; 350 rad/s are beyond any loop."""
    model = model_of(*(effect(*one) for one in found), gyro_filter_hz=hz)
    exact = control.c2d(450.0 * drive / (S + 0.4), DT, 'zoh')
    omega = np.geomspace(0.5, most, 60)
    z = np.exp(1j * omega * DT)
    ours = response(loop_plant(model), omega)[0]
    np.testing.assert_allclose(ours, exact(z) * z**-2, rtol=tolerance)


def test_margins_equal_python_controls():
    z, w = control.tf([1, 0], [1], DT), DT / (DT + 1 / (2 * np.pi * GAINS.d_filter_hz))
    pi = GAINS.rate_kp + GAINS.rate_ki * DT * z / (z - 1)
    d = GAINS.rate_kd * w / DT * (z - 1) / (z - (1 - w))
    omega = np.geomspace(1.0, 780.0, 4000)
    z, (rate, angle) = np.exp(1j * omega * DT), response(PLANT, omega)
    loop = rate * (pi(z) + d(z)) + angle * pi(z) * GAINS.angle_kp
    gm, pm, *_ = control.stability_margins(control.frd(loop, omega))
    grid = cascade.frequency_grid(DT)
    ours = cascade.margins(loop_of(PLANT, GAINS, grid), grid)
    assert ours.phase_margin_deg[0] == pytest.approx(pm, abs=0.1)
    assert ours.gain_margin_db[0] == pytest.approx(20 * np.log10(gm), abs=0.1)
    peak = np.max(1 / np.abs(1 + loop_of(PLANT, GAINS, np.geomspace(0.1, 780, 20000))))
    assert ours.peak_sensitivity[0] == pytest.approx(peak, rel=0.01)
    never = cascade.margins((0.5 / (1 + 1j * omega / 10))[None], omega)
    assert np.isinf([never.phase_margin_deg[0], never.gain_margin_db[0]]).all()
    assert np.isnan(never.crossover_rad_s[0])


FILTERED = CascadeGains.from_mapping({
    'roll.rate.kff': 0.01, 'roll.rate.target_filter_hz': 8.0, 'roll.rate.error_filter_hz': 25.0,
    'roll.rate.output_filter_hz': 40.0, 'rate.d_notch_hz': 20.0, 'rate.d_notch_bandwidth_hz': 10.0,
}, 'roll')


@pytest.mark.parametrize('gains', [GAINS, FILTERED, replace(FILTERED, d_on_error=True)],
                         ids=['ours', 'filters of others', 'D on the error'])
def test_noise_and_reference_response_match_the_time_simulation(gains):
    omega, t, tail = np.array([12.0]), np.arange(5000) * DT, slice(3000, None)
    cycles = loops_of([(PLANT, STILL)])
    wave, plant = 0.05 * np.sin(12.0 * t), cycles.response(omega)
    for found, response_of in (
        (simulate_cascade(PLANT, gains, wave, DT).angle, cascade.reference_response),
        (simulate_cascade(PLANT, gains, 0 * t, DT, noise=wave).control, cascade.noise_response),
    ):
        settled = found[tail] - np.mean(found[tail])
        amplitude = np.abs(2 * np.mean(settled * np.exp(-12j * t[tail])))
        want = 0.05 * np.abs(response_of(gains, plant, omega, DT)[0, 0])
        assert amplitude == pytest.approx(want, rel=0.01)
    # a state for each filter that there is, and the response of these states
    omega = np.geomspace(0.5, 700.0, 40)
    ours = cascade.Linear(gains.dynamics(DT)).response(omega, DT)
    both = cascade.responses(cascade.constants_of([FILTERED, gains], DT), omega)
    np.testing.assert_allclose(ours, both[:, 1], rtol=1e-9)


def test_the_bandwidth_ends_where_half_of_the_power_is_left():
    grid = cascade.frequency_grid(DT)
    first_order = 5.0 / (5.0 + 1j * grid[None])
    assert cascade.bandwidth(first_order, grid)[0] == pytest.approx(5.0, rel=2e-3)
    assert np.isnan(cascade.bandwidth(first_order[:, :50], grid[:50])[0])


def test_describing_gains_are_those_of_the_textbook():
    """Relay 4M/(pi A); dead zone of half width d at A = 2d: 1 - 2/pi (asin .5 + .5 sqrt(.75))."""
    relay = linear(loop_plant(model_of(effect('coulomb_friction', 3.0, 1e-3))), (2.0, 0.2, 0.1))
    (part,) = (part for part, _ in relay.plant.torque_effects)
    assert part.effect.rows[0, 0] == pytest.approx(-4 * 3.0 / (np.pi * 2.0), rel=1e-2)
    dead = linear(loop_plant(model_of(effect('dead_zone', 0.05))), (2.0, 0.2, 0.1))
    want = 1 - 2 / np.pi * (np.arcsin(0.5) + 0.5 * np.sqrt(0.75))
    assert dead.plant.command_effects[1][0].effect.rows[0, 0] == pytest.approx(want, rel=5e-3)


def effect(
    name: str, *fitted: float, variant: str = '', settings: dict | None = None
) -> EffectEstimate:
    return estimate_of(name, fitted, variant, settings=settings, std=0.01)


def curve(name: str, knots: list, values: list) -> EffectEstimate:
    at = np.linspace(knots[0], knots[-1], 6)
    return effect(name, *np.interp(at, knots, values), variant='smooth',
                  settings={'knots': tuple(at), 'mean': (0.0,) * 6})


def test_what_varies_over_the_flight_has_its_range_in_the_loop():
    bent = model_of(effect('thrust_curve', 0.5, settings={'throttle': 0.4}))
    along = model_of(curve('shape:gain:time', [0.0, 20.0, 60.0], [0.1, 0.0, -0.2]))
    assert not_in_the_loop(bent) == not_in_the_loop(along) == {}
    omega = np.array([5.0])
    rate, higher, late = (np.abs(response(plant, omega)[0]) for plant in (
        PLANT, loop_plant(bent, {'throttle': 0.48}), loop_plant(along)))
    assert higher / np.abs(response(loop_plant(bent), omega)[0]) == pytest.approx(0.98 / 0.9)
    assert gain_range(along) == pytest.approx((0.8, 0.8, 1.1))
    assert late / rate == pytest.approx(0.8, rel=1e-4)
    for found, factor in (
        (effect('battery_sag', 2.0, settings={'reference_v': 12.0}), (11.0 / 12.0) ** 2),
        (effect('step_event', 3.0, -0.2, variant='gain'), 0.8),
    ):
        changed = np.abs(response(loop_plant(model_of(found)), omega)[0])
        assert changed / rate == pytest.approx(factor, rel=1e-4), found.name


@pytest.mark.parametrize(
    ('call', 'said'),
    [
        (lambda: simulate_cascade(PLANT, GAINS, [0.0, np.nan], DT), 'finite'),
        (lambda: simulate_cascade(PLANT, GAINS, np.zeros(5), 0.002), "plant's 0.004"),
        (lambda: simulate_cascade(PLANT, GAINS, np.zeros(5), DT, noise=np.inf), 'noise'),
        (lambda: simulate_polynomial_cascade([1.0], [1.0], GAINS, np.zeros(5), DT), 'nk >= 1'),
        *((lambda given=given: plant_of(**given), 'plant') for given in (
            {'gain': np.nan}, {'delay': -0.001}, {'dt': 0.0}, {'gyro_filter_hz': np.nan})),
        (lambda: CascadeGains.from_mapping({'roll.rate.kp': np.nan}, 'roll'), 'kp: must be finit'),
        (lambda: square_figures(np.zeros(5), np.zeros(6), DT), 'one length'),
        (lambda: square_figures(*2 * [np.linspace(0, 1, 500)], DT), 'no edge'),
    ],
)
def test_bad_arguments_are_named(call, said):
    with pytest.raises((BadInputError, NotInformativeError), match=said):
        call()


SLOW_DT = 0.01
A, B = np.array([1.0, -1.78, 0.784]), np.array([0.0, 0.0, 0.4, 0.35])


@pytest.mark.parametrize('lead', [0.0, 0.5])
def test_the_indirect_approach_takes_the_integration_that_gives_the_recorded_command(lead):
    reference = np.resize(prbs(9, 10, 0.2, 1), 4000)
    run = simulate_polynomial_cascade(A, B, GAINS, reference, SLOW_DT, angle_lead_s=lead * SLOW_DT)
    z = IOData(run.control, run.rate, SLOW_DT, r=reference)
    _, known = approaches(z, GAINS, behind_attitude=True, one_loop=True, closed=True)
    # limits aside it is the very command; the other integration is half a cycle out
    assert reproduced(z, known) > 99.9
    assert reproduced(z, controller(GAINS, SLOW_DT, trapezoid=lead > 0.0)) < 99.5


def first_order(reference, tau):
    y = np.zeros(reference.size)
    y[0] = reference[0]
    for k in range(1, reference.size):
        y[k] = y[k - 1] + (1 - np.exp(-DT / tau)) * (reference[k - 1] - y[k - 1])
    return y


def test_step_figures_are_the_closed_forms():
    """First order: rise time ln 9 tau, settling to 5 % after 3 tau, no overshoot.

    Second order: exp(-pi zeta / sqrt(1 - zeta^2)) at zeta 0.5, 16.3 %.
    """
    f = step_figures(1 - np.exp(-np.arange(1000) * DT / 0.2), DT)
    assert f.rise_time_s == pytest.approx(np.log(9) * 0.2, abs=0.5 * DT)
    assert f.settling_time_s == pytest.approx(3 * 0.2, abs=2 * DT)
    assert (f.overshoot_pct, f.final_error_pct) == pytest.approx((0.0, 0.0), abs=0.1)
    t, wd = np.arange(2000) * DT, 5 * np.sqrt(0.75)
    y = 1 - np.exp(-2.5 * t) * (np.cos(wd * t) + 2.5 / wd * np.sin(wd * t))
    assert step_figures(y, DT).overshoot_pct == pytest.approx(16.3, abs=0.2)


def test_square_figures_bear_noise_gaps_and_a_standing_error():
    r = square_wave(0.2, 2.0, 4, DT)
    y = first_order(r, 0.2)
    clean = square_figures(r, y, DT)
    noisy = square_figures(r, y + np.random.default_rng(3).normal(0, 0.004, y.size), DT)
    assert clean.edges == noisy.edges == 8
    assert clean.step_rad == pytest.approx(0.4)
    assert clean.rise_time_s == pytest.approx(np.log(9) * 0.2, abs=DT)
    assert noisy.rise_time_s == pytest.approx(clean.rise_time_s, rel=0.05)
    # error decays exp(-t/tau) from each edge; 8 of 9 half periods hold one
    want = 0.4 * np.sqrt(0.2 / 2 / 2.0 * 8 / 9)
    assert clean.rms_error_rad == pytest.approx(want, rel=0.02)
    y[1700:1720] = np.nan
    assert square_figures(r, y, DT).edges == 7
    low = square_figures(r, first_order(0.9 * r, 0.2), DT)
    assert low.rise_time_s == pytest.approx(np.log(9) * 0.2, abs=2 * DT)
    assert low.final_error_pct == pytest.approx(5.0, abs=0.6)
    assert low.overshoot_pct < 0.5


def by_the_loops_kernel(flight, axis, excitation, injection, gains):
    """(n, 2) rate reference and control that C1, C2 make of the recorded measurements."""
    constants, memory = gains.constants(DT), np.zeros(kernels.MEMORY)
    memory[kernels.LAST] = flight.rates[0, axis]
    memory[kernels.NOTCH :] = (1.0 - constants.notch) * flight.rates[0, axis]
    added = {name: excitation * (name == injection) for name in ('attitude', 'rate', 'control')}
    rows = [
        kernels.control(
            constants, memory, added['attitude'][k], flight.angles[k, axis],
            flight.rates[k, axis], added['rate'][k],
        )
        for k in range(excitation.size)
    ]  # fmt: skip
    return np.array(rows) + np.stack((0 * excitation, added['control']), axis=1)


D_NOTCH = {'rate.d_notch_hz': 30.0, 'rate.d_notch_bandwidth_hz': 20.0}


@pytest.mark.parametrize(('axis', 'injection', 'size', 'gains'), [
    ('roll', 'attitude', 0.3, {}), ('pitch', 'attitude', 1.4, {}), ('roll', 'rate', 1.0, D_NOTCH),
    ('pitch', 'control', 0.05, {'pitch.rate.ki': 0.1, 'pitch.rate.integrator_limit': 0.005}),
])
def test_the_firmware_in_c_flies_this_cascade(injection, size, axis, gains):
    excitation = size * np.repeat([1.0, -1.0] * 4, 500)
    part = Excited(0.0, excitation, axis, injection)
    flight = fly(replace(load_profile('plain'), axis=axis), [part], 16.0, 2, gains=gains)
    index = ('roll', 'pitch').index(axis)
    own = CascadeGains.from_mapping(gains, axis)
    expected = by_the_loops_kernel(flight, index, excitation, injection, own)
    np.testing.assert_allclose(flight.rate_setpoint[:, index], expected[:, 0], atol=1e-6)
    np.testing.assert_allclose(flight.wrench[:, 1 + index], expected[:, 1], atol=1e-6)
    np.testing.assert_allclose(flight.excitation[:, index], excitation)
