"""Two of the bench's 100 airframes: identified from their own flight, designed, flown again."""

import sys
from pathlib import Path

import numpy as np
import pytest

BENCH = Path(__file__).parents[2] / 'bench'


@pytest.fixture(scope='module')
def bench():
    """The bench's modules; they import each other by name, as when run from their folder."""
    sys.path.insert(0, str(BENCH))
    try:
        import tuning
        import tuning_airframes
        import tuning_peers
    finally:
        sys.path.remove(str(BENCH))
    return {'run': tuning, 'airframes': tuning_airframes, 'peers': tuning_peers}


@pytest.mark.parametrize('number', [2, pytest.param(9, marks=pytest.mark.long)])
def test_an_airframe_is_better_with_the_gains_from_its_own_flight(bench, number):
    """Hover; rig with a dead zone. Promise within 5 points, 0.85 of what the true plant allows."""
    run, airframe = bench['run'], bench['airframes'].draw(100, 1000)[number]
    ours, best = run.tuned(airframe, None, peers=False)
    assert ours.refused_because == ''
    assert not ours.unstable
    assert ours.improvement_pct > 10.0
    assert ours.improvement_pct == pytest.approx(ours.predicted_pct, abs=5.0)
    assert ours.improvement_pct > 0.85 * best.improvement_pct
    assert abs(ours.rise_time_error_pct) < 10.0
    assert ours.phase_margin_deg > 44.0


def test_the_draw_covers_what_was_asked_for(bench):
    frames = bench['airframes'].draw(100, 1000)
    inertia = np.array([f.inertia for f in frames])
    lags = np.array([f.lag_s for f in frames])
    assert inertia.min() < 0.65
    assert inertia.max() > 1.35
    assert lags.min() < 0.025
    assert lags.max() > 0.085
    assert {f.mount for f in frames} == {'rig', 'hover'}
    assert {f.delay_cycles for f in frames} >= {1, 2, 3}
    assert sum(bool(f.effect) for f in frames) == 50
    assert len({f.effect for f in frames}) == 13


def test_an_oscillation_and_a_loss_are_counted(bench):
    """Gains that shake the axis are told from good ones by the flight alone."""
    run = bench['run']
    airframe = bench['airframes'].draw(100, 1000)[4]
    shaken = {'pitch.rate.kp': 0.4, 'pitch.angle.kp': 6.0, 'pitch.rate.kd': 0.0}
    assert run.judged(bench['airframes'].second_flight(airframe, shaken)).unstable
    assert not run.judged(bench['airframes'].second_flight(airframe, {})).unstable
    rows = [run.Outcome('identified', '', c, u, rise_time_error_pct=2.0, seconds=1.0)
            for c, u in ((30.0, False), (-6.0, True), (20.0, False))]
    rows.append(run.Outcome('identified', 'too short', 0.0, False))
    figures = run.summary(rows)
    assert (figures['airframes'], figures['unstable'], figures['refused']) == (4, 1, 1)
    assert figures['worse_than_5pct'] == 1
    assert figures['median_improvement_pct'] == 10.0
    assert len(run.missed(figures)) == 4


def test_peers_recover_a_plant_of_their_own_structure(bench):
    """RLS on noise-free data of two poles and three zeros; the rule on an integrator by hand."""
    peers = bench['peers']
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal(4000), np.zeros(4000)
    for k in range(3, 4000):
        y[k] = 1.6 * y[k - 1] - 0.64 * y[k - 2] + 0.5 * u[k - 1] + 0.2 * u[k - 2] - 0.1 * u[k - 3]
    found = peers._recursive_least_squares(u, y, 0.9999)
    np.testing.assert_allclose(found, [-1.6, 0.64, 0.5, 0.2, -0.1], atol=1e-4)
    # Delta A E + q^-2 F must be the reference model P
    dt, (a1, a2) = 0.008, (-1.6, 0.64)
    kc, ki, kd = peers._gmvc(a1, a2, 0.6, dt)
    pole = np.exp(-2 * dt / peers.RISE_TIME_S)
    e1 = 1.0 - 2.0 * pole - a1
    nu = peers.DETUNING + (1.0 + e1) * 0.6
    f2, f1 = kc * kd / dt * nu, -kc * (1 + 2 * kd / dt) * nu
    f0 = kc * (1 + dt * ki + kd / dt) * nu
    left = np.convolve(np.convolve([1, -1], [1, a1, a2]), [1, e1])
    left[2:] += (f0, f1, f2)
    np.testing.assert_allclose(left, [1, -2 * pole, pole**2, 0, 0], atol=1e-9)
