"""Simulation, prediction, residual tests, spectra, step A: against the truth and by twins."""

import math
from dataclasses import replace

import numpy as np
import pytest
from known_plants import Study, prbs_bits
from scipy import special
from scipy.signal import lfilter

import quad_sysid as qs
from quad_sysid.blackbox import horizon_errors, innovation_test, polynomial_model, step_a
from quad_sysid.blackbox.filters import filter_signal
from quad_sysid.pipeline.held_out import residual
from quad_sysid.record import IOData


@pytest.fixture(scope='module')
def record(study) -> IOData:
    return study.record(np.random.default_rng(2))


def test_horizon_errors_equal_predictions_one_by_one(study, record):
    spans = [(0, 3), (5, 400), (410, 900)]
    short = IOData(record.u[:900], record.y[:900], record.dt, segments=spans)
    for k, error in enumerate(horizon_errors(study.truth, short, 12), start=1):
        expected = short.y - qs.predict(study.truth, short, k)
        np.testing.assert_allclose(error, expected, atol=1e-10)


def test_segments_do_not_leak_into_each_other(study, record):
    cut = IOData(record.u, record.y, record.dt, segments=[(0, 4000), (5000, 9000)])
    wild = record.y.copy()
    wild[4000:5000] = 1e6
    other = IOData(record.u, wild, record.dt, segments=cut.segments)
    for horizon in (1, 7, math.inf):
        np.testing.assert_array_equal(
            qs.predict(study.truth, cut, horizon), qs.predict(study.truth, other, horizon)
        )
    assert np.isnan(qs.predict(study.truth, cut)[4000:5006]).all()


def test_fit_percent_by_hand(refusal):
    y = np.array([1.0, 2.0, 3.0, 4.0])
    for yhat, fit in (([1, 2, 3, 5], 100 * (1 - 1 / math.sqrt(5))), (y, 100.0),
                      (np.full(4, 2.5), 0.0), ([np.inf, 0, 0, 0], -math.inf)):
        assert qs.fit_percent(y, np.array(yhat, float)) == pytest.approx(fit)
    assert 'one length' in refusal(qs.fit_percent, y, y[:2])


def test_residual_test_passes_the_truth_as_often_as_stated(study):
    """Each boolean at 99 %: over 60 seeds in closed loop at most 4 false alarms (p = 0.003)."""
    short = Study(study.truth, samples=4000)
    tests = [
        qs.residual_test(short.record(np.random.default_rng(seed)), study.truth)
        for seed in range(60)
    ]
    for name in ('residual_white', 'residual_uncorrelated_with_input', 'causal'):
        assert sum(not getattr(t, name) for t in tests) <= 4, name
    assert {t.causality_signal for t in tests} == {'r'}
    # of single lags one in a hundred lies beyond its bound, coloured as both sides may be
    beyond = []
    for seed in range(20):
        white_both = np.random.default_rng(seed).standard_normal((2, 4000))
        e, u = lfilter([1.0], [1.0, -0.9], white_both)
        found = innovation_test(e, IOData(u, e, 0.004))
        beyond.append(np.abs(found.cross_correlation) > found.cross_bound)
    assert 0.002 < np.mean(beyond) < 0.03


def test_whiteness_allows_for_what_was_fitted_to_the_same_errors(study, record):
    """p of right models is uniform: means over 30 seeds within 4 sigma (0.29 √30) of a half."""
    p = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        u, noise = np.repeat(rng.choice([-1.0, 1.0], 400), 5), 0.1 * rng.standard_normal(2000)
        denominator = np.array([1.0, -1.6, 0.63])
        y = filter_signal(np.array([0.0, 0.05, 0.04]), denominator, u)
        z = IOData(u, y + filter_signal(np.ones(1), denominator, noise), 0.01)
        model = qs.arx(z, 10, 10, 1)
        p.append([step_a([model], z, {}, lags)[0].test.p_white for lags in (25, 5)])
    np.testing.assert_allclose(np.mean(p, axis=0), 0.5, atol=4 * 0.29 / math.sqrt(30))
    # nothing is taken off for B and F, nor where the fit did not minimise these errors
    joint = replace(study.truth, approach='joint')
    for model, spent in ((study.truth, 4), (joint, 0), (qs.oe(record, 2, 2, 3), 0),
                         (qs.arx(record, 3, 2, 3), 3), (qs.iv4(record, 3, 2, 3), 0)):
        test = step_a([model], record, {})[0].test
        plain = qs.residual_test(record, model)
        box = special.chdtri(25, plain.p_white)
        assert test.p_white == pytest.approx(special.chdtrc(25 - spent, box), rel=1e-6, abs=1e-300)
        assert test.p_causal == plain.p_causal


def test_residual_test_sees_feedback_only_where_there_is_some(study, record):
    without_r = IOData(record.u, record.y, record.dt)
    assert not qs.residual_test(without_r, study.truth).causal
    (row,) = step_a([study.truth], without_r, {})
    assert (row.test.causal, row.passed_first_step) == (False, True)
    opened = study.record(np.random.default_rng(9), closed=False)
    open_test = qs.residual_test(IOData(opened.u, opened.y, opened.dt), study.truth)
    assert (open_test.causal, open_test.causality_signal) == (True, 'u')


