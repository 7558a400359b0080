"""What `import quad_sysid` offers: the names that the field expects, loaded when used."""

from dataclasses import replace

import numpy as np
import pytest
from node_process import python
from scipy.signal import savgol_filter

import quad_sysid
from quad_sysid.estimate.stored import estimate_of
from quad_sysid.record import GainChange

NAMES = (
    'read_bag', 'Record', 'IOData', 'arx', 'armax', 'oe', 'bj', 'iv4', 'clriv', 'greybox',
    'search_arx', 'delay_estimate', 'Model', 'simulate', 'predict', 'fit_percent', 'compare',
    'residual_test', 'frequency_response', 'spa', 'coherence', 'excitation_order', 'identify',
    'evaluate', 'Result', 'Effect', 'prbs', 'design_excitation',
)


def test_every_promised_name_is_there():
    assert all(callable(getattr(quad_sysid, name)) for name in NAMES)
    assert {effect.name for effect in quad_sysid.EFFECTS} >= {'coulomb_friction', 'resonance'}
    assert set(NAMES) <= set(quad_sysid.__all__)
    offered = {name for name in dir(quad_sysid) if not name.startswith('__')}
    assert offered == set(quad_sysid.__all__)
    assert all(getattr(quad_sysid, name) is not None for name in quad_sysid.__all__)
    with pytest.raises(AttributeError, match='no attribute'):
        quad_sysid.nothing  # noqa: B018


def printed_by(code: str) -> str:
    done = python('-c', code)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_import_loads_nothing_heavy_and_the_models_need_neither_ros_nor_matplotlib():
    assert printed_by(
        'import sys, quad_sysid, quad_sysid.cli; '
        'print(sorted({"numba", "scipy", "matplotlib", "rclpy"} & set(sys.modules)))'
    ) == '[]'
    assert printed_by(
        'import sys\n'
        'for name in ("rclpy", "matplotlib", "rosbags"): sys.modules[name] = None\n'
        'import quad_sysid; assert "numpy" not in sys.modules\n'
        'from quad_sysid import IOData, arx, greybox\n'
        'import numpy as np\n'
        'u = np.random.default_rng(0).standard_normal(500)\n'
        'print(arx(IOData(u, np.roll(u, 1), 0.01), 1, 1, 1).name, callable(greybox))'
    ) == 'ARX 1 1 1 True'


def test_a_rate_that_does_not_fit_is_told(refusal):
    rng = np.random.default_rng(0)
    u = rng.standard_normal(300)
    y = np.roll(u, 1) + 0.1 * rng.standard_normal(300)
    model = quad_sysid.arx(quad_sysid.IOData(u, y, 0.01), 1, 1, 1)
    other = quad_sysid.IOData(u, y, 0.02)
    for call in (lambda m, z: quad_sysid.compare(z, m),
                 lambda m, z: quad_sysid.residual_test(z, m),
                 lambda m, z: quad_sysid.predict(m, z, 1)):
        assert '100 Hz: found 50 Hz' in refusal(call, model, other)
    for call in (quad_sysid.compare, quad_sysid.residual_test):
        assert 'the data come first' in refusal(call, model, other)
    assert 'model of an axis comes first' in refusal(quad_sysid.evaluate, other, model)
    assert 'greybox' in refusal(quad_sysid.greybox, quad_sysid.IOData(u, y, 0.01))


