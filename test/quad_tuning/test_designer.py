"""The designer's refusals: each says why in one line, and gives no gains."""

import dataclasses
from importlib.metadata import entry_points

import numpy as np
import pytest

from quad_sysid.model import Parameter
from quad_tuning.designer import design


def with_gains(m, **values):
    gains = dict(m.active_gains) | {k.replace('__', '.'): v for k, v in values.items()}
    return dataclasses.replace(m, active_gains=gains)


def with_base(m, name, value):
    base = tuple(Parameter(p.name, value if p.name == name else p.value, p.std, p.unit)
                 for p in m.base)  # fmt: skip
    return dataclasses.replace(m, base=base)


def with_stds(*variances):
    return lambda m: dataclasses.replace(m, covariance=np.diag(variances))


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        (lambda m: with_base(m, 'gain', -450.0), 'a positive command lowers the rate'),
        (lambda m: with_base(m, 'gain', 0.0), 'lowers the rate'),
        (lambda m: with_base(m, 'gain', float('nan')), 'plant gain is nan'),
        (lambda m: with_base(m, 'gain', 8.0), 'may be zero or negative'),
        (lambda m: with_base(m, 'lag', float('nan')), 'lag is nan'),
        (lambda m: dataclasses.replace(m, covariance=None), 'no covariance'),
        (lambda m: dataclasses.replace(m, covariance=np.eye(2)), 'covariance is (2, 2)'),
        (with_stds(1e4, 0, 0, 0, 0), 'gain 450 +- 1e+02 is too uncertain'),
        (with_stds(25, 0, 0.01**2, 0, 0), 'delay 0.008 +- 0.01 s is too uncertain'),
        (with_stds(np.nan, 0, 0, 0, 0), 'lacks the plant gain'),
        (with_stds(85.0**2, 0.016**2, 0.0055**2, 0, 0), 'within the hard bounds'),
        (lambda m: dataclasses.replace(m, active_gains={}), "flight's gains are not known"),
        (lambda m: with_gains(m, roll__rate__kp=float('nan')), 'must be finite'),
        (lambda m: with_gains(m, roll__rate__kp=0.4), 'gains that flew are unstable'),
        (lambda m: dataclasses.replace(m, trusted_band_rad_s=(0.1, 5.0)), 'excite that band'),
        (lambda m: with_base(m, 'delay', 0.08), 'gains that flew are unstable'),
    ],
)
def test_a_model_that_allows_no_design_is_refused_with_the_reason(model, change, said):
    proposal = design(change(model()))
    assert proposal.gains is None
    assert said in proposal.refused_because
    assert proposal.refused_because.startswith('roll')
    assert '\n' not in proposal.refused_because


def test_gains_that_are_already_the_best_are_left_alone(model):
    """The design fed with its own answer: there is nothing left to gain."""
    m = model(lag=0.02, delay=0.004, gain=300.0)
    for _ in range(3):
        proposal = design(m)
        if proposal.gains is None:
            break
        m = dataclasses.replace(m, active_gains={**m.active_gains, **proposal.gains})
    assert proposal.gains is None
    assert 'keep all margins' in proposal.refused_because


def test_the_trusted_band_limits_the_crossover(model):
    m = dataclasses.replace(model(), trusted_band_rad_s=(0.1, 13.0))
    proposal = design(m)
    assert proposal.gains is not None
    assert proposal.figures['crossover_rad_s'] <= 26.1


def test_it_is_found_as_a_designer_where_the_package_is_installed():
    found = {e.name: e.value for e in entry_points(group='quad_sysid.designers')}
    if not found:
        pytest.skip('quad_tuning is not installed here, only on the path')
    assert found['pid'] == 'quad_tuning.designer:design'
