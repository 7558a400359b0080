"""The polarity check in flight and the layout from a flight's record say the same of the motors.

The check pushes one motor after the other and takes the signs of the answers; the layout compares
all patterns of signs over a record in which all of them move. Here the record is the check's own.
What the signs mean, both ask the same function.
"""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from quad_bridge.craft import X
from quad_bridge.gains.polarity import MOTOR_CHANNELS, PulseRun, merge_motors
from quad_sysid import contract
from quad_sysid.motor_layout import patterns_of, places

DT = 0.004
WHERE = np.array(X.signs, dtype=float)
"""(4, 3): what a motor at each place of the contract does to roll, pitch and yaw."""


def test_both_have_the_contracts_mixer():
    np.testing.assert_array_equal(contract.MIXER, X.mixer)
    np.testing.assert_array_equal(contract.MIXER_INVERSE, X.inverse)


@pytest.mark.parametrize('order', list(permutations(range(4)))[::5])
@pytest.mark.parametrize('out', [1.0, -1.0], ids=['propellers in', 'propellers out'])
def test_they_agree_on_every_order(order, out):
    """Channel k drives the motor at place order[k], behind 8 ms of delay and 40 ms of lag."""
    rng = np.random.default_rng(3)
    does = WHERE[list(order)] * [1.0, 1.0, out]
    check = PulseRun(MOTOR_CHANNELS, 1.0 / DT)
    rate, drive = np.zeros(3), np.zeros(3)
    rates, motors = [], []
    while not check.finished:
        added = np.array(check.step(tuple(rate + 0.002 * rng.standard_normal(3))))
        motors.append(0.5 + WHERE @ added)
        rates.append(rate)
        torque = 100.0 * does.T @ (motors[max(0, len(motors) - 3)] - 0.5)
        drive = drive + DT / 0.04 * (torque - drive)
        rate = rate + DT * (drive - 2.0 * rate + 0.5 * rng.standard_normal(3))
    known = merge_motors({}, check.answers)
    wanted = [[known[f'motor_{k + 1}'][axis] for k in range(4)] for axis in contract.AXES]
    assert wanted == does.T.astype(int).tolist()
    assert (X.where_motors_are(known)[1] == []) == (order == (0, 1, 2, 3) and out > 0.0)
    found = patterns_of(np.array(rates), np.array(motors), DT)
    assert [list(p.signs) for p in found] == wanted
    assert places([replace(p, certain=True) for p in found], X) == X.where_motors_are(known)
