"""The far end's own way to integrate its angle: found in a record, flown in simulation."""

from __future__ import annotations

import numpy as np
import pytest

from quad_sysid.loop.angle_lead import angle_lead_s
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.plant import LoopPlant
from quad_sysid.loop.simulation import simulate_cascade, simulate_polynomial_cascade
from quad_sysid.pipeline.approaches import approaches, controller, reproduced
from quad_sysid.record import IOData
from quad_sysid.signals.prbs import prbs

DT = 0.01
GAINS = CascadeGains.default('roll')
PLANT = LoopPlant(gain=450.0, lag_s=0.045, delay_s=0.02, damping=0.4, bias=0.0, dt=DT,
                  gyro_filter_hz=None)
REFERENCE = 0.2 * np.sign(np.sin(2 * np.pi * 0.4 * DT * np.arange(2000) + 1e-9))


def rates() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.convolve(rng.standard_normal(3000), np.ones(9) / 9, 'same')


@pytest.mark.parametrize('share', [0.5, 0.8, 1.0])
def test_the_lead_is_that_of_the_integration(share):
    rate = rates()
    steps = DT * (share * rate[1:] + (1.0 - share) * rate[:-1])
    drift = 1e-5 * np.random.default_rng(1).standard_normal(rate.size)
    angle = np.concatenate(([0.3], 0.3 + np.cumsum(steps))) + drift
    assert angle_lead_s(angle, rate, DT) == pytest.approx((share - 0.5) * DT, abs=0.02 * DT)
    angle[100:110] = np.nan
    assert angle_lead_s(angle, rate, DT) == pytest.approx((share - 0.5) * DT, abs=0.02 * DT)


def test_an_angle_of_another_source_has_no_lead():
    rate = rates()
    assert angle_lead_s(None, rate, DT) == 0.0
    assert angle_lead_s(0.1 * np.random.default_rng(2).standard_normal(3000), rate, DT) == 0.0
    assert angle_lead_s(np.zeros(3000), np.zeros(3000), DT) == 0.0


def test_a_firmware_that_adds_the_newest_rate_flies_as_the_simulation_with_half_a_cycle():
    """The loop by hand with angle += dt rate(k), the firmware's rectangles, on a polynomial."""
    a, b = np.array([1.0, -1.78, 0.784]), np.array([0.0, 0.0, 0.4, 0.35])
    n = REFERENCE.size
    rate, u, angle = np.zeros(n), np.zeros(n), 0.0
    integral, last, d_part = 0.0, 0.0, 0.0
    weight = DT / (DT + 1.0 / (2.0 * np.pi * GAINS.d_filter_hz))
    for k in range(n):
        rate[k] = sum(b[i] * u[k - i] for i in range(2, 4) if k >= i)
        rate[k] -= sum(a[i] * rate[k - i] for i in range(1, 3) if k >= i)
        angle += DT * rate[k]
        error = np.clip(GAINS.angle_kp * (REFERENCE[k] - angle), -4.0, 4.0) - rate[k]
        integral += GAINS.rate_ki * error * DT
        d_part += weight * ((rate[k] - last) / DT - d_part)
        last = rate[k]
        u[k] = np.clip(GAINS.rate_kp * error + integral - GAINS.rate_kd * d_part, -0.3, 0.3)
    found = simulate_polynomial_cascade(a, b, GAINS, REFERENCE, DT, angle_lead_s=0.5 * DT)
    assert np.abs(found.rate - rate).max() < 1e-9 * np.abs(rate).max()
    plain = simulate_polynomial_cascade(a, b, GAINS, REFERENCE, DT)
    assert np.abs(plain.rate - rate).max() > 0.01 * np.abs(rate).max()


def test_the_plant_behind_the_loop_feels_the_lead_and_gives_it_back():
    led = simulate_cascade(PLANT, GAINS, REFERENCE, DT, angle_lead_s=0.5 * DT)
    plain = simulate_cascade(PLANT, GAINS, REFERENCE, DT)
    assert np.std(led.rate - plain.rate) > 0.01 * np.std(plain.rate)
    assert angle_lead_s(led.angle, led.rate, DT) == pytest.approx(0.5 * DT, rel=0.1)
    assert angle_lead_s(plain.angle, plain.rate, DT) == pytest.approx(0.0, abs=0.05 * DT)


@pytest.mark.parametrize('lead', [0.0, 0.5])
def test_the_indirect_approach_takes_the_integration_that_gives_the_recorded_command(lead):
    a, b = np.array([1.0, -1.78, 0.784]), np.array([0.0, 0.0, 0.4, 0.35])
    reference = np.resize(prbs(9, 10, 0.2, 1), 4000)
    run = simulate_polynomial_cascade(a, b, GAINS, reference, DT, angle_lead_s=lead * DT)
    z = IOData(run.control, run.rate, DT, r=reference)
    _, known = approaches(z, GAINS, behind_attitude=True, one_loop=True, closed=True)
    # limits aside it is the very command; the other integration is half a cycle out
    assert reproduced(z, known) > 99.9
    other = controller(GAINS, DT, trapezoid=lead > 0.0)
    assert reproduced(z, other) < 99.5
