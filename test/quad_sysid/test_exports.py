"""An exported model is the model: same response in every format, and the commands say so."""

import runpy
from dataclasses import replace

import numpy as np
import pytest
from flown_axis import model_of
from scipy.io import loadmat

from quad_sysid.axes import LEAN, THRUST
from quad_sysid.cli import main
from quad_sysid.estimate.stored import estimate_of
from quad_sysid.exports import as_control, matrices
from quad_sysid.report.model_file import save_models
from quad_sysid.units import Units

BASE = {'gain': 450.0, 'lag': 0.042, 'delay': 0.0094, 'damping': 0.4, 'bias': 0.1}
DT, FILTER_HZ = 0.004, 42.0
VOLTS = Units('V', 0.05, 0.0, 'rpm', np.pi / 30.0, 'rev', 2.0 * np.pi)


@pytest.fixture
def model():
    return model_of(estimate_of('coulomb_friction', (0.16,), std=0.01), **BASE,
                    gyro_filter_hz=FILTER_HZ)


def test_a_model_with_play_is_exported_without_it(model):
    """Small motion leaves its state at rest: the linear systems to compare differ in size."""
    loose = replace(model, effects=(estimate_of('backlash', (0.01,), std=0.001),))
    np.testing.assert_array_equal(matrices(loose)['Ad'], matrices(model)['Ad'])


def test_an_export_is_in_the_units_of_its_model(model):
    for axis, units, words, torque in (
            ('climb', THRUST, 'command (norm.) to speed (m/s) and position (m)', '0.16 m/s²'),
            ('surge', LEAN, 'command (rad of lean) to speed (m/s) and pos', '0.16 m/s²'),
            ('roll', VOLTS, 'command (V) to rate (rpm) and angle (rev)', '0.0254648 rev/s²')):
        there = replace(model, axis=axis, units=units)
        text = as_control({axis: there}).decode()
        assert f'# {axis}: {words}' in text
        assert f'coulomb_friction.torque = {torque}' in text
        assert ('@ motors' in text) == (axis == 'climb')  # else the command is not a mix of them
        found, si = matrices(there), matrices(replace(model, axis=axis))
        for b, c in (('B', 'C'), ('Bd', 'Cd')):
            np.testing.assert_allclose(found[b], units.per_command * si[b])
            np.testing.assert_allclose(found[c] * [[units.per_rate], [units.per_motion]], si[c])


@pytest.fixture
def stored(model, tmp_path):
    save_models({'roll': model}, tmp_path / 'model.json')
    return tmp_path / 'model.json'


def expected(omega: np.ndarray) -> np.ndarray:
    """Rate per command by the formula, without the hold."""
    s = 1j * omega
    x = s / (2 * np.pi * FILTER_HZ)
    return (BASE['gain'] * np.exp(-s * BASE['delay']) / (1 + s * BASE['lag'])
            / (s + BASE['damping']) / (1 + np.sqrt(2) * x + x**2))


def respond(a, b, c, points):
    return np.array([(c @ np.linalg.solve(p * np.eye(len(a)) - a, b))[0, 0] for p in points])


def test_both_forms_have_the_response_of_the_formula(model):
    found, omega = matrices(model), np.array([0.5, 3.0, 10.0, 30.0])
    continuous = respond(found['A'], found['B'], found['C'], 1j * omega)
    continuous *= np.exp(-1j * omega * found['delay_s'])
    np.testing.assert_allclose(continuous, expected(omega), rtol=1e-4)
    z = np.exp(1j * omega * DT)
    discrete = respond(found['Ad'], found['Bd'], found['Cd'], z)
    hold = (1 - 1 / z) / (1j * omega * DT)
    # a held command adds its hold, and aliases little this far below 785 rad/s
    np.testing.assert_allclose(discrete, expected(omega) * hold, rtol=2e-3)


def test_python_control_has_the_same_system(model, stored, tmp_path):
    pytest.importorskip('control')
    found = matrices(model)
    out = tmp_path / 'aircraft.py'
    assert main(['export', str(stored), '--to', 'control', '--out', str(out), '--quiet']) == 0
    again = runpy.run_path(str(out))['axes']['roll']
    np.testing.assert_allclose(again.A, found['Ad'], rtol=1e-15)
    np.testing.assert_allclose(again.C, found['Cd'], rtol=1e-15)
    assert again.dt == DT
    assert again.input_labels == ['command']
    assert 'coulomb_friction.torque = 0.16 rad/s²' in out.read_text()


@pytest.mark.parametrize('form', ['control', 'mat'])
def test_what_the_data_forbid_goes_with_the_model(model, tmp_path, capsys, form):
    stored, because = tmp_path / 'model.json', 'the commands predict nothing'
    save_models({'roll': replace(model, no_gains_because=because)}, stored)
    out = tmp_path / f'aircraft.{form}'
    assert main(['export', str(stored), '--to', form, '--out', str(out), '--quiet']) == 0
    assert f'roll: do not design gains with it: {because}' in capsys.readouterr().err
    assert because in (out.read_text() if form == 'control' else
                       str(loadmat(out)['roll']['warning'][0, 0]))
