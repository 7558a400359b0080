"""The error in the simulated loop: every flight, every injection, lost references held."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.plant import LoopPlant
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.model import AxisModel, Parameter
from quad_sysid.model.data import axis_data
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.pipeline.step_b import closed_loop
from quad_sysid.record import GainChange, Record, Segment
from quad_sysid.signals.waveforms import prbs

DT, N, NOISE = 0.004, 5000, 0.01
TRUE = {'gain': 450.0, 'lag': 0.04, 'delay': 0.008, 'damping': 0.4, 'bias': 0.2}
PLANT = LoopPlant(gain=450.0, lag_s=0.04, delay_s=0.008, damping=0.4, bias=0.2, dt=DT,
                  gyro_filter_hz=None)
GAINS = CascadeGains.default('roll')
FASTER = replace(GAINS, rate_kp=1.5 * GAINS.rate_kp)
MODEL = AxisModel('roll', DT, None, tuple(Parameter(n, v, None, '') for n, v in TRUE.items()),
                  active_gains=GAINS.to_mapping('roll', constants=True))
SPANS = (('train', 0.0, 10.0), ('validation', 10.0, 20.0))


def flight(
    injection: str = 'attitude', gains: CascadeGains = GAINS, seed: int = 1
) -> Record:
    """Roll in the cascade, excited where `injection` says."""
    signal = {'attitude': 0.2, 'rate': 0.5, 'control': 0.03}[injection] * np.resize(
        prbs(8, 24, 1.0, seed), N)
    behind = {} if injection == 'attitude' else {f'{injection}_excitation': signal}
    reference = np.zeros(N) if behind else signal
    noise = NOISE * np.random.default_rng(seed).standard_normal(N)
    run = simulate_cascade(PLANT, gains, reference, DT, noise=noise, **behind)
    roll = [np.outer(x, [1.0, 0.0, 0.0]) for x in (
        run.rate, run.angle, reference, signal, run.control)]
    return Record(
        'flight', DT, roll[0], np.column_stack((0.5 + 0 * signal, roll[4])),
        angles=roll[1], attitude_setpoint=roll[2], excitation=roll[3],
        segments=tuple(Segment(r, 'prbs', 'roll', injection, a, b) for r, a, b in SPANS),
        gains=(GainChange(0.0, gains.to_mapping('roll', constants=True)),),
    )


def figures(*records: Record):
    answer = AxisAnswer('roll', 250.0, (), 'no_missing_effect', '', model=MODEL)
    return closed_loop(answer, records, axis_data(records, 'roll'))


@pytest.mark.parametrize('injection', ['attitude', 'rate', 'control'])
def test_the_true_model_leaves_the_noise_wherever_the_excitation_acts(injection):
    found = figures(flight(injection))
    # the noise, and what of it the loop feeds back: 0.01 to 0.015 rad/s here
    assert NOISE < found.rms_after < 1.6 * NOISE
    assert found.time_s[0] == pytest.approx(10.0)


def test_a_flight_without_gains_is_left_out_of_the_figure():
    """So is one whose excitation behind C1 was not recorded; a lost reference is held."""
    faster = flight(seed=2, gains=FASTER)  # counts under its own gains
    found = figures(flight(), faster, replace(flight(seed=3), gains=()))
    assert found.time_s.size == 2 * 2500
    assert NOISE < found.rms_after < 1.6 * NOISE
    wrong = replace(faster, gains=flight().gains)
    assert figures(flight(), wrong).rms_after > 3.0 * NOISE
    assert figures(replace(flight(), gains=())) is None
    assert figures(replace(flight('control'), excitation=None)) is None
    reference = flight().attitude_setpoint.copy()
    reference[[0, 3000, 3001], 0] = np.nan
    held = figures(replace(flight(), attitude_setpoint=reference))
    assert NOISE < held.rms_after < 1.6 * NOISE
