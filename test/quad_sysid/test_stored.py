"""A fit handed on as a model: its parameters as a report reads them, and the same run again."""

import numpy as np
import pytest

from quad_sysid.effects import EFFECTS
from quad_sysid.estimate.fit import Problem, fit, start_of
from quad_sysid.estimate.stored import completed, noise_of, readings
from quad_sysid.model import AxisModel, EffectEstimate
from quad_sysid.model.data import axis_data
from quad_sysid.model.effect import Part
from quad_sysid.model.structure import Structure
from quad_sysid.report import document, words
from quad_sysid.report.model_file import load_models, save_models


def effect(label):
    return next(e for e in EFFECTS if e.label == label)


@pytest.fixture(scope='module')
def problem(plain_flight):
    data = axis_data([plain_flight], 'roll')
    return Problem(data, data.train)


def test_a_model_from_a_file_runs_as_the_fit_it_was(problem, tmp_path):
    problem.measure(fit(problem, Structure(), start_of(problem)))
    start = start_of(problem)
    parts = (Part(effect('periodic_disturbance'), {}), Part(effect('coulomb_friction'), {}))
    theta = np.r_[start[:5], np.log(1.7), 0.1, 0.05, 0.02, np.log(0.005), start[5:]]
    found = fit(problem, Structure(parts), theta, most_steps=3)
    told = readings(problem, found)
    model = AxisModel(
        'roll', problem.data.dt, None, told.base,
        tuple(
            EffectEstimate(p.effect.name, p.effect.kind, p.effect.signals, values,
                           p.effect.variant, p.settings)
            for p, values in zip(parts, told.effects, strict=True)
        ),
        told.names, told.covariance, noise=noise_of(found),
    )
    save_models({'roll': model}, tmp_path / 'model.json')
    again = completed(load_models(tmp_path / 'model.json')['roll'])
    assert again.structure == found.structure
    np.testing.assert_allclose(again.theta, found.theta, rtol=1e-13, atol=1e-15)
    assert again.tail == found.tail


# up to where a model is worth something


def test_the_error_over_the_horizon_grows_from_the_noise_and_is_told(rubbed_answer):
    tree = document.document({'roll': rubbed_answer}, ['bag'])['axes']['roll']
    listed = tree['error']['horizons']
    assert [h['horizon_s'] for h in listed] == [0.02, 0.05, 0.1, 0.2, 0.5, 1.0]
    for h in listed[1:]:
        assert h['after'] < h['before'] < h['hold'], h
        assert h['blackbox'] is not None
    assert listed[0]['after'] < 2.0 * tree['error']['noise_floor']
    assert listed[-1]['before'] > 2.0 * listed[1]['before']
    noise = {p['name']: p['value'] for p in tree['base']['noise']}
    assert set(noise) >= {'disturbance_rms', 'disturbance_correlation', 'measurement_rms'}


@pytest.mark.parametrize(
    ('after', 'far'), [((0.1, 0.1, 0.1), 1.0), ((0.1, 0.2, 0.9), 0.1), ((0.4, 0.8, 0.9), None)]
)
def test_worth_ends_where_holding_is_no_longer_twice_as_wrong(after, far):
    error = {'unit': 'rad/s', 'horizons': [
        {'horizon_s': s, 'hold': hold, 'before': 1.0, 'after': one, 'blackbox': None}
        for s, hold, one in zip((0.05, 0.1, 1.0), (0.5, 1.0, 1.2), after, strict=True)
    ]}
    assert words.reach(error) == far