@pytest.mark.usefixtures('quick')
def test_a_flight_to_a_result_in_one_call(plain_flight, refusal):
    result = quad_sysid.identify(plain_flight, axes='roll', effects=())
    assert (result.verdict, result.effects, result.rivals) == ('not_searched', (), {})
    assert list(result) == ['roll']
    assert result['roll'].model.value('gain') == pytest.approx(450.0, rel=0.02)
    assert 'effects were not searched for' in result.reason
    assert 'better than the base' not in str(result)
    assert 'not tested' not in str(result)  # the verdict says why
    shown = result._repr_html_()
    untested = {entry['name'] for entry in result.report['axes']['roll']['not_tested']}
    assert untested == {effect.label for effect in quad_sysid.EFFECTS}
    assert 'not_searched' in str(result)
    assert f'{result.errors["before"]:.3g}'[:4] in str(result)
    assert ('<pre>' in shown, 'suffices' in shown) == (True, False)
    assert '<img' in shown
    assert result.plot('free_run').axes
    found = quad_sysid.evaluate(result.model, plain_flight)
    z = plain_flight.axis('roll', 'train')
    model = quad_sysid.bj(z, 2, 2, 2, 2, 3)
    grey = quad_sysid.greybox(z, gyro_filter_hz=42.0)  # whose form is in the errors
    np.testing.assert_array_equal(grey.std, [p.std for p in grey.base])
    for value, words in (
        (plain_flight, 'train: prbs on roll'), (z, 'at 250 Hz in 1 segments'),
        (model, '  D = +1 '), (quad_sysid.residual_test(z, model), 'white: yes, p = '),
        (found, 'base (before) 0.'), (result.model, 'rad/s² per unit command')):
        assert words in repr(value) == str(value)
        assert len(repr(value)) < 500
    assert found.before == pytest.approx(result.errors['before'], rel=0.3)
    for call, words in (
        (lambda: result['yaw'], 'no such axis'),
        (lambda: result.model.value('gian'), "found 'gian'; it has gain, lag,"),
        (lambda: plain_flight.axis('roll', 'validate'), 'must be of train, validation, idle'),
        (lambda: result.plot('nothing'), 'no such'),
        (lambda: quad_sysid.identify(plain_flight, 'bank'), "found 'bank'"),
        (lambda: quad_sysid.greybox(z, gyro_filter_hz=1e4), 'gyro_filter_hz'),
        (lambda: result.model.simulate([np.nan, 1.0]), 'finite'),
    ):
        assert words in refusal(call)


def test_a_model_runs_freely_from_the_rate_that_it_is_given(true_model):
    """It decays by its damping; what a command does test_model_file.py has."""
    model, still = quad_sysid.Identified(**vars(true_model)), np.zeros(500)
    turning = model.simulate(still, (1.0, 0.0))
    assert turning[0] == pytest.approx(1.0)
    assert turning[-1] - model.simulate(still)[-1] == pytest.approx(
        np.exp(-model.value('damping') * 499 * model.dt), rel=1e-3)


def test_predictions_are_of_the_rate_where_only_the_angle_was_measured(true_model, plain_flight):
    seen = plain_flight.angles + 1e-3 * np.random.default_rng(0).standard_normal((
        plain_flight.n, 3))
    derived = replace(plain_flight, angles=seen, rates=savgol_filter(
        seen, 11, 3, deriv=1, delta=plain_flight.dt, axis=0),
        gains=(GainChange(0.0, {'sensor.rate_from_angle_s': 0.02}),))
    model = quad_sysid.Identified(**vars(true_model))
    assert np.nanstd(model.predict(derived) - model.predict(derived, np.int64(2))) < 0.12


def test_an_axis_alone_flies_by_its_motors_at_the_usual_voltage(true_model, plain_flight, refusal):
    flight, z = replace(plain_flight, segments=()), plain_flight.axis('roll')
    limited, sagging = models = [
        quad_sysid.Identified(**vars(replace(true_model, effects=(one,)))) for one in (
            estimate_of('saturation', (0.52,), 'upper'),
            estimate_of('battery_sag', (1.0,), settings={'reference_v': 12.4}))]
    (a, b), (c, d) = ([model.predict(one, 9) for model in models] for one in (flight, z))
    np.testing.assert_allclose([a, b], [c, d], atol=1e-9)
    assert np.nanstd(c - d) > 0.03
    assert 'needs /battery' in refusal(sagging.predict, replace(flight, battery_v=None))
    short = quad_sysid.IOData(z.u[:10], z.y[:10], z.dt)
    assert np.isfinite(limited.predict(short)).all()
