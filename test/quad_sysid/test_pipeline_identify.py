"""The heart at array level: plant known, noise seeded; what was planted is found, and no more.

The flights come from the plain simulator of conftest.py. Tolerances: a parameter lies within 3 of
its own standard errors and within the stated percentage of the truth.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from quad_sysid.effects.discover import discover
from quad_sysid.effects.judge import Judgement, judge
from quad_sysid.effects.shapes import SHAPES
from quad_sysid.effects.table import EFFECTS, by_name
from quad_sysid.greybox.data import axis_data
from quad_sysid.greybox.fit import fit_base
from quad_sysid.model import AxisModel
from quad_sysid.pipeline import assemble
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.pipeline.evaluate import evaluate
from quad_sysid.pipeline.identify import Options, identify
from quad_sysid.record import Record
from quad_sysid.report.model_file import load_models, save_models

SEED, UNSEEN_SEED = 1, 101


@dataclasses.dataclass(frozen=True)
class Planted:
    """Changes to the plain axis, and what must come out of them."""

    name: str
    changes: dict
    parameter: str
    truth: float
    percent: float
    """How near the parameter must come."""
    after_over_before: float
    """How far the error on the second, unseen flight must fall, at least."""


PLANTED = [
    Planted('coulomb_friction', {'torque': lambda r, _: -0.8 * math.tanh(r / 0.004)},
            'torque', 0.8, 5.0, 0.35),
    Planted('quadratic_drag', {'torque': lambda r, _: -1.5 * r * abs(r)},
            'coefficient', 1.5, 20.0, 0.75),
    Planted('pendulum_stiffness', {'torque': lambda _, a: -4.0 * math.sin(a)},
            'stiffness', 4.0, 5.0, 0.35),
    Planted('dead_zone',
            {'command': lambda u, _: math.copysign(max(abs(u) - 0.004, 0.0), u)},
            'half_width', 0.004, 5.0, 0.2),
    Planted('battery_sag',
            {'command': lambda u, v: u * (v / 12.0) ** 2, 'volts': (12.6, 11.0)},
            'exponent', 2.0, 20.0, 0.5),
]


@dataclasses.dataclass(frozen=True)
class Heart:
    """What identify finds of one axis less the black-box side, which has its own tests."""

    model: AxisModel
    judgement: Judgement

    @property
    def verdict(self) -> str:
        return self.judgement.verdict


def heart_of(record: Record, effects=EFFECTS + SHAPES) -> Heart:
    """Discover on the training segments, judge on the validation: the pipeline's own calls."""
    rng = np.random.default_rng(0)
    with threadpool_limits(limits=1):
        found = discover(axis_data([record], 'roll'), effects, rng)
        judgement = judge(found, rng)
    return Heart(assemble.axis_model(found, judgement, {}, None), judgement)


def answer_of(records, **options) -> AxisAnswer:
    return identify(records, Options(axes=('roll',), **options))['roll']


def near(model: AxisModel, names: list[tuple[str, str, float, float]]) -> None:
    """(owner, name, truth, percent): within 3 standard errors and within percent."""
    parameters = {('base', p.name): p for p in model.base}
    parameters |= {(e.name, p.name): p for e in model.effects for p in e.parameters}
    for owner, name, truth, percent in names:
        found = parameters[owner, name]
        assert found.std is not None, name
        assert found.std > 0.0, name
        assert abs(found.value - truth) <= 3.0 * found.std, (name, found)
        assert abs(found.value - truth) <= abs(truth) * percent / 100.0, (name, found)


@pytest.fixture(scope='module')
def plain(axis_type, flown) -> Heart:
    return heart_of(flown(axis_type(), SEED))


@pytest.fixture(scope='module', params=PLANTED, ids=lambda one: one.name)
def planted(request, axis_type, flown) -> tuple[Planted, Any, Heart]:
    one = request.param
    axis = axis_type(**one.changes)
    return one, axis, heart_of(flown(axis, SEED))


