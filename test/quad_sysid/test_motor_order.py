"""Motors in a wrong order are seen against the wrench, also where the axis' motion is the same."""

from dataclasses import replace
from functools import cache
from itertools import permutations

import numpy as np
import pytest
from flown_axis import SHORT, Axis, Plan, fly

from quad_sysid.contract import control_from_motors, motors_from_wrench
from quad_sysid.pipeline.identify import Options, identify
from quad_sysid.pipeline.usable import refusal, swapped_motors
from quad_sysid.record import Record
from quad_tuning.designer import design

pytestmark = pytest.mark.usefixtures('quick')


@cache
def flight(plan: Plan = SHORT) -> Record:
    """A PRBS on roll; pitch and yaw commands are a little noise, as on a rig of one free axis."""
    noise = 0.001 * np.random.default_rng(1).standard_normal((2, 7500))
    record = fly(Axis(other_commands=lambda t: noise[:, : t.size]), 1, plan)
    motors = motors_from_wrench(record.control)
    control = control_from_motors(motors)
    return replace(record, wrench=record.control, motors=motors, control=control)


BRIEF = Plan(4.0, ())


def reordered(record: Record, order: tuple[int, ...]) -> Record:
    """The same flight, logged by somebody who counts the motors otherwise (1..4)."""
    assert record.motors is not None
    motors = record.motors[:, [motor - 1 for motor in order]]
    return replace(record, motors=motors, control=control_from_motors(motors))


@pytest.mark.parametrize('order', list(permutations((1, 2, 3, 4)))[1:])
def test_every_wrong_order_is_named(order):
    assert swapped_motors(reordered(flight(BRIEF), order)) == order


@pytest.mark.parametrize('change', [
    lambda _: {}, lambda r: {'motors': np.round(r.motors * 1000) / 1000},
    lambda r: {'wrench': np.roll(r.wrench, 1, axis=0)},
    lambda r: {'motors': np.clip(r.motors, 0.0, 0.505)}, lambda _: {'motors': None},
    lambda _: {'wrench': None}, lambda r: {'wrench': np.full_like(r.wrench, np.nan)},
])
def test_the_right_order_raises_no_alarm(change):
    record = flight(BRIEF)
    changed = replace(record, **change(record))
    assert (swapped_motors(changed), refusal(changed)) == (None, '')


def turned(record: Record) -> Record:
    wrench = record.wrench * [1.0, -1.0, -1.0, -1.0]
    motors = motors_from_wrench(wrench)
    return replace(record, wrench=wrench, motors=motors, control=control_from_motors(motors))


@pytest.mark.parametrize(
    ('change', 'designer', 'words'),
    [
        (lambda record: reordered(record, (4, 3, 2, 1)), None, 'in the order 4, 3, 2, 1'),
        (turned, design, 'a positive command lowers the rate'),
    ],
    ids=['swapped motors that leave the axis as it was', 'wrong way round'],
)
def test_no_gains_come_of_motors_in_a_wrong_order(change, designer, words):
    ask = designer or (lambda _model: pytest.fail('a designer was asked'))
    options = Options(('roll',), designer=ask, effects=())
    answer = identify([change(flight())], options)['roll']
    assert answer.proposal.gains is None
    assert words in answer.proposal.refused_because
    assert designer or answer.proposal.refused_because in answer.warnings
    assert designer or words in answer.model.predicting.no_gains_because
