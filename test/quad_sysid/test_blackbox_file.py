"""Black-box models in model.json: what is written comes back; what is broken is named."""

import json

import numpy as np
import pytest

from quad_sysid.blackbox import bj, simulate
from quad_sysid.blackbox.studies import reference_study
from quad_sysid.errors import BadInputError
from quad_sysid.report.blackbox_file import POLYNOMIALS, load_blackbox, tree_of


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
