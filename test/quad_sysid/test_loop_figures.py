"""Step and square-wave figures against closed forms."""

import numpy as np
import pytest

from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.loop.figures import compare_square, square_figures, square_wave, step_figures

DT = 0.004


def first_order(reference, tau):
    y = np.zeros(reference.size)
    y[0] = reference[0]
    share = 1 - np.exp(-DT / tau)
    for k in range(1, reference.size):
        y[k] = y[k - 1] + share * (reference[k - 1] - y[k - 1])
    return y


def test_first_order_step():
    """Rise time ln 9 tau, settling to 5 % after 3 tau, no overshoot."""
    t = np.arange(1000) * DT
    f = step_figures(1 - np.exp(-t / 0.2), DT)
    assert f.rise_time_s == pytest.approx(np.log(9) * 0.2, abs=0.5 * DT)
    assert f.settling_time_s == pytest.approx(3 * 0.2, abs=2 * DT)
    assert f.overshoot_pct == pytest.approx(0.0, abs=0.1)
    assert f.final_error_pct == pytest.approx(0.0, abs=0.1)


def test_second_order_overshoot():
    """exp(-pi zeta / sqrt(1 - zeta^2)) at zeta 0.5: 16.3 %."""
    t = np.arange(2000) * DT
    wd = 5 * np.sqrt(0.75)
    y = 1 - np.exp(-2.5 * t) * (np.cos(wd * t) + 2.5 / wd * np.sin(wd * t))
    assert step_figures(y, DT).overshoot_pct == pytest.approx(16.3, abs=0.2)


def test_square_of_a_noisy_measurement_gives_the_figures_of_the_clean_one():
    rng = np.random.default_rng(3)
    r = square_wave(0.2, 2.0, 4, DT)
    y = first_order(r, 0.2)
    clean = square_figures(r, y, DT)
    noisy = square_figures(r, y + rng.normal(0, 0.004, y.size), DT)
    assert clean.edges == noisy.edges == 8
    assert clean.step_rad == pytest.approx(0.4)
    assert clean.rise_time_s == pytest.approx(np.log(9) * 0.2, abs=DT)
    assert noisy.rise_time_s == pytest.approx(clean.rise_time_s, rel=0.05)
    # error decays exp(-t/tau) from each edge; 8 of 9 half periods hold one
    want = 0.4 * np.sqrt(0.2 / 2 / 2.0 * 8 / 9)
    assert clean.rms_error_rad == pytest.approx(want, rel=0.02)


def test_a_gap_drops_its_edge_and_a_ramp_is_no_edge():
    r = square_wave(0.2, 2.0, 3, DT)
    y = first_order(r, 0.2)
    y[1700:1720] = np.nan
    assert square_figures(r, y, DT).edges == 5
    with pytest.raises(NotInformativeError, match='no edge'):
        square_figures(np.linspace(0, 1, 500), np.linspace(0, 1, 500), DT)
    with pytest.raises(NotInformativeError, match='no finite'):
        square_figures(np.full(50, np.nan), np.zeros(50), DT)


def test_standing_error_is_reported_and_not_mixed_into_the_rise_time():
    r = square_wave(0.2, 2.0, 4, DT)
    f = square_figures(r, first_order(0.9 * r, 0.2), DT)
    assert f.rise_time_s == pytest.approx(np.log(9) * 0.2, abs=2 * DT)
    assert f.final_error_pct == pytest.approx(5.0, abs=0.6)
    assert f.overshoot_pct < 0.5


def test_compare_two_flights():
    r = square_wave(0.2, 2.0, 4, DT)
    small = square_wave(0.1, 2.0, 4, DT)
    c = compare_square((r, first_order(r, 0.2)), (small, first_order(small, 0.1)), DT)
    assert c.rise_time_change_pct == pytest.approx(-50, abs=1.5)
    assert c.rms_error_change_pct == pytest.approx(100 * (np.sqrt(0.5) - 1), abs=2)
    assert c.overshoot_change_points == pytest.approx(0.0, abs=0.5)


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(BadInputError, match='one length'):
        square_figures(np.zeros(5), np.zeros(6), DT)
    with pytest.raises(BadInputError, match='10 samples'):
        step_figures(np.ones(4), DT)
