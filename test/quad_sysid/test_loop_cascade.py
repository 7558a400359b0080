"""The cascade: names, margins against python-control, time against an independent simulation."""

import dataclasses

import control
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from quad_sysid.errors import BadInputError
from quad_sysid.loop.cascade import (
    FIRMWARE_UNIT,
    CascadeGains,
    bandwidth,
    closed_loop_radius,
    frequency_grid,
    margins,
    noise_response,
    open_loop,
    reference_response,
)
from quad_sysid.loop.plant import Curve, LoopPlant, Slopes, exact_cycles, state_space
from quad_sysid.loop.simulation import simulate_cascade, simulate_polynomial_cascade

DT = 0.004
PLANT = LoopPlant(450.0, 0.043, 0.008, 0.4, 0.0, 42.0, DT)
GAINS = CascadeGains.default('roll')


def loop_of(plant, gains, omega):
    return open_loop(gains, exact_cycles([plant], [Slopes()]).response(omega), omega, plant.dt)


def controller_tf(gains):
    z = control.tf([1, 0], [1], DT)
    w = DT / (DT + 1 / (2 * np.pi * gains.d_filter_hz))
    pi = gains.rate_kp + gains.rate_ki * DT * z / (z - 1)
    d = gains.rate_kd * w / DT * (z - 1) / (z - (1 - w))
    return pi, d


def test_names_round_trip_and_defaults_are_the_papers():
    values = GAINS.to_mapping('roll', constants=True)
    assert values['roll.angle.kp'] == 3.0
    assert values['roll.rate.kp'] == pytest.approx(1.3 * 0.0572957795)
    assert values['roll.rate.d_filter_hz'] == 30.0
    assert CascadeGains.from_mapping(values, 'roll') == GAINS
    assert set(GAINS.to_mapping('yaw')) == {
        'yaw.angle.kp', 'yaw.rate.kp', 'yaw.rate.ki', 'yaw.rate.kd',
    }  # fmt: skip
    yaw = CascadeGains.from_mapping({}, 'yaw')
    assert (yaw.angle_kp, yaw.rate_kp, yaw.rate_kd) == (2.0, 3.0 * FIRMWARE_UNIT, 0.0)
    with pytest.raises(BadInputError, match=r'rate\.kp: must be finite'):
        CascadeGains.from_mapping({'roll.rate.kp': float('nan')}, 'roll')


def test_margins_equal_python_controls():
    """Phase margin, gain margin, peak sensitivity: 0.1 deg, 0.1 dB, 1 %."""
    model = state_space(PLANT)
    plant = control.ss(model.a, model.b, model.c, 0, DT)
    pi, d = (control.ss(part) for part in controller_tf(GAINS))
    loop = plant[0, 0] * (pi + d) + plant[1, 0] * pi * GAINS.angle_kp
    gm, pm, *_ = control.stability_margins(control.frd(loop, np.geomspace(1, 780, 4000)))
    omega = frequency_grid(DT)
    ours = margins(loop_of(PLANT, GAINS, omega), omega)
    assert ours.phase_margin_deg[0] == pytest.approx(pm, abs=0.1)
    assert ours.gain_margin_db[0] == pytest.approx(20 * np.log10(gm), abs=0.1)
    dense = np.geomspace(0.1, 780, 20000)
    peak = np.max(1 / np.abs(1 + loop_of(PLANT, GAINS, dense)))
    assert ours.peak_sensitivity[0] == pytest.approx(peak, rel=0.01)


def test_margins_of_a_pure_integrator_with_delay_are_the_closed_form():
    """L = K e^(-sT)/s: crossover K, phase margin 90 deg - K T, gain margin pi / (2 K T)."""
    k, delay = 8.0, 0.05
    omega = np.geomspace(0.1, 200.0, 2000)
    m = margins((k * np.exp(-1j * omega * delay) / (1j * omega))[None], omega)
    assert m.crossover_rad_s[0] == pytest.approx(k, rel=1e-3)
    assert m.phase_margin_deg[0] == pytest.approx(90 - np.degrees(k * delay), abs=0.05)
    assert m.gain_margin_db[0] == pytest.approx(20 * np.log10(np.pi / (2 * k * delay)), abs=0.05)


def test_a_loop_that_never_crosses_has_infinite_margins_and_no_crossover():
    omega = np.geomspace(0.1, 100.0, 50)
    m = margins((0.5 / (1 + 1j * omega / 10))[None], omega)
    assert np.isinf(m.phase_margin_deg[0])
    assert np.isinf(m.gain_margin_db[0])
    assert np.isnan(m.crossover_rad_s[0])


