"""The LQR: against the Riccati equation, robust over draws, no standing error, honest limits."""

import dataclasses

import numpy as np
import pytest

from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.plant import state_space
from quad_tuning import ensemble as ensembles
from quad_tuning.errors import DesignRefusedError
from quad_tuning.lqr import Noise, Weights, design_lqr, simulate_lqr, stable
from quad_tuning.lqr_proposal import propose_lqr
from quad_tuning.pid import Requirements


def loops_of(m, seed=3):
    return ensembles.build(m, np.random.default_rng(seed))


@pytest.mark.parametrize('values', [{}, {'delay': 0.0016}, {'lag': 0.09, 'delay': 0.016}])
def test_margins_hold_over_fresh_draws(model, values):
    m = model(**values)
    found = propose_lqr(m)
    assert found.figures['worst_phase_margin_deg'] >= 45.0
    assert found.figures['worst_gain_margin_db'] >= 8.0
    assert found.figures['worst_peak_sensitivity'] <= 1.8
    assert stable(found.controller, loops_of(m, 77))
    # eight times the gain is beyond any gain margin that was found
    assert not stable(found.controller, loops_of(model(**{**values, 'gain': 8 * 450.0})))


def test_feedback_solves_the_riccati_equation_and_beats_its_neighbours(model):
    """Cost of the state feedback from a 0.1 rad offset: no perturbed gain does better."""
    m = model()
    d = design_lqr(loop_plant(m), loops_of(m), 0.3)
    c, w, f = d.controller, Weights(), d.control_weight
    n = c.a.shape[0]
    a = np.zeros((n + 1, n + 1))
    a[:n, :n], a[n, :n], a[n, n] = c.a, -c.dt * c.c[1], 1.0
    b = np.append(c.b[:, 0], 0.0)

    def cost(gain):
        x = np.zeros(n + 1)
        x[2] = x[4] = 0.1
        total = 0.0
        for _ in range(4000):
            u = -gain @ x
            total += (
                np.sqrt(f) * x[1] ** 2 / w.rate_rad_s**2
                + x[2] ** 2 / w.angle_rad**2
                + x[n] ** 2 / np.sqrt(f) / w.integral_rad_s**2
                + f * u**2 / w.control**2
            )
            x = a @ x + b * u
        return total

    best = np.append(c.feedback, c.integral_gain)
    rng = np.random.default_rng(2)
    for _ in range(12):
        assert cost(best * (1 + rng.normal(0, 0.1, n + 1))) > cost(best)


def test_integral_action_removes_a_standing_torque(model):
    """A constant torque the design does not know: the angle returns to within 0.2 % of 0.2 rad."""
    m = model()
    plant = loop_plant(m)
    d = design_lqr(plant, loops_of(m), 0.3)
    exact = state_space(plant)
    # a constant torque acts like a constant command behind the plant's gain
    weaker = dataclasses.replace(exact, b=exact.b * 0.8)
    angle = simulate_lqr(weaker, d.controller, np.full(6000, 0.2))
    assert angle[-1] == pytest.approx(0.2, rel=2e-3)


def test_figures_of_a_torque_step_and_of_noise(model):
    """Integral action: a torque step leaves less than the cascade; noise as in a simulation."""
    m = model()
    found = propose_lqr(m)
    assert found.figures['disturbance_rms_rad'] < found.figures['disturbance_rms_rad_before']
    c, plant = found.controller, state_space(loop_plant(m))
    rng = np.random.default_rng(4)
    x, guess, total, controls = np.zeros(c.a.shape[0]), np.zeros(c.a.shape[0]), 0.0, []
    for noise in 0.01 * rng.standard_normal(20_000):
        y = plant.c @ x + (noise, 0.0)
        guess = guess + c.observer @ (y - c.c @ guess)
        u = -float(c.feedback @ guess) - c.integral_gain * total
        total -= c.dt * y[1]
        guess = c.a @ guess + c.b[:, 0] * u
        x = plant.a @ x + plant.b[:, 0] * u
        controls.append(u)
    assert found.figures['motor_noise_rms'] == pytest.approx(np.std(controls), rel=0.08)


def test_the_loop_is_the_one_the_time_simulation_runs(model):
    """Step of the linear loop settles, with overshoot under 10 %, as the margins promise."""
    m = model()
    d = design_lqr(loop_plant(m), loops_of(m), 0.3)
    assert d.square.overshoot_pct < 10.0
    assert 0.1 < d.square.rise_time_s < 0.6
    a, b, c, dd = d.controller.dynamics()
    y = np.random.default_rng(1).normal(size=(50, 2)) * 1e-3
    x = np.zeros(a.shape[0])
    guess, total = np.zeros(d.controller.a.shape[0]), 0.0
    for row in y:
        want = (c @ x + dd @ row)[0]
        guess = guess + d.controller.observer @ (row - d.controller.c @ guess)
        u = -d.controller.feedback @ guess - d.controller.integral_gain * total
        assert u == pytest.approx(want, abs=1e-12)
        total -= d.controller.dt * row[1]
        guess = d.controller.a @ guess + d.controller.b[:, 0] * u
        x = a @ x + b @ row


def test_what_cannot_be_is_refused(model):
    m = model()
    with pytest.raises(DesignRefusedError, match='no LQR keeps the margins'):
        design_lqr(
            loop_plant(m), loops_of(m), 0.3, noise=Noise(), needs=Requirements(89.0, 30.0, 1.01)
        )
    with pytest.raises(DesignRefusedError, match='lowers the rate'):
        propose_lqr(model(gain=-450.0))