def test_base_parameters_come_back(plain):
    near(plain.model, [
        ('base', 'gain', 450.0, 1.5), ('base', 'lag', 0.042, 5.0), ('base', 'delay', 0.008, 10.0),
        ('base', 'damping', 0.4, 20.0), ('base', 'bias', 0.2, 10.0),
    ])


def test_standard_errors_are_those_that_repetition_shows(axis_type, flown):
    """Over 10 flights the scatter of each parameter agrees with its std within a factor of 2."""
    fits = []
    for seed in range(20, 30):
        data = axis_data([flown(axis_type(), seed)], 'roll')
        fits.append(fit_base(data, data.train)[0])
    told = np.mean([fit.std for fit in fits], axis=0)
    ratio = np.std([fit.theta for fit in fits], axis=0, ddof=1) / told
    assert (ratio > 0.5).all(), ratio
    assert (ratio < 2.0).all(), ratio


@pytest.mark.parametrize('seed', [SEED, 2, 3, 4])
def test_nothing_planted_nothing_found(axis_type, flown, plain, seed):
    answer = plain if seed == SEED else heart_of(flown(axis_type(), seed))
    assert answer.verdict == 'no_missing_effect'
    assert answer.model.effects == ()
    assert answer.judgement.after.free_run == answer.judgement.before.free_run


def test_planted_effect_is_named_with_its_parameter(planted):
    one, _, answer = planted
    assert answer.verdict == 'effects_added'
    assert [e.name for e in answer.model.effects] == [one.name]
    near(answer.model, [(one.name, one.parameter, one.truth, one.percent)])
    (effect,) = answer.model.effects
    assert effect.p_value < 0.05
    assert effect.error_reduction_pct > 0.0
    total = effect.probability + sum(p for _, p in effect.rivals)
    assert total == pytest.approx(1.0, abs=1e-9)
    assert effect.probability > 0.5


def test_base_beside_the_effect_comes_back(planted):
    """Gain within 2 %, lag within 6 %, whatever was added; sag's gain counts at its reference."""
    one, _, answer = planted
    gain = 450.0
    if one.name == 'battery_sag':
        reference = answer.model.effects[0].settings['reference_v']
        gain *= (reference / 12.0) ** 2
    near(answer.model, [('base', 'gain', gain, 2.0), ('base', 'lag', 0.042, 6.0)])


def test_error_falls_on_a_second_flight_that_was_never_seen(planted, flown, second_plan):
    one, axis, answer = planted
    found = evaluate(answer.model, flown(axis, UNSEEN_SEED, second_plan))
    assert found.after < one.after_over_before * found.before
    # what is left is what the noise explains there: the error of the plant without any effect
    assert found.after < 0.018
    assert found.after < 0.25 * found.hold


def test_evaluate_gives_the_figures_of_identify(planted, flown, tmp_path):
    """Same flight, same spans, parameters through the file: the same errors to 1e-9."""
    one, axis, answer = planted
    record = flown(axis, SEED)
    save_models({'roll': answer.model}, tmp_path / 'model.json')
    stored = load_models(tmp_path / 'model.json')['roll']
    spans = tuple((s.start_s, s.end_s) for s in record.segments if s.role == 'validation')
    found = evaluate(stored, record, spans)
    judged = answer.judgement
    assert found.before == pytest.approx(judged.before.free_run, rel=1e-9), one.name
    assert found.after == pytest.approx(judged.after.free_run, rel=1e-9), one.name
    assert found.hold == pytest.approx(judged.hold, rel=1e-9)
    assert found.windows == judged.before.run.errors.shape[0]


