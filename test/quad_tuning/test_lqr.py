"""The LQR: against the Riccati equation, robust over draws, no standing error, honest limits."""

import dataclasses

import numpy as np
import pytest

from quad_sysid.loop.cascade import closed_loop_radius
from quad_sysid.loop.from_model import loop_plant
from quad_tuning import ensemble as ensembles
from quad_tuning.assess import Requirements
from quad_tuning.bounds import flown_gains
from quad_tuning.errors import DesignRefusedError
from quad_tuning.lqr import Noise, Weights, design_lqr, propose_lqr, way_is_safe
from quad_tuning.state_feedback import beside, simulate


def loops_of(m, seed=3):
    return ensembles.build(m, np.random.default_rng(seed))


@pytest.fixture(scope='module')
def proposed(model):
    return propose_lqr(model())


@pytest.mark.parametrize('values', [{}, {'lag': 0.09, 'delay': 0.016}])
def test_margins_hold_over_fresh_draws(model, proposed, values):
    m = model(**values)
    found = propose_lqr(m) if values else proposed
    said = found.figures
    assert said['worst_phase_margin_deg'] >= 45.0
    assert said['worst_gain_margin_db'] >= 8.0
    assert said['worst_peak_sensitivity'] <= 1.8
    assert closed_loop_radius(found.controller, loops_of(m, 77).cycle).max() < 1.0
    # eight times the gain is beyond any gain margin that was found
    shaky = loops_of(model(**{**values, 'gain': 8 * 450.0})).cycle
    assert closed_loop_radius(found.controller, shaky).max() >= 1.0


def test_feedback_solves_the_riccati_equation_and_beats_its_neighbours(model):
    """Cost of the feedback from a 0.1 rad offset, the delay included: no perturbed gain is better.

    The delay only shifts the states that count, so the predicted ones are weighted.
    """
    best_of_all, f = design_lqr(loop_plant(model()), loops_of(model()), 0.3)
    w = Weights()

    def cost(controller):
        own, error, rate, sums = np.zeros(controller.size), -0.1, 0.0, np.zeros(4)
        commands, drive = [0.0] * controller.late, 0.0
        for _ in range(4000):
            u, own = controller.command(own, rate, error)
            own = controller.moved(own, error, u)
            commands.append(u)
            acting = commands[-1 - controller.late]
            if len(commands) > 2 * controller.late:  # before, no command has come through
                sums += (rate**2, error**2, (own[2]) ** 2, acting**2)
            following, after = controller._moved(drive, rate, acting)
            error -= 0.5 * controller.dt * (rate + after)
            drive, rate = following, after
        return (
            np.sqrt(f) * sums[0] / w.rate**2 + sums[1] / w.angle**2
            + sums[2] / np.sqrt(f) / w.integral**2 + f * sums[3] / w.control**2
        )

    names = ('k_angle', 'k_rate', 'k_drive', 'k_integral')
    best, rng = cost(best_of_all), np.random.default_rng(2)
    for _ in range(10):
        other = {n: getattr(best_of_all, n) * (1 + rng.normal(0, 0.1)) for n in names}
        assert cost(dataclasses.replace(best_of_all, **other)) > 0.999 * best


def test_integral_action_removes_a_standing_torque(model, proposed):
    found, said = proposed, proposed.figures
    # a constant torque acts like a constant command behind the plant's gain
    weaker = loop_plant(model(gain=0.8 * 450.0))
    angle = simulate(weaker, found.controller, np.full(6000, 0.2)).angle
    assert angle[-1] == pytest.approx(0.2, rel=2e-3)
    assert said['disturbance_rms_rad'] < said['disturbance_rms_rad_before']
    noise = 0.01 * np.random.default_rng(4).standard_normal(20_000)
    still = simulate(loop_plant(model()), found.controller, np.zeros(noise.size), noise=noise)
    assert said['motor_noise_rms'] == pytest.approx(np.std(still.control), rel=0.08)


def test_shares_of_it_beside_the_cascade_are_safe_and_the_whole_is_itself(model):
    m = model()
    loops, active = loops_of(m), flown_gains(m)
    found, _ = design_lqr(loop_plant(m), loops, 0.3)
    assert way_is_safe(found, active, loops)
    whole = beside(found, active, 1.0).response(loops.omega, m.dt)
    own = found.response(loops.omega, m.dt)
    np.testing.assert_allclose(whole, own, rtol=1e-9)
    shaky = dataclasses.replace(active, rate_kp=6.0 * active.rate_kp)
    assert closed_loop_radius(beside(found, shaky, 0.25), loops.cycle).max() >= 1.0


@pytest.mark.usefixtures('few_draws')
def test_what_cannot_be_is_refused(model):
    m = model()
    with pytest.raises(DesignRefusedError, match='no LQR keeps the margins'):
        design_lqr(
            loop_plant(m), loops_of(m), 0.3, noise=Noise(), needs=Requirements(89.0, 30.0, 1.01)
        )
    with pytest.raises(DesignRefusedError, match=r'raise the tracking error by \d+ %; the delay'):
        propose_lqr(model(lag=0.1, delay=0.02))
    with pytest.raises(DesignRefusedError, match='lowers the rate'):
        propose_lqr(model(gain=-450.0))
    with pytest.raises(DesignRefusedError, match='gains that flew are unstable'):
        propose_lqr(dataclasses.replace(m, active_gains={**m.active_gains, 'roll.rate.kp': 0.22}))
    with pytest.raises(DesignRefusedError, match='only the firmware of this project has a state'):
        propose_lqr(dataclasses.replace(m, active_gains={**m.active_gains, 'roll.rate.kff': 0.0}))
