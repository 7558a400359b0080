"""model.json: what goes in comes out, and a damaged file says in one line what is wrong."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from known_plants import reference_study

from quad_sysid.blackbox import bj, simulate
from quad_sysid.estimate.stored import completed
from quad_sysid.model import AxisModel, EffectEstimate, NoiseEstimate, Parameter
from quad_sysid.pipeline.evaluate import simulate as simulate_model
from quad_sysid.report.model_file import (
    POLYNOMIALS,
    load_blackbox,
    load_models,
    save_models,
    tree_of,
)


def some_model():
    covariance = np.diag([4.0, 1e-6, 1e-6, 0.01, np.nan, 0.04])
    covariance[4], covariance[:, 4] = np.nan, np.nan
    base = (('gain', 450.0, 2.0, 'rad/s² per unit command'), ('lag', 0.043, 0.001, 's'),
            ('delay', 0.008, 0.001, 's'), ('damping', 0.4, 0.1, '1/s'),
            ('bias', 0.0, None, 'rad/s²'))
    friction = EffectEstimate(
        'coulomb_friction', 'named', ('rate',), (Parameter('torque', 1.5, 0.2, 'rad/s²'),),
        settings={'knots': [0.0, 1.0], 'smooth': 0.05, 'note': None}, p_value=1e-4,
        error_reduction_pct=30.0, probability=0.8, rivals=(('quadratic_drag', 0.2),),
    )
    return AxisModel(
        axis='roll', dt=0.004, gyro_filter_hz=42.0, base=tuple(Parameter(*p) for p in base),
        effects=(friction,), parameter_names=(*(p[0] for p in base), 'coulomb_friction.torque'),
        covariance=covariance, active_gains={'roll.angle.kp': 3.0}, mean_battery_v=11.1,
        noise=NoiseEstimate(
            {'white': 1.3, 'disturbance': 1.6, 'correlation': 0.3}, 0.003, 50.0, 0.007, 0.004,
            ((0.1, 57.3, 4.0),),
        ),
        trusted_band_rad_s=(0.3, 30.0),
    )


def test_round_trip_is_exact(tmp_path):
    path = tmp_path / 'model.json'
    model = some_model()
    save_models({'roll': model}, path)
    back = load_models(path)['roll']
    np.testing.assert_array_equal(back.covariance, model.covariance)
    assert dataclasses.replace(back, covariance=None) == dataclasses.replace(
        model, covariance=None
    )
    assert [p.name for p in tmp_path.iterdir()] == ['model.json']


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(
    ('damage', 'said'),
    [
        (lambda t, _: t.update(schema='other/1'), 'must be quad_sysid/model/3'),
        (lambda _, roll: roll.update(dt=0.0), 'roll.dt: must be a positive'),
        (lambda _, roll: roll.update(surprise=1), 'unknown field: found surprise'),
        (lambda _, roll: roll['base'][0].update(value='big'), 'gain.value: must be a f'),
        (lambda _, roll: roll['base'].pop(), 'must list gain, lag'),
        (lambda _, roll: roll['covariance'].pop(), 'must be 6 by 6'),
        (lambda _, roll: roll['effects'][0].update(
            name='shape:rate', variant='smooth', settings={'knots': [0.0, 1.0], 'mean': [0.0] * 6},
            parameters=[{**roll['effects'][0]['parameters'][0], 'name': f'y{i}'}
                        for i in range(6)]), 'settings with which an effect cannot run'),
        (lambda _, roll: roll['effects'][0].update(
            name='battery_sag', variant='', settings={'reference_v': 0.0},
            parameters=[{**roll['effects'][0]['parameters'][0], 'name': 'exponent'}]),
         'settings with which an effect cannot run'),
    ],
)
def test_a_damaged_file_is_named_in_one_line(tmp_path, refusal, damage, said):
    path = tmp_path / 'model.json'
    save_models({'roll': some_model()}, path)
    tree = json.loads(path.read_text())
    damage(tree, tree['axes']['roll'])
    path.write_text(json.dumps(tree))
    line = refusal(load_models, path)
    assert said in line
    assert str(path) in line


def test_a_file_of_an_earlier_version_is_read_as_it_was_meant_or_refused(tmp_path, refusal):
    """The rates are those that the version which wrote the file computes."""
    path = Path(__file__).parents[1] / 'data' / 'model_2.json'
    model = load_models(path)['yaw']
    assert (model.rungs, model.predicting is model) == ((), True)  # not explained, as then
    assert {effect.explains_pct for effect in model.effects} == {0.0}
    rate = simulate_model(model, 0.05 * np.repeat([1.0, -1.0, 0.5], 40))
    there = [-0.006016, -0.013561, -0.01941, -0.020571, -0.02451]
    np.testing.assert_allclose(rate[[20, 39, 60, 100, 119]], there, atol=1e-6)
    assert {name.rpartition('.')[0] for name in model.parameter_names} == {
        '', 'mode:swinging', 'inertia_coupling'}
    gone = tmp_path / 'model.json'
    gone.write_text(path.read_text().replace('"swinging"', '"rough"'))
    assert 'only versions before the release of 0.2.0' in refusal(
        completed, load_models(gone)['yaw'])


def test_a_polynomial_model_comes_back_the_same(tmp_path):
    polynomial = bj(reference_study().record(np.random.default_rng(0)), 2, 2, 2, 2, 3)
    path = tmp_path / 'model.json'
    path.write_text(json.dumps({'axes': {}, 'blackbox': {'roll': tree_of(polynomial)}}))
    back = load_blackbox(path)['roll']
    for name in (*POLYNOMIALS, 'covariance'):
        np.testing.assert_array_equal(getattr(back, name), getattr(polynomial, name))
    assert (back.name, back.nk, back.dt) == (polynomial.name, polynomial.nk, polynomial.dt)
    u = np.random.default_rng(1).standard_normal(50)
    np.testing.assert_array_equal(simulate(back, u), simulate(polynomial, u))
    path.write_text('{"schema": "quad_sysid/model/2", "axes": {}}')
    assert load_blackbox(path) == {}
