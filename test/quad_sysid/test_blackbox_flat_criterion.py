"""Descents whose criterion is flat to rounding: an answer or a warning, never a LinAlgError."""

import math
from dataclasses import replace

import numpy as np

from quad_sysid.blackbox import bj
from quad_sysid.blackbox.descent import _bent_step, _step, evaluate, sum_of_squares
from quad_sysid.record import IOData

DT = 0.004


def drifting_flight(samples: int = 3600) -> IOData:
    """An axis that nearly integrates, its command's sign turned, as a table of 9 digits has it."""
    rng = np.random.default_rng(0)
    n = 6000
    u = 0.05 * np.sign(rng.standard_normal(n // 20)).repeat(20)
    y = np.zeros(n)
    for i in range(1, n):
        y[i] = y[i - 1] + DT * (-0.4 * y[i - 1] + 40.0 * u[i - 1])
    y = y + 0.003 * rng.standard_normal(n)
    u, y = (np.array([float(f'{v:.9g}') for v in x]) for x in (u, -y))
    return IOData(
        u - u[:samples].mean(), y - y[:samples].mean(), DT, segments=[(0, samples)]
    )


def test_a_secant_far_above_the_gauss_newton_part_does_not_end_the_fit():
    model = bj(drifting_flight(), 2, 2, 2, 2, 1)
    assert model.converged or model.warnings
    assert math.isfinite(model.loss)
    assert math.sqrt(model.loss) < 0.00305  # the noise of 0.003 rad/s, within 3 standard errors


def test_a_hessian_singular_to_rounding_gives_no_newton_step_but_a_damped_one():
    v = np.array([1.0, -0.5, 0.25])
    full = 1e6 * np.outer(v, v) + 1e-11 * np.eye(3)
    slope = np.array([1.0, 1.0, 1.0])
    assert _bent_step(full, slope) is None
    assert _bent_step(np.full((3, 3), np.nan), slope) is None
    assert np.allclose(_bent_step(np.diag([1.0, 2.0, 4.0]), slope), [1.0, 0.5, 0.25])
    z = drifting_flight()
    point = evaluate(bj(z, 2, 2, 2, 2, 1, thorough=False), z)
    flat = replace(point, hessian=np.zeros((8, 8)) + 1.0, slope=np.ones(8))
    for damping in (0.0, 1e-13, 1.0):
        step = _step(flat, damping)
        assert np.isfinite(step).all()
        assert step @ flat.slope > 0.0  # downhill


def test_a_point_whose_derivatives_overflowed_counts_as_no_point():
    z = drifting_flight()
    point = evaluate(bj(z, 2, 2, 2, 2, 1, thorough=False), z)
    assert math.isfinite(sum_of_squares(point))
    assert sum_of_squares(replace(point, slope=np.full(8, np.nan))) == math.inf