def test_residual_test_rejects_what_is_wrong(study, record):
    poor, truth = qs.residual_test(record, qs.arx(record, 2, 1, 1)), study.truth
    assert (poor.residual_white, poor.residual_uncorrelated_with_input) == (False, False)
    late = polynomial_model(np.concatenate((np.zeros(4), truth.B)), C=truth.C, D=truth.D,
                            F=truth.F, dt=truth.dt)
    assert not qs.residual_test(record, late).residual_uncorrelated_with_input
    early = IOData(record.u[:-9], record.y[9:], record.dt, r=record.r[:-9])
    assert not qs.residual_test(early, qs.arx(early, 10, 10, 1)).causal
    assert qs.residual_test(record, qs.arx(record, 10, 10, 3)).causal


def test_frequency_response_band_covers_the_truth():
    truth, w = polynomial_model([0, 0.5, 0.2], A=[1, -0.8], dt=0.1), np.array([0.3, 3.0, 12.0])
    expected, z = qs.frequency_response(truth, w).response, np.exp(1j * w * 0.1)
    np.testing.assert_allclose(expected, (0.5 / z + 0.2 / z**2) / (1 - 0.8 / z))
    inside = np.zeros(2)
    for seed in range(200):
        u, e = np.random.default_rng(seed).standard_normal((2, 400))
        y = qs.simulate(truth, u) + filter_signal(np.ones(1), truth.A, e)
        found = qs.frequency_response(qs.arx(IOData(u, y, 0.1), 1, 2, 1), w)
        error = np.abs(found.magnitude - np.abs(expected))
        turned = np.abs(np.angle(found.response / expected))
        inside += np.sum([error < 1.96 * found.magnitude_std, turned < 1.96 * found.phase_std], 1)
    assert ((inside > 0.92 * 600) & (inside < 0.98 * 600)).all()


def test_spa_and_coherence_in_open_and_closed_loop(study, record):
    w = np.array([2.0, 5.0, 10.0, 20.0])
    true = qs.frequency_response(study.truth, w).response
    joint = qs.spa(record, w, joint=True)
    assert np.all(np.abs(joint.response - true) < 4 * joint.std + 0.03 * np.abs(true))
    assert np.all(qs.coherence(record, w)[1] > 0.9)
    assert np.mean(qs.coherence(white(1, 8000), window=100)[1]) < 0.05


def test_excitation_order():
    t, rng = np.arange(2000.0), np.random.default_rng(0)
    for signal, order in (
        (np.ones(500), 1), (np.zeros(500), 0), (np.sin(0.3 * t), 2),
        (np.sin(0.3 * t) + np.sin(0.7 * t) + 1, 5), (np.tile(prbs_bits(5, 1), 20), 31),
    ):
        assert qs.excitation_order(signal) == order
    assert qs.excitation_order(rng.standard_normal(2000), max_order=60) == 60


def test_step_a_keeps_the_truth_and_says_why_others_go(study, record):
    validation = study.record(np.random.default_rng(21))
    wild = polynomial_model([0, 0.1], A=[1, -1.2], dt=record.dt)
    models = [qs.arx(record, 2, 1, 0), study.truth, wild]
    poor, good, unstable = step_a(models, record, {'prbs': validation, 'none': validation})
    assert not poor.passed_first_step
    assert 'nk = 0' in poor.eliminated_because
    assert 'white' in poor.eliminated_because
    assert (good.eliminated_because, unstable.passed_first_step) == ('', False)
    assert good.fit_train_pct == pytest.approx(98.6, abs=0.1)
    assert good.fit_validation_pct['prbs'] == pytest.approx(93.2, abs=0.5)
    assert poor.aic > good.aic
    report = good.as_report()
    assert (report['structure'], report['passed_first_step']) == ('BJ', True)
    assert unstable.fit_validation_pct == {'prbs': None, 'none': None}
    assert 'unstable' in unstable.eliminated_because
    assert 'on held-out data is no better' in unstable.eliminated_because  # of none is no sentence


@pytest.mark.parametrize(
    ('call', 'said'),
    [
        (lambda m, z: qs.predict(m, z, 0), 'horizon'),
        (lambda m, _: qs.simulate(m, np.array([np.nan])), 'u must be'),
        (lambda m, z: qs.residual_test(IOData(z.u[:200], z.y[:200], z.dt), m), 'too few residua'),
        (lambda m, _: qs.frequency_response(m, np.array([1e5])), 'w must be'),
        (lambda _, z: qs.spa(z, window=10**6), 'window'),
        (lambda _, z: qs.spa(IOData(z.u, z.y, z.dt), joint=True), 'reference r'),
        (lambda _, z: qs.spa(IOData(0.0 * z.u, z.y, z.dt, r=z.r)), 'u is constant'),
        (lambda _, z: step_a([], z, {}), 'models'),
        (lambda _, z: innovation_test(np.full(z.n, np.nan), z), 'too few residuals'),
    ],
)
def test_bad_arguments(study, record, refusal, call, said):
    assert said in refusal(call, study.truth, record)


def white(seed: int, n: int = 6000) -> IOData:
    """A command, and white one-step errors in the output's place."""
    rng = np.random.default_rng(seed)
    return IOData(u=rng.standard_normal(n), y=rng.standard_normal(n), dt=0.004)


def test_a_line_in_the_errors_is_a_peak_and_white_noise_has_none() -> None:
    z = white(4, 10_000)
    assert residual(z.y, z).peaks == ()
    lined = residual(z.y + 0.4 * np.sin(2.0 * np.pi * 7.0 * 0.004 * np.arange(z.n)), z)
    assert lined.peaks[0][0] == pytest.approx(7.0, abs=0.5)
    # Parseval: the spectrum holds all of the errors' power
    power = np.sum(lined.density) * (lined.frequency_hz[1] - lined.frequency_hz[0])
    assert power == pytest.approx(lined.rms**2, rel=0.05)
