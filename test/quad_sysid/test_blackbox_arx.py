"""ARX, its order search and the model object: recovery on known plants, equality with lstsq."""

import math

import numpy as np
import pytest
from known_plants import reference_study

from quad_sysid.axes import EVERY
from quad_sysid.blackbox import (
    Model,
    armax,
    arx,
    clriv,
    delay_estimate,
    iv4,
    oe,
    polynomial_model,
    predict,
    search_arx,
    simulate,
)
from quad_sysid.blackbox.filters import filter_signal
from quad_sysid.record import IOData, Record


def plain_arx(z: IOData, na: int, nb: int, nk: int, lead: int) -> tuple:
    """theta, SSE, rows, information by numpy.linalg.lstsq on explicitly written rows."""
    rows, targets = [], []
    for start, stop in z.segments:
        for t in range(start + lead, stop):
            past_y = [-z.y[t - i] for i in range(1, na + 1)]
            rows.append(past_y + [z.u[t - nk - i] for i in range(nb)])
            targets.append(z.y[t])
    x, y = np.array(rows), np.array(targets)
    theta = np.linalg.lstsq(x, y, rcond=None)[0]
    return theta, float(np.sum((y - x @ theta) ** 2)), len(y), x.T @ x


@pytest.fixture(scope='module')
def record() -> IOData:
    z = reference_study().record(np.random.default_rng(7))
    return IOData(z.u[:2000], z.y[:2000], z.dt, segments=[(0, 900), (950, 2000)])