def test_validation_does_not_touch_what_is_chosen(axis_type, flown):
    """Another flight behind the training segment: the same model to the last bit."""
    one = flown(axis_type(**PLANTED[0].changes), SEED)
    other = flown(axis_type(**PLANTED[0].changes), 7)
    cut = round(36.0 / one.dt)

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(one, name)[:cut], getattr(other, name)[cut:]])

    mixed = dataclasses.replace(
        one, **{key: joined(key) for key in ('rates', 'angles', 'control', 'battery_v')}
    )
    first, second = (heart_of(r, effects=(by_name('coulomb_friction'),)) for r in (one, mixed))
    assert first.verdict == second.verdict == 'effects_added'
    for a, b in zip(first.model.base, second.model.base, strict=True):
        assert a == b
    assert first.model.effects[0].parameters == second.model.effects[0].parameters
    assert first.judgement.before.free_run != second.judgement.before.free_run


def test_identify_is_the_heart_and_the_black_box(axis_type, flown):
    """The whole pipeline on one flight, base only: the same base, a table of models beside it."""
    record = flown(axis_type(), SEED)
    answer = answer_of([record], search_effects=False)
    heart = heart_of(record, effects=())
    assert answer.answered
    assert answer.model.base == heart.model.base
    assert answer.model.active_gains == {'roll.rate.kp': 0.06}
    assert answer.judgement.before.free_run == heart.judgement.before.free_run
    assert answer.rows
    assert answer.selected is not None
    assert answer.blackbox_error > 0.9 * answer.judgement.before.free_run
    low, high = answer.model.trusted_band_rad_s
    assert low < 10.0 < high


def test_a_torque_that_never_ends_does_not_spoil_the_black_box(axis_type, flown):
    """4 rad/s² of bias: about the equilibrium, not about the means, models run free as without."""
    record = flown(dataclasses.replace(axis_type(), bias=4.0), SEED)
    answer = answer_of([record])
    fits = [
        fit for row in answer.rows for fit in row.step_a.fit_validation_pct.values()
        if row.step_a.model.stable
    ]
    assert np.median(fits) > 90.0
    spans = tuple((s.start_s, s.end_s) for s in record.segments if s.role == 'validation')
    polynomial = answer.rows[answer.selected].step_a.model
    again = evaluate(answer.model, record, spans, polynomial)
    assert again.blackbox == pytest.approx(answer.blackbox_error, rel=1e-6)
    unseen = dataclasses.replace(record, segments=())  # a flight that nobody cut into segments
    assert evaluate(answer.model, unseen, spans, polynomial).blackbox == again.blackbox


def test_wrong_sign_of_the_command_is_told_by_the_gain(axis_type, flown):
    """Motors in the wrong order show as a negative gain, within 2 %."""
    record = flown(axis_type(), SEED)
    flipped = record.control.copy()
    flipped[:, 1] *= -1.0
    answer = heart_of(dataclasses.replace(record, control=flipped), effects=())
    assert answer.model.value('gain') == pytest.approx(-450.0, rel=0.02)


def test_a_flight_without_excitation_is_refused_in_words(axis_type, flown, plan_type):
    record = flown(axis_type(), SEED, plan_type(amplitude=0.0))
    still = record.control.copy()
    still[:, 1] = 0.0
    answer = answer_of([dataclasses.replace(record, control=still)])
    assert answer.verdict == 'cannot_tell'
    assert not answer.answered
    assert 'excite' in answer.reason
    assert answer.proposal is not None
    assert answer.proposal.gains is None


def test_two_flights_are_fitted_together(axis_type, flown):
    """Standard errors of two flights are smaller than those of one; the truth is still inside."""
    records = [flown(axis_type(), seed) for seed in (11, 12)]
    data = [axis_data(some, 'roll') for some in (records[:1], records)]
    one, both = (fit_base(some, some.train)[0] for some in data)
    truth = np.array([450.0, 0.042, 0.008, 0.4, 0.2])
    assert (np.abs(both.theta - truth) < 3.0 * both.std).all()
    assert np.sum(both.std < one.std) >= 4
