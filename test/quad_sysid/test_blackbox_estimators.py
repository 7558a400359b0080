"""Polynomial models: recovery of known plants, in closed loop too; ARX equals lstsq."""

import math
from dataclasses import replace

import numpy as np
import pytest
from known_plants import Study, reference_study

import quad_sysid as qs
from quad_sysid.axes import EVERY
from quad_sysid.blackbox import cascade_controller, indirect, joint, polynomial_model
from quad_sysid.blackbox.filters import filter_signal
from quad_sysid.record import IOData, Record


def flight(study: Study, seed: int) -> IOData:
    return study.record(np.random.default_rng(seed))


def distance(model: qs.Model, truth: qs.Model) -> float:
    """Squared Mahalanobis distance of the parameters from the truth."""
    error = model.parameters - truth.parameters
    return float(error @ np.linalg.solve(model.covariance, error))


def test_fits_reach_the_ceiling_and_their_covariance_on_each_seed(study):
    """Free-run fit on another seed, in points below the true model's: 0.03, 0.06.

    ARMAX cannot describe this noise: its optimum lies 0.25 below (0.27 with 300,000 samples) and
    scatters, 0.30 in the mean and 0.42 on each seed are asked. Squared distances of BJ and CL-RIV
    from the truth are chi² with 8 degrees of freedom: their mean within 4 sigma.
    """
    below, nees = [], []
    for seed in range(3):
        z, validation = flight(study, seed), flight(study, 1000 + seed)
        first, second = qs.bj(z, 2, 2, 2, 2, 3), qs.clriv(z, 2, 2, 2, 2, 3)
        models = [first, qs.oe(z, 2, 2, 3), qs.armax(z, 3, 3, 3, 1)]
        assert all(model.converged for model in (*models, second))
        truth, *fits = qs.compare(validation, study.truth, *models)
        below.append(truth - np.array(fits))
        nees.append([distance(model, study.truth) for model in (first, second)])
        np.testing.assert_allclose(second.std, first.std, rtol=0.5)
    np.testing.assert_array_less(np.max(below, axis=0), [0.03, 0.06, 0.42])
    assert np.mean(below, axis=0)[2] < 0.30
    np.testing.assert_allclose(np.mean(nees, axis=0), 8.0, atol=4 * math.sqrt(16 / 3))


def test_iv4_with_the_reference_is_right_where_least_squares_is_biased():
    truth = polynomial_model([0, 0.3, 0.1], F=[1, -0.9], C=[1, 0.5], D=[1, -0.9], dt=0.004,
                             noise_variance=0.05)
    study = Study(truth, amplitude=5.0)
    off, covered, least = [], 0, []
    for seed in range(12):
        z = study.record(np.random.default_rng(seed))
        model = qs.iv4(z, 1, 2, 1)
        assert model.stable
        off.append(model.parameters - [-0.9, 0.3, 0.1])
        covered += int(np.sum(np.abs(off[-1]) < 2.58 * model.std))
        least.append(qs.arx(z, 1, 2, 1).parameters[0] + 0.9)
    assert covered >= 33
    assert abs(np.mean(least)) > 5 * abs(np.mean([x[0] for x in off]))


@pytest.mark.parametrize(('fit', 'f', 'd'), [
    (qs.iv4, [1.0, -0.9], [1.0]), (qs.iv4, [1.0, -0.9], [1.0, -0.5, 0.9]),
    (qs.iv4, [1.0, -1.6, 0.63], [1.0, -0.995]), (qs.oe, [1.0, -0.9], [1.0, -0.95])])
def test_covariance_allows_for_coloured_residuals(fit, f, d):
    """White noise, a resonance and a drift beside the plant, in two segments.

    The squared distance from the truth is chi² with p degrees of freedom: its mean over 60 seeds
    within 4 sigma.
    """
    truth = polynomial_model([0, 0.5, 0.2], F=f, D=d, dt=0.1)
    orders, wanted = (len(f) - 1, 2, 1), [*f[1:], 0.5, 0.2]
    if fit is qs.oe:
        orders, wanted = (2, len(f) - 1, 1), [0.5, 0.2, *f[1:]]
    distances = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.choice([-1.0, 1.0], 250), 8)
        noise = filter_signal(np.ones(1), truth.D, 0.1 * rng.standard_normal(2000))
        z = IOData(u, qs.simulate(truth, u) + noise, 0.1, segments=[(0, 900), (900, 2000)])
        model = fit(z, *orders)
        error = model.parameters - wanted
        distances.append(error @ np.linalg.solve(model.covariance, error))
    p = len(f) + 1
    assert np.mean(distances) == pytest.approx(p, abs=4 * math.sqrt(2 * p / 60))


