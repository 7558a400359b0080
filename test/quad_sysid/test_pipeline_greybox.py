"""The grey box against other ways to its numbers: ODE solver, refits, Monte Carlo, by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from quad_sysid.effects.crossval import folds_of, held_out_errors
from quad_sysid.effects.table import by_name
from quad_sysid.greybox import drive, levenberg, noise
from quad_sysid.greybox.covariance import robust_covariance
from quad_sysid.greybox.data import Windows, axis_data
from quad_sysid.greybox.fit import fit_base, fit_structure, fit_with_effect, simulator
from quad_sysid.greybox.simulate import Simulator
from quad_sysid.greybox.structure import Structure
from quad_sysid.record import Record, Segment

DT = 0.004
GYRO_HZ = 42.0


def record_of(command, rate, angle=None, segments=(), dt=DT) -> Record:
    """A record of the roll axis alone."""
    zero = np.zeros(rate.size)
    return Record(
        source='by hand', dt=dt, rates=np.stack([rate, zero, zero], axis=1),
        control=np.stack([zero + 0.5, command, zero, zero], axis=1),
        angles=None if angle is None else np.stack([angle, zero, zero], axis=1),
        segments=segments,
    )


# the metric


def segment(role: str, start: float, end: float) -> Segment:
    return Segment(role, 'prbs', 'roll', 'attitude', start, end)


def test_windows_keep_off_starts_and_gaps_and_leave_no_part():
    """Segment 2..9.8 s, samples lost at 5.0 s: whole windows from 3.0 and from 6.004 s on."""
    n = round(12.0 / DT)
    rng = np.random.default_rng(0)
    rate = rng.standard_normal(n)
    lost = round(5.0 / DT)
    rate[lost] = np.nan
    data = axis_data(
        [record_of(rng.standard_normal(n), rate, segments=(segment('validation', 2.0, 9.8),))],
        'roll',
    )
    found = data.windows(data.validation)
    length = round(0.5 / DT)
    first = [750, 750 + length, 750 + 2 * length, 750 + 3 * length]
    after = [lost + 1 + 250 + i * length for i in range(7)]
    assert found.length == length
    assert found.starts.tolist() == first + after
    assert found.starts[3] + length <= lost
    assert found.starts[-1] + length <= round(9.8 / DT) < found.starts[-1] + 2 * length


@pytest.fixture(scope='module')
def flight(axis_type, flown):
    """30 s of the plain plant, data and a fitted base."""
    data = axis_data([flown(axis_type(), 5)], 'roll')
    base, model, sim = fit_base(data, data.train)
    return data, base, model, sim


def test_what_is_measured_inside_a_window_changes_nothing_there(flight):
    """Rate and angle overwritten inside one window: its prediction stays to the last bit."""
    data, base, model, _ = flight
    sim = simulator(data, data.validation, model.correction)
    structure = Structure().with_effect(by_name('pendulum_stiffness'), {})
    theta = np.r_[base.theta, 3.0]

    def predictions(one: Simulator) -> np.ndarray:
        return one.run(structure, theta).errors + one.measured

    plain = predictions(sim)
    for number in (0, 3, sim.windows.count - 1):
        start = sim.windows.starts[number]
        rate, angle = data.rate.copy(), data.angle.copy()
        rate[start : start + sim.windows.length] = 7.0
        angle[start : start + sim.windows.length] = -2.0
        again = predictions(
            simulator(dataclasses.replace(data, rate=rate, angle=angle), data.validation,
                      model.correction)
        )
        np.testing.assert_allclose(again[number], plain[number], rtol=0, atol=1e-12)
        np.testing.assert_allclose(again[:number], plain[:number], rtol=0, atol=1e-12)
        if number + 1 < sim.windows.count:
            assert np.abs(again[number + 1] - plain[number + 1]).max() > 1e-6


@pytest.mark.parametrize('lost_s', [0.0, 0.8])
def test_measurement_noise_is_what_was_added_gap_or_not(flight, lost_s):
    """0.005 rad/s of white noise, 6 %: neither torque noise nor the state after a gap count."""
    data = flight[0]
    (first, last), *_ = data.train
    gap = (first + last) // 2 + round(lost_s / DT)
    spans = ((first, (first + last) // 2), (gap, last))
    base, model, _ = fit_base(data, spans)
    assert base.noise_rms(model) == pytest.approx(0.005, rel=0.06)
    assert model.innovation_rms == pytest.approx(flight[2].innovation_rms, rel=0.05)


# the compiled loops against an ODE solver

HELD = np.random.default_rng(8).choice([-0.02, -0.005, 0.01, 0.02], 60).repeat(5)
THETA = (450.0, 0.042, 0.0055, 0.4, 0.2)


def solved(theta, torque=lambda _rate, _angle: 0.0, gyro_hz=None, start=(0.3, 0.1)):
    """(rate, angle, gyro) at each cycle by solve_ivp, restarted at every change of the command."""
    gain, lag, delay, damping, bias = theta
    wc = 2.0 * math.pi * (gyro_hz or 1.0)
    state = np.array([HELD[0], *start, start[0], 0.0])
    rows = [state]

    def slope(u):
        def derivative(_, x):
            motor = x[0] if lag else u
            turn = gain * motor - damping * x[1] + bias + torque(x[1], x[2])
            return [
                (u - x[0]) / lag if lag else 0.0, turn, x[1], x[4],
                wc**2 * (x[1] - x[3]) - math.sqrt(2.0) * wc * x[4],
            ]
        return derivative

    for k in range(HELD.size - 1):
        whole = int(delay / DT + 1e-9)
        late = delay - whole * DT
        parts = [(late, HELD[max(k - whole - 1, 0)]), (DT - late, HELD[max(k - whole, 0)])]
        for length, u in parts:
            if length > 1e-12:
                state = solve_ivp(
                    slope(u), (0.0, length), state, method='DOP853', rtol=1e-11, atol=1e-12
                ).y[:, -1]
        rows.append(state)
    table = np.array(rows)
    return table[:, 1], table[:, 2], table[:, 3]


def free_run(theta, rate, angle, structure, parameters=(), gyro_hz=None):
    """The simulator's own run from the first sample on, nothing corrected on the way."""
    data = axis_data([record_of(HELD, rate, angle)], 'roll')
    data = dataclasses.replace(data, gyro_filter_hz=gyro_hz)
    windows = Windows(np.array([1]), rate.size - 1, np.array([0]))
    sim = Simulator(data, ((0, rate.size),), windows, np.zeros(4))
    return (sim.run(structure, np.r_[theta, parameters]).errors + sim.measured)[0]