def test_stability_by_eigenvalues_agrees_with_the_gain_margin():
    """The loop becomes unstable where the gain margin says, within 0.1 dB; mixed delays too."""
    plants = [PLANT, *(dataclasses.replace(PLANT, delay_s=delay) for delay in (0.0015, 0.017))]
    cycle = exact_cycles(plants, [Slopes()] * 3)
    omega = frequency_grid(DT, 2000)
    gm = margins(open_loop(GAINS, cycle.response(omega), omega, DT), omega).gain_margin_db
    for i, value in enumerate(gm):
        for offset, stable in [(-0.1, True), (0.1, False)]:
            f = 10 ** ((value + offset) / 20)
            one = exact_cycles([dataclasses.replace(plants[i], gain=450.0 * f)], [Slopes()])
            assert bool(closed_loop_radius(GAINS, one)[0] < 1.0) is stable
            mixed = exact_cycles(
                [dataclasses.replace(p, gain=450.0 * f) for p in plants], [Slopes()] * 3
            )
            assert closed_loop_radius(GAINS, mixed)[i] == pytest.approx(
                closed_loop_radius(GAINS, one)[0], rel=1e-6
            )


def test_noise_and_reference_response_match_the_time_simulation():
    """A sine of 12 rad/s once settled: amplitude to 1 %."""
    omega = np.array([12.0])
    t = np.arange(5000) * DT
    plant = exact_cycles([PLANT], [Slopes()]).response(omega)
    wave = 0.05 * np.sin(12.0 * t)
    tail = slice(3000, None)
    basis = np.exp(-1j * 12.0 * t[tail])

    def amplitude(y):
        return np.abs(2 * np.mean((y[tail] - np.mean(y[tail])) * basis))

    angle = simulate_cascade(PLANT, GAINS, wave, DT).angle
    want = 0.05 * np.abs(reference_response(GAINS, plant, omega, DT)[0, 0])
    assert amplitude(angle) == pytest.approx(want, rel=0.01)
    u = simulate_cascade(PLANT, GAINS, 0 * t, DT, noise=wave).control
    assert amplitude(u) == pytest.approx(
        0.05 * np.abs(noise_response(GAINS, plant, omega, DT)[0, 0]), rel=0.01
    )
    grid = frequency_grid(DT)
    response = reference_response(
        GAINS, exact_cycles([PLANT], [Slopes()]).response(grid), grid, DT
    )
    assert 2.0 < bandwidth(response, grid)[0] < 6.0


def by_hand(plant, gains, reference, *, torque=lambda _, __: 0.0, disturbance=0.0):
    """The same loop, written apart: solve_ivp between the command's changes."""
    wc = 2 * np.pi * plant.gyro_filter_hz
    w = DT / (DT + 1 / (2 * np.pi * gains.d_filter_hz))
    y = np.zeros(6)  # drive, rate, angle, filtered rate, its slope, filtered angle
    integral, last, d = 0.0, 0.0, 0.0
    commands, angles = [], []
    whole, rest = divmod(plant.delay_s + 1e-12, DT)
    for r in reference:
        angles.append(y[5])
        wanted = np.clip(gains.angle_kp * (r - y[5]), -gains.rate_limit, gains.rate_limit)
        e = wanted - y[3]
        integral = np.clip(
            integral + gains.rate_ki * e * DT, -gains.integrator_limit, gains.integrator_limit
        )
        d += w * ((y[3] - last) / DT - d)
        last = y[3]
        u = gains.rate_kp * e + integral - gains.rate_kd * d
        commands.append(np.clip(u, -gains.output_limit, gains.output_limit))
        for back, span in [(int(whole) + 1, rest), (int(whole), DT - rest)]:
            v = commands[-1 - back] if len(commands) > back else 0.0
            if span < 1e-9:
                continue

            def f(_, s, v=v):
                extra = torque(s[1], s[2]) + disturbance + plant.bias
                return [
                    (plant.gain * v - s[0]) / plant.lag_s,
                    s[0] - plant.damping * s[1] + extra,
                    s[1], s[4], wc**2 * (s[1] - s[3]) - np.sqrt(2) * wc * s[4], s[3],
                ]  # fmt: skip

            y = solve_ivp(f, (0, span), y, rtol=1e-9, atol=1e-11).y[:, -1]
    return np.array(angles), np.array(commands)


@pytest.mark.parametrize('delay_s', [0.008, 0.0053])
def test_simulation_equals_an_independent_one_with_limits_reached(delay_s):
    """Linear plant, 0.6 rad step (the output limit bites): to 1e-6 rad."""
    plant = dataclasses.replace(PLANT, delay_s=delay_s, bias=0.5)
    gains = dataclasses.replace(GAINS, output_limit=0.08, rate_limit=1.5)
    reference = np.where(np.arange(150) < 10, 0.0, 0.6)
    ours = simulate_cascade(plant, gains, reference, DT, disturbance=2.0)
    angle, u = by_hand(plant, gains, reference, disturbance=2.0)
    assert np.max(np.abs(ours.control)) == pytest.approx(0.08)
    assert np.max(np.abs(ours.rate_reference)) == pytest.approx(1.5)
    np.testing.assert_allclose(ours.angle, angle, atol=1e-6)
    np.testing.assert_allclose(ours.control, u, atol=1e-6)


