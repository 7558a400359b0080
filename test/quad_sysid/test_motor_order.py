"""Motors in a wrong order are seen against the wrench, also where the axis' motion is the same."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from quad_sysid.contract import control_from_motors, motors_from_wrench
from quad_sysid.pipeline.identify import Options, identify
from quad_sysid.pipeline.motor_order import refusal, swapped_motors
from quad_sysid.record import Record, Segment
from quad_tuning.designer import design

DT = 0.004


def flight(seconds: float = 30.0, *, seed: int = 1, noise: float = 0.001) -> Record:
    """A PRBS on roll; pitch and yaw commands are a little noise, as on a rig of one free axis."""
    rng = np.random.default_rng(seed)
    n = round(seconds / DT)
    wrench = rng.normal(0.0, noise, (n, 4))
    wrench[:, 0] = 0.5
    wrench[:, 1] += 0.02 * np.repeat(rng.choice([-1.0, 1.0], n // 25 + 1), 25)[:n]
    motors = motors_from_wrench(wrench)
    rates = rng.normal(0.0, 0.002, (n, 3))
    rate = lag = 0.0
    for k in range(n):
        lag += DT / 0.05 * (wrench[k, 1] - lag)
        rate += DT * (400.0 * lag - 3.0 * rate)
        rates[k, 0] += rate
    parts = (
        Segment('train', 'prbs', 'roll', 'attitude', 0.0, 18.0),
        Segment('validation', 'prbs', 'roll', 'attitude', 18.0, 30.0),
    )
    return Record(
        source='flight', dt=DT, rates=rates, control=control_from_motors(motors),
        motors=motors, wrench=wrench, segments=parts,
    )  # fmt: skip


def reordered(record: Record, order: tuple[int, ...]) -> Record:
    """The same flight, logged by somebody who counts the motors otherwise (1..4)."""
    assert record.motors is not None
    motors = record.motors[:, [motor - 1 for motor in order]]
    return replace(record, motors=motors, control=control_from_motors(motors))


@pytest.mark.parametrize('order', list(permutations((1, 2, 3, 4)))[1:])
def test_every_wrong_order_is_named(order):
    assert swapped_motors(reordered(flight(4.0), order)) == order


def test_the_right_order_raises_no_alarm():
    record = flight(4.0)
    assert record.motors is not None
    assert record.wrench is not None
    rounded = np.round(record.motors * 1000) / 1000
    late = np.roll(record.wrench, 1, axis=0)
    limited = np.clip(record.motors, 0.0, 0.505)
    for changed in (
        record, replace(record, motors=rounded), replace(record, wrench=late),
        replace(record, motors=limited), replace(record, motors=None),
        replace(record, wrench=None), replace(record, wrench=np.full_like(record.wrench, np.nan)),
    ):  # fmt: skip
        assert swapped_motors(changed) is None
        assert refusal(changed) == ''


def test_no_gains_come_of_swapped_motors_that_leave_the_axis_as_it_was():
    def designer(_model):
        pytest.fail('a designer was asked')

    record = reordered(flight(), (4, 3, 2, 1))
    options = Options(('roll',), designer=designer, search_effects=False)
    answer = identify([record], options)['roll']
    assert answer.proposal is not None
    assert answer.proposal.gains is None
    assert 'in the order 4, 3, 2, 1' in answer.proposal.refused_because
    assert answer.proposal.refused_because in answer.warnings


def test_no_gains_come_of_a_plant_that_answers_the_wrong_way_round():
    record = flight()
    assert record.wrench is not None
    wrench = record.wrench.copy()
    wrench[:, 1:] *= -1.0
    motors = motors_from_wrench(wrench)
    turned = replace(record, wrench=wrench, motors=motors, control=control_from_motors(motors))
    options = Options(('roll',), designer=design, search_effects=False)
    answer = identify([turned], options)['roll']
    assert answer.proposal is not None
    assert answer.proposal.gains is None
    assert 'a positive command lowers the rate' in answer.proposal.refused_because