@pytest.mark.parametrize('lag', [0.0, 0.01, 0.042])
@pytest.mark.parametrize('delay', [0.0, 0.0013, 0.0055, 0.008])
def test_base_runs_as_the_ode_says(lag, delay):
    """Any lag, any fraction of a cycle of delay: 1e-6 rad/s over 1.2 s at up to 3 rad/s.

    No lag stands as one of 1 µs: 450 rad/s² of a step of 0.04 turn that into 2e-5 rad/s.
    """
    theta = (450.0, lag, delay, 0.4, 0.2)
    rate, angle, _ = solved(theta)
    assert np.ptp(rate) > 0.5
    found = free_run(theta, rate, angle, Structure())
    np.testing.assert_allclose(found, rate[1:], rtol=0, atol=1e-6 if lag else 2e-5)


@pytest.mark.parametrize(
    ('name', 'parameters', 'torque', 'tolerance'),
    [
        ('quadratic_drag', (0.8,), lambda r, _: -0.8 * r * abs(r), 1e-6),
        ('pendulum_stiffness', (9.0,), lambda _, a: -9.0 * math.sin(a), 1e-6),
        ('cubic_stiffness', (30.0,), lambda _, a: -30.0 * a**3, 1e-6),
        # a step of one cycle through the kink at rest: as near as a tenth of any gyro's noise
        ('coulomb_friction', (0.8,), lambda r, _: -0.8 * math.tanh(r / 0.01), 5e-4),
    ],
)
def test_torques_run_as_the_ode_says(name, parameters, torque, tolerance):
    structure = Structure().with_effect(by_name(name), {})
    rate, angle, _ = solved(THETA, torque)
    plain = free_run(THETA, rate, angle, Structure())
    assert np.abs(plain - rate[1:]).max() > 0.05
    found = free_run(THETA, rate, angle, structure, parameters)
    np.testing.assert_allclose(found, rate[1:], rtol=0, atol=tolerance)


