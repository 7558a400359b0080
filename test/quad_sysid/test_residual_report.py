"""What is left of a model on held-out data: innovations under test, missing torque, report."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from quad_sysid.blackbox import arx, innovation_test, predict, residual_test
from quad_sysid.effects.discover import Discovery, discover
from quad_sysid.effects.judge import Judgement, judge
from quad_sysid.effects.table import by_name
from quad_sysid.errors import BadInputError
from quad_sysid.greybox.data import AxisData, axis_data
from quad_sysid.greybox.fit import fit_base
from quad_sysid.pipeline.residual import (
    held_out,
    missing_torque,
    of_black_box,
    of_grey_box,
    residual,
)
from quad_sysid.record import IOData, Record
from quad_sysid.report.residual_tree import residual_tree

DT = 0.004


def white(seed: int, n: int = 6000) -> IOData:
    """A first-order plant with white one-step errors in the output's place."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal(n)
    return IOData(u=u, y=rng.standard_normal(n), dt=DT)


def test_innovations_are_tested_as_a_models_own_residual() -> None:
    rng = np.random.default_rng(3)
    u, e, y = rng.standard_normal(4000), 0.1 * rng.standard_normal(4000), np.zeros(4000)
    for k in range(2, 4000):
        y[k] = 0.9 * y[k - 1] + 0.4 * u[k - 2] + e[k]
    z = IOData(u=u, y=y, dt=DT)
    model = arx(z, 1, 1, 2)
    own, given = residual_test(model, z), innovation_test(y - predict(model, z, 1), z)
    assert given.p_white == pytest.approx(own.p_white, rel=1e-9)
    assert given.p_input == pytest.approx(own.p_input, rel=1e-9)
    assert given.samples == own.samples
    assert own.residual_white


def test_white_errors_pass_and_coloured_or_driven_ones_do_not() -> None:
    z = white(1)
    good = innovation_test(z.y, z)
    assert good.residual_white
    assert good.residual_uncorrelated_with_input
    coloured = innovation_test(z.y + 0.3 * np.roll(z.y, 1), z)
    assert not coloured.residual_white
    assert coloured.residual_uncorrelated_with_input
    driven = innovation_test(z.y + 0.2 * np.roll(z.u, 3), z)
    assert not driven.residual_uncorrelated_with_input


def test_gaps_end_a_stretch_and_too_little_is_refused() -> None:
    z = white(2)
    errors = z.y.copy()
    errors[1000:1003] = np.nan
    assert innovation_test(errors, z).samples == z.y.size - 3
    with pytest.raises(BadInputError, match='too few residuals'):
        innovation_test(np.full(z.y.size, np.nan), z)
    with pytest.raises(BadInputError, match=r'length of z\.y'):
        innovation_test(z.y[:-1], z)


def test_a_line_in_the_errors_is_a_peak_and_white_noise_has_none() -> None:
    z = white(4, 10_000)
    clean = residual(z.y, z)
    assert clean is not None
    assert clean.peaks == ()
    t = np.arange(z.y.size) * DT
    lined = residual(z.y + 0.4 * np.sin(2.0 * np.pi * 7.0 * t), z)
    assert lined is not None
    assert lined.peaks[0][0] == pytest.approx(7.0, abs=0.5)
    # Parseval: the spectrum holds all of the errors' power
    power = np.sum(lined.density) * (lined.frequency_hz[1] - lined.frequency_hz[0])
    assert power == pytest.approx(lined.rms**2, rel=0.05)


def fitted(record: Record) -> tuple[AxisData, object, object, object]:
    data = axis_data([record], 'roll')
    return data, *fit_base(data, data.train)


def test_a_torque_that_the_model_lacks_comes_out_of_the_innovations(
    flown: Callable[..., Record], axis_type: type
) -> None:
    data, fit, noise, sim = fitted(flown(axis_type(bias=0.5), 5))
    theta = fit.theta.copy()
    true = theta[4]
    run = sim.run(fit.structure, theta)
    known = missing_torque(run.innovations, data.train, float(noise.correction[0]), DT)
    theta[4] = 0.0
    run = sim.run(fit.structure, theta)
    found = missing_torque(run.innovations, data.train, float(noise.correction[0]), DT)
    assert known is not None
    assert found is not None
    assert np.mean(known.acceleration) == pytest.approx(0.0, abs=0.02)
    assert np.mean(found.acceleration) == pytest.approx(true, rel=0.05)
    assert known.rms == pytest.approx(known.expected_rms, rel=0.35)
    assert found.rms > 2.0 * found.expected_rms
    assert missing_torque(run.innovations[:20], ((0, 20),), 0.1, DT) is None


def test_held_out_errors_lie_inside_the_spans_alone() -> None:
    kept = held_out(np.arange(10.0), ((2, 5), (7, 9)))
    assert np.flatnonzero(np.isfinite(kept)).tolist() == [3, 4, 8]


@pytest.fixture(scope='module')
def rubbed(
    flown: Callable[..., Record], axis_type: type
) -> tuple[Discovery, Judgement]:
    """A flight with dry friction, found."""
    record = flown(axis_type(torque=lambda rate, _: -0.5 * np.tanh(rate / 0.01)), 6)
    data = axis_data([record], 'roll')
    found = discover(data, (by_name('coulomb_friction'),), np.random.default_rng(0))
    return found, judge(found, np.random.default_rng(0))


def test_friction_is_seen_in_what_the_base_leaves_and_gone_when_it_is_added(
    rubbed: tuple[Discovery, Judgement],
) -> None:
    found, judgement = rubbed
    assert judgement.verdict == 'effects_added'
    left = of_grey_box(found, judgement)
    before, after = left['before'], left['after']
    assert not before.test.residual_uncorrelated_with_input
    assert after.test.p_input > 1e-3
    assert after.rms < before.rms
    assert before.missing is not None
    assert after.missing is not None
    assert after.missing.rms < 0.7 * before.missing.rms


def test_without_an_effect_before_and_after_are_one(
    rubbed: tuple[Discovery, Judgement],
) -> None:
    found, judgement = rubbed
    left = of_grey_box(found, replace(judgement, after=judgement.before))
    assert left['after'].rms == left['before'].rms


def test_the_report_holds_plain_finite_values(rubbed: tuple[Discovery, Judgement]) -> None:
    found, judgement = rubbed
    data = found.data
    model = arx(
        IOData(u=data.command, y=data.rate, dt=DT, segments=data.train), 4, 4, 2
    )
    black = of_black_box(data, model)
    assert black is not None
    assert black.missing is None
    tree = residual_tree({**of_grey_box(found, judgement), 'blackbox': black})
    told = json.loads(json.dumps(tree, allow_nan=False))
    assert list(told) == ['before', 'after', 'blackbox']
    for one in told.values():
        assert one['samples'] > 1000
        assert 0.0 <= one['p_white'] <= 1.0
        assert abs(one['largest_cross_correlation']['value']) <= 1.0
    assert told['before']['missing_torque']['unit'] == 'rad/s²'
    assert residual_tree({}) == {'before': None, 'after': None, 'blackbox': None}