@pytest.mark.parametrize('orders', [(2, 2, 1), (10, 10, 5), (0, 3, 0), (4, 1, 9)])
def test_arx_equals_lstsq_over_segments(record, orders):
    na, nb, nk = orders
    lead = max(na, nk + nb - 1)
    theta, sse, rows, information = plain_arx(record, na, nb, nk, lead)
    model = arx(record, na, nb, nk)
    np.testing.assert_allclose(model.parameters, theta, rtol=1e-7, atol=1e-10)
    assert model.samples == rows
    assert model.loss == pytest.approx(sse / rows, rel=1e-10)
    assert model.noise_variance == pytest.approx(sse / (rows - na - nb), rel=1e-10)
    covariance = model.noise_variance * np.linalg.inv(information)
    np.testing.assert_allclose(model.covariance, covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize('criterion', ['aic', 'bic'])
def test_search_equals_lstsq_to_1e9(record, criterion):
    found = search_arx(record, range(4), [1, 3, 4], range(0, 4, 2), criterion)
    for *orders, value in zip(found.na, found.nb, found.nk, found.values(), strict=True):
        na, nb, nk = map(int, orders)
        _, sse, n, _ = plain_arx(record, na, nb, nk, lead=5)
        k, fit = na + nb, n * math.log(sse / n)
        expected = fit + {'aic': 2, 'bic': math.log(n)}[criterion] * k
        assert n == found.samples
        assert value == pytest.approx(expected, rel=1e-9)
    best = int(np.argmin(found.values()))
    assert found.best == (found.na[best], found.nb[best], found.nk[best])
    assert tuple(found.model.orders.values()) == found.best


def test_search_finds_true_orders_of_a_known_arx():
    rng = np.random.default_rng(3)
    truth = polynomial_model([0, 0, 0, 0.1, 0.05], A=[1, -1.5, 0.7], dt=0.004)
    u = np.repeat(rng.choice([-1.0, 1.0], 2500), 4)
    e = 0.1 * rng.standard_normal(u.size)
    z = IOData(u, simulate(truth, u) + filter_signal(np.ones(1), truth.A, e), 0.004)
    found = search_arx(z, range(1, 7), range(1, 7), range(8), criterion='bic')
    assert found.best == (2, 2, 3)
    assert found.at_edge == ()
    error = (found.model.parameters - truth.parameters) / found.model.std
    assert np.max(np.abs(error)) < 3.5
    assert found.model.noise_variance == pytest.approx(0.01, rel=0.05)
    assert delay_estimate(z) == 3
    assert delay_estimate(reference_study().record(np.random.default_rng(5))) == 3


def test_model_names_parameters_and_converts():
    control = pytest.importorskip('control')
    truth = reference_study().truth
    assert truth.name == 'BJ 2 2 2 2 3'
    assert truth.parameter_names == ('b3', 'b4', 'c1', 'c2', 'd1', 'd2', 'f1', 'f2')
    np.testing.assert_allclose(sorted(np.abs(truth.poles)), np.exp([-20 * 0.004, -0.3 * 0.004]))
    again = truth.with_parameters(truth.parameters)
    assert isinstance(again, Model)
    np.testing.assert_array_equal(again.B, truth.B)
    plant = truth.to_control()
    u = np.random.default_rng(0).standard_normal(300)
    expected = control.forced_response(plant, np.arange(300) * truth.dt, u).outputs
    np.testing.assert_allclose(simulate(truth, u), expected, rtol=1e-8, atol=1e-10)
    with pytest.raises(ValueError):
        truth.B[0] = 1.0


NOISE = np.random.default_rng(0).standard_normal((2, 600))
STILL = Record('', 0.004, np.zeros((9, 3)), np.zeros((9, 4)))


def reference(z: IOData, r: np.ndarray) -> IOData:
    return IOData(z.u, z.y, z.dt, r=r, segments=z.segments)


@pytest.mark.parametrize(
    ('call', 'named'),
    [
        (lambda z: arx(z, -1, 2, 1), 'na'), (lambda z: arx(z, 2, 0, 1), 'nb'),
        (lambda z: arx(z, 2, 2, -1), 'nk'), (lambda z: arx(z, 2.5, 2, 1), 'na'),
        (lambda z: arx(IOData(z.u[:9], z.y[:9], z.dt), 2, 2, 1), 'too few samples'),
        (lambda z: arx(IOData(0 * z.u, z.y, z.dt), 2, 2, 1), 'arx: u is constant'),
        (lambda z: arx((z.u, z.y), 2, 2, 1), 'z must be an IOData'),
        (lambda z: search_arx(z, [], 2, 1), 'na'),
        (lambda z: arx(IOData(np.sin(0.1 * np.arange(2000)), z.y, z.dt), 0, 8, 1), 'excite'),
        (lambda z: armax(z, 2, 2, -1, 1), 'nc'), (lambda z: oe(z, 2, 2, -1), 'nk'),
        (lambda z: clriv(z, 2, 2, 2, 2, 1), 'reference'),
        (lambda _: polynomial_model([0, 0], dt=0.1), 'B'),
        (lambda z: predict(arx(z, 1, 1, 1), z, 'a'), 'predict: horizon must be'),
        (lambda z: clriv(reference(z, np.full(z.y.size, 2.0)), 1, 1, 1, 1, 1),
         'clriv: the reference r is constant'),
        (lambda _: iv4(IOData(*NOISE, 0.01, r=np.sin(np.arange(600))), 1, 1, 1),
         'iv4: no response from the reference r'),
        (lambda z: IOData(z.u, z.y, 'a'), 'IOData: dt must be a positive number'),
        (lambda z: reference(z, z.y[:-1]), 'r must have the length of y'),
        (lambda z: IOData(z.u, np.inf * z.u, z.dt), 'of y holds NaN or infinity'),
        (lambda z: IOData(z.u, z.y, z.dt, segments=[(300, 600), (0, 301)]), 'must not overlap'),
        (lambda z: IOData(z.u, z.y, z.dt, segments=[(0, 2001)]), 'must lie in 0..2000'),
        *((lambda _, call=call, name=name: getattr(STILL, call)(name),
           f'Record.{call}: axis must be one of {", ".join(EVERY)}: found {name!r}')
          for call in ('axis', 'external') for name in ('x', '', None, 0)),
    ],
)
def test_bad_input_names_who_was_called_and_with_what(record, refusal, call, named):
    assert named in refusal(call, record)