def test_gyro_filter_runs_as_the_ode_says():
    """Starting at rest and filtered: 2e-5 rad/s, a parabola a cycle before a 42 Hz filter."""
    rate, angle, seen = solved(THETA, gyro_hz=GYRO_HZ, start=(0.0, 0.0))
    assert np.abs(seen - rate).max() > 0.005
    found = free_run(THETA, seen, angle, Structure(), gyro_hz=GYRO_HZ)
    np.testing.assert_allclose(found, seen[1:], rtol=0, atol=2e-5)


def test_response_of_the_drive_is_exact():
    """Rate and angle for unit gain against the solver: 1e-9 of their size."""
    rate, angle, _ = solved((1.0, 0.042, 0.0055, 0.0, 0.0), start=(0.0, 0.0))
    found = drive.response(HELD, ((0, HELD.size),), 0.042, 0.0055, None, DT, 'continuous')
    np.testing.assert_allclose(found[0], rate, rtol=0, atol=1e-9 * np.ptp(rate))
    np.testing.assert_allclose(found[2], angle, rtol=0, atol=1e-9 * np.ptp(angle))


# cross-validation


@pytest.mark.parametrize('friction', [0.0, 0.8])
def test_linearised_cross_validation_agrees_with_real_refits(axis_type, flown, friction):
    """Held-out error of every fold within 1 % of the one by models fitted without that fold."""
    axis = axis_type(torque=lambda rate, _: -friction * math.tanh(rate / 0.004))
    data = axis_data([flown(axis, 6)], 'roll')
    fit, _, sim = fit_base(data, data.train)
    if friction:
        fit = fit_with_effect(sim, fit, by_name('coulomb_friction'), {})
    quick = held_out_errors(fit, sim.windows, data.dt)
    for held, kept in folds_of(sim.windows, data.dt):
        assert not (held & kept).any()
        distance = np.abs(sim.windows.starts[held][:, None] - sim.windows.starts[kept]).min()
        assert distance * data.dt >= 1.0 + 0.5
        part = Windows(sim.windows.starts[kept], sim.windows.length, sim.windows.spans[kept])
        refitted = fit_structure(
            Simulator(data, sim.spans, part, sim.correction), fit.structure, fit.theta
        )
        real = np.mean(sim.run(fit.structure, refitted.theta).errors[held] ** 2, axis=1)
        assert np.mean(quick[held]) == pytest.approx(np.mean(real), rel=0.01)


# noise


@pytest.mark.parametrize('filtered', [False, True])
def test_predicted_error_is_what_noise_alone_makes(filtered):
    """Free run over 1600 s of nothing but noise, simulated at 4 kHz: the prediction within 4 %."""
    torque, measurement, damping = 0.05, 0.004, 0.4
    rng = np.random.default_rng(17)
    fine, n = 16, 400_000
    h = DT / fine
    wc = 2.0 * math.pi * GYRO_HZ
    pushes = torque * math.sqrt(h) * rng.standard_normal(n * fine)
    rate = seen = slope = 0.0
    truth = np.empty(n)
    decay = math.exp(-damping * h)
    for k in range(n):
        truth[k] = seen if filtered else rate
        for push in pushes[k * fine : (k + 1) * fine].tolist():
            slope += h * (wc**2 * (rate - seen) - math.sqrt(2.0) * wc * slope)
            seen += h * slope
            rate = decay * rate + push
    data = axis_data(
        [record_of(np.zeros(n), truth + measurement * rng.standard_normal(n),
                   segments=(segment('train', 0.0, n * DT),))], 'roll',
    )
    data = dataclasses.replace(data, gyro_filter_hz=GYRO_HZ if filtered else None)
    model = noise.white_noise_model(torque / measurement, damping, data, before_filter=False)
    run = simulator(data, data.train, model.correction).run(
        Structure(), np.array([0.0, 0.04, 0.008, damping, 0.0])
    )
    innovation = float(np.sqrt(np.nanmean(run.innovations[500:] ** 2)))
    assert innovation == pytest.approx(model.innovation_rms * measurement, rel=0.02)
    model = noise.scaled(model, innovation)
    assert model.torque == pytest.approx(torque, rel=0.03)
    length = round(0.5 / DT)
    assert run.rms == pytest.approx(
        noise.predicted_rms(model, damping, data, length), rel=0.04
    )