@pytest.mark.parametrize('case', ['a fast plant', 'the reference study'])
def test_joint_covariance_is_that_of_both_stages(study, case):
    """The plant's squared distance from the truth is chi²: mean over 10 seeds within 4 sigma.

    In both cases feedback takes most of the noise out of y; in the reference study the plant's
    high gain at low frequencies makes the first stage's errors count, too. In ten times its noise
    a first stage without a model of that noise is off by nine times its standard errors squared.
    """
    order, structure = 7, qs.bj
    study = replace(study, truth=replace(study.truth, noise_variance=2.5))
    if case == 'a fast plant':
        order, structure, study = 6, qs.oe, Study(polynomial_model(
            [0, 0.3, 0.1], F=[1, -0.9], C=[1, 0.5], D=[1, -0.9], dt=0.004, noise_variance=0.05),
            amplitude=5.0)
    true, nf, nk = study.truth, study.truth.F.size - 1, study.truth.nk
    orders = (2, 2, 2, nf, nk) if structure is qs.bj else (2, nf, nk)
    distances = []
    for seed in range(10):
        z = flight(replace(study, samples=5000), seed)
        model = joint(z, lambda data: structure(data, *orders), order=order)
        assert model.approach == 'joint'
        plant = [0, 1, *range(model.parameters.size - nf, model.parameters.size)]
        error = model.parameters[plant] - [*true.B[nk:], *true.F[1:]]
        distances.append(error @ np.linalg.solve(model.covariance[np.ix_(plant, plant)], error))
    p = 2 + nf
    assert np.mean(distances) == pytest.approx(p, abs=4 * math.sqrt(2 * p / 10))


def test_joint_without_feedback_is_direct_and_with_poles_in_common_has_no_errors(study):
    z = study.record(np.random.default_rng(3), closed=False)
    opened, direct = joint(z, lambda data: qs.bj(data, 2, 2, 2, 2, 3)), qs.bj(z, 2, 2, 2, 2, 3)
    np.testing.assert_array_equal(opened.covariance, direct.covariance)
    assert joint(flight(study, 3), lambda data: qs.arx(data, 2, 2, 3)).std is None


@pytest.mark.parametrize(('segments', 'rate_ki'), [
    ((), 0.01), (((2000, 8000), (9000, 15000)), 0.05)])
def test_indirect_finds_the_plant_without_the_recorded_command(study, refusal, segments, rate_ki):
    study = replace(study, cascade=replace(study.cascade, rate_ki=rate_ki))
    z, validation, gains = flight(study, 12), flight(study, 1000), study.cascade
    controller = cascade_controller(
        angle_kp=gains.angle_kp, rate_kp=gains.rate_kp, rate_ki=gains.rate_ki,
        rate_kd=gains.rate_kd, dt=z.dt, trapezoid=False,
        d_weight=1.0 - np.exp(-2.0 * np.pi * gains.d_filter_hz * z.dt),
    )
    np.testing.assert_allclose(controller.command(z.r, z.y), z.u, atol=1e-6)
    noise = np.random.default_rng(0).standard_normal(z.y.size)
    model = indirect(IOData(noise, z.y, z.dt, r=z.r, segments=segments), 2, 2, 3, controller)
    assert (model.approach, model.converged) == ('indirect', True)
    assert qs.compare(validation, model)[0] > qs.compare(validation, study.truth)[0] - 0.1
    true = [*study.truth.B[3:], *study.truth.F[1:]]
    assert np.all(np.abs(model.parameters - true) < 4 * model.std)
    assert 'reference r' in refusal(indirect, IOData(z.u, z.y, z.dt), 2, 2, 3, controller)
    short = replace(z, segments=[(k, k + 14) for k in range(0, 3000, 14)])
    assert 'too few samples' in refusal(indirect, short, 2, 2, 3, controller, start=model)


