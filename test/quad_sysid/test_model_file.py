"""model.json: what goes in comes out, and a damaged file says in one line what is wrong."""

import dataclasses
import json

import numpy as np
import pytest

from quad_sysid.blackbox import bj, simulate
from quad_sysid.blackbox.studies import reference_study
from quad_sysid.errors import BadInputError
from quad_sysid.model import AxisModel, EffectEstimate, Parameter
from quad_sysid.report.blackbox_file import POLYNOMIALS, load_blackbox, tree_of
from quad_sysid.report.model_file import load_models, save_models


def some_model():
    covariance = np.diag([4.0, 1e-6, 1e-6, 0.01, np.nan, 0.04])
    covariance[4] = np.nan
    covariance[:, 4] = np.nan
    return AxisModel(
        axis='roll',
        dt=0.004,
        gyro_filter_hz=42.0,
        base=(
            Parameter('gain', 450.0, 2.0, 'rad/s² per unit command'),
            Parameter('lag', 0.043, 0.001, 's'),
            Parameter('delay', 0.008, 0.001, 's'),
            Parameter('damping', 0.4, 0.1, '1/s'),
            Parameter('bias', 0.0, None, 'rad/s²'),
        ),
        effects=(
            EffectEstimate(
                'coulomb_friction', 'named', ('rate',),
                (Parameter('torque', 1.5, 0.2, 'rad/s²'),),
                settings={'knots': [0.0, 1.0], 'smooth': 0.05, 'note': None},
                p_value=1e-4, error_reduction_pct=30.0, probability=0.8,
                rivals=(('quadratic_drag', 0.2),),
            ),
        ),
        parameter_names=('gain', 'lag', 'delay', 'damping', 'bias', 'coulomb_friction.torque'),
        covariance=covariance,
        active_gains={'roll.angle.kp': 3.0},
        mean_battery_v=11.1,
        noise_rms=0.01,
        torque_noise=None,
        trusted_band_rad_s=(0.3, 30.0),
    )  # fmt: skip


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


def test_numpy_values_and_nan_are_stored_as_json(tmp_path):
    model = some_model()
    effect = dataclasses.replace(
        model.effects[0], settings={'knots': np.array([0.0, np.nan]), 'n': np.int64(3)}
    )
    base = (*model.base[:4], Parameter('bias', np.float64(0.5), float('nan'), 'rad/s²'))
    path = tmp_path / 'model.json'
    save_models({'roll': dataclasses.replace(model, effects=(effect,), base=base)}, path)
    json.loads(path.read_text(), parse_constant=pytest.fail)
    back = load_models(path)['roll']
    assert back.effects[0].settings == {'knots': [0.0, None], 'n': 3}
    assert back.base[4].std is None


def test_a_value_that_is_not_finite_is_refused_and_keeps_the_old_file(tmp_path):
    path = tmp_path / 'model.json'
    path.write_text('old')
    bad = dataclasses.replace(some_model(), active_gains={'roll.rate.kp': float('nan')})
    with pytest.raises(BadInputError, match=r'roll\.active_gains\.roll\.rate\.kp'):
        save_models({'roll': bad}, path)
    assert path.read_text() == 'old'


@pytest.mark.parametrize(
    ('damage', 'said'),
    [
        (lambda t: t.pop('schema'), 'lacks schema'),
        (lambda t: t.update(schema='other/1'), 'must be quad_sysid/model/1'),
        (lambda t: t['axes'].update(tail={}), 'must be of roll, pitch, yaw'),
        (lambda t: t['axes']['roll'].pop('dt'), 'lacks dt'),
        (lambda t: t['axes']['roll'].update(dt=0.0), 'roll.dt: must be a positive'),
        (lambda t: t['axes']['roll'].update(surprise=1), 'unknown field: found surprise'),
        (lambda t: t['axes']['roll']['base'][0].update(value='big'), 'gain.value: must be a f'),
        (lambda t: t['axes']['roll']['base'][0].update(value=True), 'gain.value: must be a f'),
        (lambda t: t['axes']['roll']['base'].pop(), 'must list gain, lag'),
        (lambda t: t['axes']['roll']['covariance'].pop(), 'must be 6 by 6'),
        (lambda t: t['axes']['roll'].update(active_gains=[1]), 'active_gains: must be an object'),
        (lambda t: t['axes']['roll'].update(trusted_band_rad_s=[1]), 'must be a pair'),
        (lambda t: t.update(axes={}), 'at least one axis'),
    ],
)
def test_a_damaged_file_is_named_in_one_line(tmp_path, damage, said):
    path = tmp_path / 'model.json'
    save_models({'roll': some_model()}, path)
    tree = json.loads(path.read_text())
    damage(tree)
    path.write_text(json.dumps(tree))
    with pytest.raises(BadInputError) as caught:
        load_models(path)
    assert said in str(caught.value)
    assert str(path) in str(caught.value)
    assert '\n' not in str(caught.value)


def test_a_missing_or_broken_file_is_named(tmp_path):
    with pytest.raises(BadInputError, match='cannot be read'):
        load_models(tmp_path / 'none.json')
    (tmp_path / 'half.json').write_text('{"schema": ')
    with pytest.raises(BadInputError, match='is not JSON'):
        load_models(tmp_path / 'half.json')
    with pytest.raises(BadInputError, match='cannot be written'):
        save_models({'roll': some_model()}, tmp_path / 'no_folder' / 'model.json')


# black-box models beside them


@pytest.fixture(scope='module')
def model():
    return bj(reference_study().record(np.random.default_rng(0)), 2, 2, 2, 2, 3)


def test_a_model_comes_back_the_same(model, tmp_path):
    path = tmp_path / 'model.json'
    path.write_text(json.dumps({'axes': {}, 'blackbox': {'roll': tree_of(model)}}))
    back = load_blackbox(path)['roll']
    for name in (*POLYNOMIALS, 'covariance'):
        np.testing.assert_array_equal(getattr(back, name), getattr(model, name))
    assert (back.name, back.nk, back.dt) == (model.name, model.nk, model.dt)
    u = np.random.default_rng(1).standard_normal(50)
    np.testing.assert_array_equal(simulate(back, u), simulate(model, u))


def test_a_file_without_them_gives_none(tmp_path):
    path = tmp_path / 'model.json'
    path.write_text('{"schema": "quad_sysid/model/1", "axes": {}}')
    assert load_blackbox(path) == {}


@pytest.mark.parametrize(
    ('change', 'named'),
    [({'A': [2.0]}, 'A'), ({'B': ['x']}, 'polynomial'), ({'dt': -1.0}, 'dt'),
     ({'covariance': [[1.0]]}, 'covariance'), ({'F': [1.0, float('nan')]}, 'F')],
)
def test_what_is_broken_is_named(model, tmp_path, change, named):
    path = tmp_path / 'model.json'
    path.write_text(json.dumps({'blackbox': {'roll': tree_of(model) | change}}))
    with pytest.raises(BadInputError, match=f'roll.*{named}'):
        load_blackbox(path)