# the minimiser

NONE = (np.array([-np.inf, -np.inf]), np.array([np.inf, np.inf]))
ONES = np.ones(2)


def rosenbrock(x):
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


def test_blocks_that_agree_to_the_last_digit_promise_no_certainty():
    windows = Windows(np.arange(40) * 125, 2, np.zeros(40, dtype=np.int64))
    jacobian = np.ones((40, 2, 1))
    errors = np.tile([[0.1, 0.1], [-0.1, -0.1]], (20, 1))  # no block is off, each window is
    with np.errstate(all='raise'):
        covariance = robust_covariance(
            jacobian, errors, np.array([False]), windows, 0.004, np.zeros((0, 1))
        )
    # two samples of a window say the same: 40 values of 0.1, each counted once
    assert covariance[0, 0] == pytest.approx(0.1**2 / 40, rel=0.05)


def test_a_linear_problem_is_solved_at_once():
    a = np.random.default_rng(3).standard_normal((50, 2)) * [1.0, 1e4]
    b = a @ [2.0, -3e-4] + 0.1
    found = levenberg.minimise(lambda x: a @ x - b, np.zeros(2), *NONE, np.array([1.0, 1e-4]))
    np.testing.assert_allclose(found.theta, np.linalg.lstsq(a, b, rcond=None)[0], rtol=1e-4)
    assert found.converged
    assert found.iterations <= 4


def test_rosenbrocks_valley():
    found = levenberg.minimise(
        rosenbrock, np.array([-1.2, 1.0]), *NONE, ONES, max_iterations=100, tolerance=1e-12
    )
    np.testing.assert_allclose(found.theta, [1.0, 1.0], atol=1e-5)
    assert not found.at_bound.any()


def test_a_bound_holds_and_is_told():
    """With x <= 0.5 the valley's lowest point is (0.5, 0.25)."""
    found = levenberg.minimise(
        rosenbrock, np.array([-1.2, 1.0]), NONE[0], np.array([0.5, np.inf]), ONES,
        max_iterations=100, tolerance=1e-12,
    )
    np.testing.assert_allclose(found.theta, [0.5, 0.25], atol=1e-6)
    assert found.at_bound.tolist() == [True, False]


def test_a_bound_where_the_search_starts_lets_go():
    found = levenberg.minimise(
        lambda x: x - np.array([2.0, -1.0]), np.zeros(2), np.zeros(2), np.array([9.0, 9.0]), ONES
    )
    np.testing.assert_allclose(found.theta, [2.0, 0.0], atol=1e-6)
    assert found.at_bound.tolist() == [False, True]


def test_a_start_outside_is_brought_inside():
    tried = []

    def residual(x):
        tried.append(x.copy())
        return x - 5.0

    found = levenberg.minimise(residual, np.full(2, 20.0), np.zeros(2), np.ones(2), ONES)
    assert found.theta.tolist() == [1.0, 1.0]
    assert found.converged
    assert all(((x >= 0.0) & (x <= 1.0)).all() for x in tried)


def test_a_residual_that_blows_up_is_stepped_back_from():
    """exp fits from a start whose full step overflows; the answer to 1e-4."""
    t = np.linspace(0.0, 2.0, 40)
    target = 3.0 * np.exp(1.5 * t)
    with np.errstate(over='ignore', invalid='ignore'):
        found = levenberg.minimise(
            lambda x: x[0] * np.exp(x[1] * t) - target, np.array([1.0, -3.0]), *NONE, ONES,
            max_iterations=200, tolerance=1e-12,
        )
    np.testing.assert_allclose(found.theta, [3.0, 1.5], rtol=1e-4)