@pytest.mark.parametrize('seed', [1, 6])
def test_a_drift_leaves_oe_on_the_edge_of_stability_and_converged(seed):
    """A random walk beside the plant: the least loss is on the edge, no start has less (1e-6)."""
    truth = polynomial_model([0, 0, 0.004, 0.003], F=[1, -1.9, 0.9025], dt=0.004)
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], 300), 20)
    drift = 0.02 * rng.standard_normal(6000).cumsum()
    z = IOData(u, qs.simulate(truth, u) + drift + 0.02 * rng.standard_normal(6000), 0.004)
    model = qs.oe(z, 2, 3, 2)
    assert model.converged
    assert np.max(np.abs(model.poles)) == pytest.approx(1.0, abs=1e-6)
    assert model.stable
    assert 'edge of stability' in model.warnings[0]
    spread = model.covariance[2:, 2:]
    assert spread.sum() < 1e-6 * np.trace(spread)  # of F(1), which a pole at 1 holds at 0
    inner = sorted(model.poles, key=abs)[:-1]
    for pole in (0.99, 0.9999):
        start = replace(model, F=np.real(np.poly([*(0.99 * one for one in inner), pole])))
        again = qs.oe(z, 2, 3, 2, start=start)
        assert again.converged
        assert model.loss <= again.loss * (1.0 + 1e-6)


def test_data_without_noise_give_the_plant_exactly():
    truth = polynomial_model([0, 0, 0.1, 0.05], F=[1, -1.6, 0.68], dt=0.01)
    u = np.random.default_rng(0).choice([-1.0, 1.0], 2000)
    z = IOData(u, qs.simulate(truth, u), 0.01)
    found = qs.search_arx(z, range(1, 5), range(1, 5), range(5))
    assert (found.best, found.at_edge, qs.delay_estimate(z)) == ((2, 2, 2), (), 2)
    assert qs.delay_estimate(reference_study().record(np.random.default_rng(5))) == 3
    for model in (qs.armax(z, 2, 2, 2, 2), qs.oe(z, 2, 2, 2), qs.bj(z, 2, 1, 1, 2, 2),
                  qs.iv4(z, 2, 2, 2)):
        assert model.converged
        np.testing.assert_allclose(model.denominator, truth.F, atol=1e-8)
        np.testing.assert_allclose(model.B, truth.B, atol=1e-8)


@pytest.mark.parametrize(('fit', 'orders'), [
    (qs.bj, (4, 2, 2, 4, 1)), (qs.oe, (2, 2, 1)), (qs.armax, (2, 3, 1, 1))])
def test_a_sine_alone_is_refused_and_prbs_beside_it_is_not(fit, orders, refusal):
    """A sine tells two numbers of a plant, no more."""
    sine, rng = np.sin(0.3 * np.arange(2000)), np.random.default_rng(0)
    truth = polynomial_model([0, 0.1, 0.05], F=[1, -1.5, 0.6], dt=0.01)
    noise = 0.01 * rng.standard_normal(2000)
    z = IOData(sine, qs.simulate(truth, sine) + noise, 0.01)
    assert 'does not excite' in refusal(fit, z, *orders)
    rich = sine + rng.choice([-1.0, 1.0], 2000)
    assert fit(IOData(rich, qs.simulate(truth, rich) + noise, 0.01), *orders).converged


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
def cut() -> IOData:
    z = reference_study().record(np.random.default_rng(7))
    return IOData(z.u[:2000], z.y[:2000], z.dt, segments=[(0, 900), (950, 2000)])


