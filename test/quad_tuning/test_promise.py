"""What a design promises to the watch is what the rates do under the same gusts."""

import dataclasses

import numpy as np
import pytest

from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.from_model import loop_plant
from quad_sysid.loop.simulation import simulate_cascade
from quad_tuning import ensemble as ensembles
from quad_tuning.promise import GUST_RAD_S, promise

BEFORE = CascadeGains.default('roll')
AFTER = dataclasses.replace(BEFORE, rate_kp=1.5 * BEFORE.rate_kp, angle_kp=6.0)


def test_the_promised_change_of_the_rate_is_that_of_the_simulation(model):
    m, rng = model(), np.random.default_rng(3)
    said = promise(ensembles.build(m, np.random.default_rng(0), 8), BEFORE, AFTER, 0.043)
    gusts, state = np.empty(50_000), 0.0
    for k, push in enumerate(rng.normal(size=gusts.size)):
        state += GUST_RAD_S * m.dt * (push - state)
        gusts[k] = state
    flown = [
        simulate_cascade(loop_plant(m), g, np.zeros(gusts.size), m.dt, disturbance=gusts).rate
        for g in (BEFORE, AFTER)
    ]
    ratio = np.std(flown[1]) / np.std(flown[0])
    assert said['rate_rms_ratio'] == pytest.approx(ratio, rel=0.05)
    assert said['oscillation_ratio'] > said['rate_rms_ratio']
    assert 0.99 < said['peak'] < 1.8


def test_the_same_gains_promise_no_change(model):
    said = promise(ensembles.build(model(), np.random.default_rng(0), 8), BEFORE, BEFORE, 0.043)
    assert said['rate_rms_ratio'] == said['oscillation_ratio'] == 1.0