def test_simulation_with_friction_and_pendulum_equals_an_independent_one():
    """Smooth friction and a sine spring: to 2e-4 rad of a 0.2 rad step."""

    def torque(rate, angle):
        return -3.0 * np.tanh(rate / 0.05) - 12.0 * np.sin(angle)

    plant = dataclasses.replace(
        PLANT,
        rate_curve=Curve.sampled(lambda x: -3.0 * np.tanh(x / 0.05), 12.0, 0.005),
        angle_curve=Curve.sampled(lambda x: -12.0 * np.sin(x), 1.6, 0.01),
    )
    reference = np.where(np.arange(200) < 10, 0.0, 0.2)
    ours = simulate_cascade(plant, GAINS, reference, DT)
    angle, _ = by_hand(PLANT, GAINS, reference, torque=torque)
    np.testing.assert_allclose(ours.angle, angle, atol=2e-4)


def test_dead_zone_and_excitations_reach_the_plant():
    dead = Curve.sampled(lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.05, 0), 1.0, 5e-4)
    plant = dataclasses.replace(PLANT, command_curve=dead)
    still = simulate_cascade(plant, GAINS, np.full(100, 0.1), DT)
    assert np.all(still.angle == 0.0)
    kick = simulate_cascade(plant, GAINS, np.zeros(100), DT, control_excitation=0.1)
    assert kick.control[0] == pytest.approx(0.1)
    assert kick.angle[-1] > 0.0
    asked = simulate_cascade(PLANT, GAINS, np.zeros(100), DT, rate_excitation=0.5)
    assert asked.rate_reference[0] == pytest.approx(0.5)


def test_initial_state_is_where_the_run_starts():
    run = simulate_cascade(PLANT, GAINS, np.zeros(800), DT, initial_angle=0.2, initial_rate=0.0)
    assert run.angle[0] == pytest.approx(0.2)
    assert run.rate[0] == 0.0
    assert abs(run.angle[-1]) < 0.01
    moving = simulate_cascade(PLANT, GAINS, np.zeros(3), DT, initial_angle=0.1, initial_rate=1.0)
    assert moving.rate[0] == pytest.approx(1.0)


def test_polynomial_cascade_equals_the_plant_it_was_made_of():
    """Rate of the whole-delay plant as A, B from control; the angle only differs by its sum."""
    plant = dataclasses.replace(PLANT, gyro_filter_hz=None)
    s = control.tf('s')
    exact = control.c2d(450.0 / (0.043 * s + 1) / (s + 0.4), DT, 'zoh')
    a, b = exact.den[0][0], exact.num[0][0]
    reference = np.where(np.arange(500) < 10, 0.0, 0.2)
    ours = simulate_polynomial_cascade(a, np.concatenate(([0.0], b)), GAINS, reference, DT, nk=2)
    want = simulate_cascade(plant, GAINS, reference, DT)
    np.testing.assert_allclose(ours.angle, want.angle, atol=1e-4)
    np.testing.assert_allclose(ours.rate, want.rate, atol=2e-3)


def test_the_papers_model_tracks_its_square_wave_once_the_sign_of_b_is_turned():
    a = [1, -0.579, -0.115, -0.571, -0.010, 0.0728, 0.035, -0.012, 0.075, 0.052, 0.055]
    b = [0.005, 0.004, 0.004, 0.003, 0.002, 0.002, 0.0017, 0.0008, 0.0007, 0.0007]
    reference = np.where(np.arange(2000) % 1000 < 500, 0.1, -0.1)
    gains = CascadeGains(3.0, 1.3, 0.01, 0.023, output_limit=50.0, integrator_limit=50.0)
    run = simulate_polynomial_cascade(a, b, gains, reference, DT, nk=5)
    assert abs(run.angle[-1] + 0.1) < 0.02
    turned = simulate_polynomial_cascade(a, -np.array(b), gains, reference, DT, nk=5)
    assert np.max(np.abs(turned.angle)) > 0.5


@pytest.mark.parametrize(
    ('call', 'said'),
    [
        (lambda: simulate_cascade(PLANT, GAINS, [0.0, np.nan], DT), 'finite'),
        (lambda: simulate_cascade(PLANT, GAINS, np.zeros(5), 0.002), "plant's 0.004"),
        (lambda: simulate_cascade(PLANT, GAINS, np.zeros(5), DT, noise=np.inf), 'noise'),
        (lambda: simulate_polynomial_cascade([1.0], [1.0], GAINS, np.zeros(5), DT), 'nk >= 1'),
        (lambda: simulate_polynomial_cascade([0.0], [0.0, 1.0], GAINS, [0.0], DT), r'A\[0\]'),
    ],
)
def test_bad_arguments_are_named(call, said):
    with pytest.raises(BadInputError, match=said):
        call()
