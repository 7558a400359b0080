"""Record.axis and IOData: what is refused, in one line that names the argument."""

import numpy as np
import pytest

from quad_sysid.blackbox import (
    clriv,
    delay_estimate,
    iv4,
    joint,
    oe,
    polynomial_model,
    predict,
)
from quad_sysid.record import IOData, Record

N = 600
U, Y, R = np.random.default_rng(0).standard_normal((3, N))
MODEL = polynomial_model([0, 0.5], A=[1, -0.5], dt=0.01)


@pytest.mark.parametrize('name', ['rol', 'x', '', None, 0])
def test_another_axis_is_refused_by_name(name, refusal):
    record = Record('flight', 0.004, np.zeros((9, 3)), np.zeros((9, 4)))
    for call, where in ((record.axis, 'Record.axis'), (record.external, 'Record.external')):
        told = refusal(call, name)
        assert told.startswith(f'{where}: axis must be one of roll, pitch, yaw: found')
        assert repr(name) in told
    assert record.axis('yaw').n == 9


@pytest.mark.parametrize(
    ('call', 'told'),
    [
        (lambda: IOData(U, Y, 'a'), 'IOData: dt must be a positive number'),
        (lambda: IOData(['a'] * N, Y, 0.01), 'IOData: u must hold real numbers'),
        (lambda: IOData(U + 1j, Y, 0.01), 'u must hold real numbers: found complex128'),
        (lambda: IOData([[1.0], [1.0, 2.0]], Y, 0.01), 'u must hold real numbers: found list'),
        (lambda: IOData(U, Y, 0.01, r=np.full(N, np.nan)), 'segment 0:600 of r holds NaN'),
        (lambda: IOData(U, np.full(N, np.inf), 0.01), 'of y holds NaN or infinity'),
        (lambda: IOData(U, Y, 0.01, segments=[(300, 600), (0, 301)]), 'must not overlap'),
        (lambda: IOData(U, Y, 0.01, segments=[(0, 1, 2)]), 'segments must be pairs'),
        (lambda: IOData(U, Y, 0.01, segments=5), 'segments must be pairs'),
        (lambda: IOData(U, Y, 0.01, segments=[(0, N + 1)]), 'must lie in 0..600'),
        (lambda: predict(MODEL, IOData(U, Y, 0.01), 'a'), 'predict: horizon must be'),
    ],
)
def test_iodata_refuses_by_name(call, told, refusal):
    assert told in refusal(call)


def test_iodata_takes_touching_segments_in_any_order_and_a_reference_lost_outside_them():
    r = R.copy()
    r[:100] = np.nan
    z = IOData(list(U), Y, np.float64(0.01), r=r, segments=[(np.int64(300), 600), (100, 300)])
    assert z.segments == ((300, 600), (100, 300))
    assert z.n == 500


@pytest.mark.parametrize(
    ('call', 'told'),
    [
        (lambda z: clriv(z, 1, 1, 1, 1, 1), 'clriv: the reference r is constant'),
        (lambda z: joint(z, lambda data: oe(data, 1, 1, 1)), 'joint: the reference r is constant'),
        (lambda z: iv4(z, 1, 1, 1), 'iv4: the reference r is constant'),
        (lambda _: iv4(IOData(U, Y, 0.01, r=np.sin(np.arange(N))), 1, 1, 1),
         'iv4: no response from the reference r'),
        (lambda _: delay_estimate(IOData(0 * U, Y, 0.01)), 'delay_estimate: u is constant'),
        (lambda _: delay_estimate(IOData(U[:20], Y[:20], 0.01)), 'delay_estimate: too few'),
    ],
)
def test_messages_name_who_was_called_and_with_what(call, told, refusal):
    assert refusal(call, IOData(U, Y, 0.01, r=np.full(N, 2.0))).startswith(told)
