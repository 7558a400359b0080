"""Feedback from rate to command: shown, excluded with proof, or neither."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from quad_sysid.blackbox import bj, residual_test
from quad_sysid.loop.cascade import CascadeGains
from quad_sysid.loop.plant import plant_like
from quad_sysid.loop.simulation import simulate_cascade
from quad_sysid.pipeline.selection import feedback
from quad_sysid.pipeline.step_b import loop_of
from quad_sysid.record import IOData, Record, Segment
from quad_sysid.signals.waveforms import prbs

DT, N = 0.004, 10_000
GAINS = CascadeGains.default('yaw')
PLANT = plant_like('roll', np.array([12.0, 0.05, 0.02, 0.6, 0.0]), DT, None)


@pytest.fixture(scope='module')
def yaw():
    """The cascade on a slow axis: its command swings so far that the rate's noise drowns in it."""
    reference = np.resize(prbs(9, 24, 0.2, 3), N)
    noise = 0.0015 * np.random.default_rng(0).standard_normal(N)
    run = simulate_cascade(PLANT, GAINS, reference, DT, noise=noise)
    return IOData(run.control - run.control.mean(), run.rate - run.rate.mean(), DT, r=reference)


def shown(z, gains=None, *, through=False, nk=2):
    return feedback(z, bj(z, 2, 2, 2, 2, nk), gains, behind_attitude=True, through=through)


def test_the_recorded_controller_is_feedback_though_no_residual_predicts_the_command(yaw):
    test = residual_test(replace(yaw, r=None), bj(yaw, 2, 2, 2, 2, 4))
    assert test.p_causal > 0.01  # the test that was taken as proof of an open loop
    assert shown(yaw, GAINS, through=True, nk=4) is True


def test_a_controller_that_is_not_known_leaves_it_open(yaw):
    other = replace(GAINS, rate_kp=20.0 * GAINS.rate_kp)
    assert shown(yaw, None, nk=4) is None
    assert shown(yaw, other, nk=4) is None
    assert shown(yaw, None, through=True, nk=4) is None


def open_loop(u: np.ndarray, feedback_gain: float = 0.0) -> IOData:
    """A second-order plant behind u, measured with noise of 0.01 rad/s that a gain feeds back."""
    v = 0.01 * np.random.default_rng(1).standard_normal(u.size)
    x, y, command = np.zeros(u.size), np.zeros(u.size), u.copy()
    for i in range(u.size):
        x[i] = 1.85 * x[i - 1] - 0.855 * x[i - 2] + 0.04 * (command[i - 2] + command[i - 3])
        y[i] = x[i] + v[i]
        command[i] = u[i] - feedback_gain * y[i]
    return IOData(command, y, DT)


RNG = np.random.default_rng(2)
CHIRP = 0.02 * signal.chirp(np.arange(N) * DT, 0.1, N * DT, 5.0) + 1e-5 * RNG.standard_normal(N)
PRBS = np.resize(prbs(9, 24, 0.02, 1), N)


@pytest.mark.parametrize('command', [PRBS, CHIRP], ids=['prbs', 'chirp'])
def test_an_open_loop_is_told_where_the_command_proves_it(command):
    assert shown(open_loop(command)) is False
    assert shown(open_loop(command, 0.1)) is True


def test_gains_in_the_record_leave_open_what_no_residual_shows():
    z = open_loop(CHIRP)
    assert feedback(z, bj(z, 2, 2, 2, 2, 2), GAINS, behind_attitude=False, through=False) is None


def test_an_excitation_in_front_of_the_controllers_never_proves_an_open_loop():
    assert shown(open_loop(PRBS), through=True) is None
    record = Record('bag', DT, np.zeros((4, 3)), np.zeros((4, 4)), segments=(
        Segment('train', 'prbs', 'yaw', 'attitude', 0.0, 1.0),
        Segment('train', 'prbs', 'roll', 'control', 0.0, 1.0),
    ))
    axes = ('roll', 'pitch', 'yaw')
    assert [a for a in axes if loop_of([record], a).through] == ['yaw']