@pytest.mark.parametrize('orders', [(2, 2, 1), (10, 10, 5), (0, 3, 0), (4, 1, 9)])
def test_arx_equals_lstsq_over_segments(cut, orders):
    na, nb, nk = orders
    lead = max(na, nk + nb - 1)
    theta, sse, rows, information = plain_arx(cut, na, nb, nk, lead)
    model = qs.arx(cut, na, nb, nk)
    np.testing.assert_allclose(model.parameters, theta, rtol=1e-7, atol=1e-10)
    assert model.samples == rows
    assert model.loss == pytest.approx(sse / rows, rel=1e-10)
    assert model.noise_variance == pytest.approx(sse / (rows - na - nb), rel=1e-10)
    covariance = model.noise_variance * np.linalg.inv(information)
    np.testing.assert_allclose(model.covariance, covariance, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize('criterion', ['aic', 'bic'])
def test_search_equals_lstsq_to_1e9(cut, criterion):
    found = qs.search_arx(cut, range(4), [1, 3, 4], range(0, 4, 2), criterion)
    for *orders, value in zip(found.na, found.nb, found.nk, found.values(), strict=True):
        na, nb, nk = map(int, orders)
        _, sse, n, _ = plain_arx(cut, na, nb, nk, lead=5)
        k, fit = na + nb, n * math.log(sse / n)
        expected = fit + {'aic': 2, 'bic': math.log(n)}[criterion] * k
        assert n == found.samples
        assert value == pytest.approx(expected, rel=1e-9)
    best = int(np.argmin(found.values()))
    assert found.best == (found.na[best], found.nb[best], found.nk[best])
    assert tuple(found.model.orders.values()) == found.best


def test_model_names_parameters_and_converts():
    control = pytest.importorskip('control')
    truth = reference_study().truth
    assert truth.name == 'BJ 2 2 2 2 3'
    assert truth.parameter_names == ('b3', 'b4', 'c1', 'c2', 'd1', 'd2', 'f1', 'f2')
    np.testing.assert_allclose(sorted(np.abs(truth.poles)), np.exp([-20 * 0.004, -0.3 * 0.004]))
    again = truth.with_parameters(truth.parameters)
    assert isinstance(again, qs.Model)
    np.testing.assert_array_equal(again.B, truth.B)
    plant = truth.to_control()
    u = np.random.default_rng(0).standard_normal(300)
    expected = control.forced_response(plant, np.arange(300) * truth.dt, u).outputs
    np.testing.assert_allclose(qs.simulate(truth, u), expected, rtol=1e-8, atol=1e-10)
    with pytest.raises(ValueError):
        truth.B[0] = 1.0


NOISE = np.random.default_rng(0).standard_normal((2, 600))
STILL = Record('', 0.004, np.zeros((9, 3)), np.zeros((9, 4)))


def reference(z: IOData, r: np.ndarray) -> IOData:
    return IOData(z.u, z.y, z.dt, r=r, segments=z.segments)


@pytest.mark.parametrize(
    ('call', 'named'),
    [
        (lambda z: qs.arx(z, -1, 2, 1), 'na'), (lambda z: qs.arx(z, 2, 0, 1), 'nb'),
        (lambda z: qs.arx(z, 2, 2, -1), 'nk'), (lambda z: qs.arx(z, 2.5, 2, 1), 'na'),
        (lambda z: qs.arx(IOData(z.u[:9], z.y[:9], z.dt), 2, 2, 1), 'too few samples'),
        (lambda z: qs.arx(IOData(0 * z.u, z.y, z.dt), 2, 2, 1), 'arx: u is constant'),
        (lambda z: qs.arx((z.u, z.y), 2, 2, 1), 'z must be an IOData'),
        (lambda z: qs.search_arx(z, [], 2, 1), 'na'),
        (lambda z: qs.arx(IOData(np.sin(0.1 * np.arange(2000)), z.y, z.dt), 0, 8, 1), 'excite'),
        (lambda z: qs.armax(z, 2, 2, -1, 1), 'nc'), (lambda z: qs.oe(z, 2, 2, -1), 'nk'),
        (lambda z: qs.clriv(z, 2, 2, 2, 2, 1), 'reference'),
        (lambda _: polynomial_model([0, 0], dt=0.1), 'B'),
        (lambda z: qs.predict(qs.arx(z, 1, 1, 1), z, 'a'), 'predict: horizon must be'),
        (lambda z: qs.clriv(reference(z, np.full(z.y.size, 2.0)), 1, 1, 1, 1, 1),
         'clriv: the reference r is constant'),
        (lambda _: qs.iv4(IOData(*NOISE, 0.01, r=np.sin(np.arange(600))), 1, 1, 1),
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
def test_bad_input_names_who_was_called_and_with_what(cut, refusal, call, named):
    assert named in refusal(call, cut)
