"""Recordings that nobody here made: what the commands say of them, and what is added to them.

The data lie beside the checkout (shared/data); without them the tests skip. Figures to compare
with are those of its README. Most take minutes and are long.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from scipy.signal import butter, lfilter

import quad_sysid
from quad_sysid import cli
from quad_sysid.bags import read_bag, split_segments
from quad_sysid.contract import AXES
from quad_sysid.discover.base import best_base
from quad_sysid.effects import EFFECTS
from quad_sysid.estimate import stored
from quad_sysid.estimate.fit import Problem
from quad_sysid.model.data import axis_data
from quad_sysid.model.effect import Signals
from quad_sysid.pipeline import identify as pipeline
from quad_sysid.pipeline.answer import AxisAnswer
from quad_sysid.record import Record
from quad_sysid.report import document
from quad_sysid.report.model_file import load_models

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / '../shared/data'
MIXER = 'crazyflie'
SCHEMA = json.loads(
    (Path(document.__file__).parent / 'report.schema.json').read_text(encoding='utf-8')
)
EMPS_OPTIONS = (
    '--axis', 'roll', '--time', 't', '--control', 'vir', '--angle', 'qm', '--reference', 'qg',
    '--unit', 'vir=V', '--unit', 'qm=m', '--unit', 'qg=m',
)
NANOBENCH = (
    'B2_circle_fast_rep1', 'B3_figure8_fast_rep1', 'B7_oval_fast_rep1', 'B10_lissajous_fast_rep1',
)


def measured(path: str) -> Path:
    """The file or folder of that name in the shared data, or a skip with the reason."""
    found = DATA / path
    if not found.exists():
        pytest.skip(f'shared/data/{path} is not beside this checkout')
    return found


def report_of(folder: Path, axis: str = 'roll') -> dict:
    """The axis in DIR/report.json, checked against the contract's schema."""
    tree = json.loads((folder / 'report.json').read_text(encoding='utf-8'))
    jsonschema.validate(tree, SCHEMA)
    return tree['axes'][axis]


def evaluated(model: Path, bag: Path, capsys: pytest.CaptureFixture[str]) -> dict:
    """What `evaluate --json` says of the roll axis."""
    capsys.readouterr()
    assert cli.main(['evaluate', str(model), str(bag), '--json']) == 0
    tree = json.loads(capsys.readouterr().out)
    assert tree['schema'] == 'quad_sysid/evaluation/1'
    return tree['axes']['roll']['error']


def values(parameters: list[dict]) -> dict[str, float]:
    return {p['name']: p['value'] for p in parameters}


# EMPS: a position as the angle, a speed as the rate, volts as the command


@pytest.fixture(scope='module')
def emps(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Both bags, and the folder of the report on the first."""
    files = [measured(f'emps/{name}.csv') for name in ('DATA_EMPS', 'DATA_EMPS_PULSES')]
    folder = tmp_path_factory.mktemp('emps')
    for file in files:
        bag = folder / file.stem
        assert cli.main(['import', str(file), *EMPS_OPTIONS, '--out', str(bag)]) == 0
    out = folder / 'out'
    asked = ['identify', str(folder / 'DATA_EMPS'), '--axis', 'roll', '--out', str(out), '--quiet']
    assert cli.main(asked) == 0
    return folder / 'DATA_EMPS', folder / 'DATA_EMPS_PULSES', out


@pytest.mark.long
def test_emps_mass_and_friction_are_those_of_its_makers(emps):
    """35.15 N/V, 95 kg, 204 N s/m, 20.4 N: within 5 % and 15 %, whatever curves carry it.

    In a quick motion at 0.1 m/s; half the difference between forwards and backwards.
    """
    model = load_models(emps[2] / 'model.json')['roll']
    assert model.value('gain') == pytest.approx(20.0 * 35.150652 / 95.0, rel=0.05)
    rate, zero = np.array([0.1, -0.1]), np.zeros(2)
    signals = Signals(
        rate=rate, angle=zero + 0.12, drive=zero, command=zero, change=zero, lagged=zero,
        throttle=zero, battery_v=None, other_rates=None, other_commands=(zero, zero), time=zero,
        hidden=np.zeros((2, 2)),
    )
    run = stored.completed(model)
    values = run.structure.natural(run.theta)
    torque = model.value('damping') * rate - sum(
        part.effect.torque(signals, values[where], part.settings)
        for part, where in zip(run.structure.parts, run.structure.slices(), strict=True)
    )
    assert 0.5 * (torque[0] - torque[1]) == pytest.approx((204.0 * 0.1 + 20.4) / 95.0, rel=0.15)


@pytest.mark.long
def test_emps_error_falls_on_the_unseen_second_file(emps, capsys):
    """At most 0.0026 m/s; the base within 10 % of the 0.0117 m/s of a plain fit."""
    axis = report_of(emps[2])
    assert axis['verdict'] == 'effects_added'
    assert axis['error']['after'] < 0.40 * axis['error']['before']
    found = evaluated(emps[2] / 'model.json', emps[1], capsys)
    assert found['before'] == pytest.approx(0.0117, rel=0.10)
    assert found['after'] <= 0.0026


# independent: bags of the contract by somebody else, truth known


@pytest.fixture(scope='module')
def independent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the report on the flight."""
    result = quad_sysid.identify(measured('independent/flight'), 'roll')
    out = tmp_path_factory.mktemp('independent') / 'out'
    result.save(out, html=False, pictures=False)
    return out


@pytest.mark.long
def test_independent_parameters_agree_within_5_percent(independent):
    axis = report_of(independent)
    assert axis['verdict'] == 'effects_added'
    assert [e['name'] for e in axis['effects']] == ['coulomb_friction']
    torque = values(axis['effects'][0]['parameters'])['torque']
    assert torque == pytest.approx(0.163, rel=0.05)
    completed = values(axis['completed']['parameters'])
    assert completed['gain'] == pytest.approx(450.1, rel=0.05)
    assert completed['lag'] == pytest.approx(0.0426, rel=0.05)
    assert completed['damping'] == pytest.approx(0.400, rel=0.05)
    assert abs(completed['bias']) < 0.02
    (delay,) = [p for p in axis['completed']['parameters'] if p['name'] == 'delay']
    assert abs(delay['value'] - 0.008) < 1.96 * delay['std']  # its filter answers sooner
    assert delay['std'] < 0.0015


@pytest.mark.long
def test_independent_errors_agree_within_5_percent(independent, capsys):
    """Of the base no more than 5 % above the plain fit's: it knows its disturbance besides."""
    error = report_of(independent)['error']
    assert 0.85 * 0.0210 < error['before'] < 1.05 * 0.0210
    assert error['after'] == pytest.approx(0.0097, rel=0.05)
    assert error['noise_floor'] == pytest.approx(0.0089, rel=0.05)
    second = measured('independent/second_flight')
    unseen = evaluated(independent / 'model.json', second, capsys)
    assert 0.85 * 0.0240 < unseen['before'] < 1.05 * 0.0240
    assert unseen['after'] == pytest.approx(0.0097, rel=0.05)


# nanobench: flights without a test signal


@pytest.fixture(scope='module', params=NANOBENCH)
def nanobench(request, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, Path]:
    """The bag, identify's exit status and the folder of its report."""
    file = measured(f'nanobench/{request.param}.csv.gz')
    folder = tmp_path_factory.mktemp('nanobench')
    motors = [f'motor_motor_m{i}' for i in range(1, 5)]
    units = [word for name in motors for word in ('--unit', f'{name}=pwm16')]
    imported = cli.main([
        'import', str(file), '--axis', 'roll', '--time', 't', '--motors', ','.join(motors),
        '--mixer', str(MIXER), '--rate', 'imu_gyro_x', '--angle', 'roll',
        '--battery', 'pwr_pm_vbat', *units, '--out', str(folder / 'bag'),
    ])  # fmt: skip
    assert imported == 0
    out = folder / 'out'
    status = cli.main(
        ['identify', str(folder / 'bag'), '--axis', 'roll', '--out', str(out), '--quiet']
    )
    return folder / 'bag', status, out


@pytest.mark.long
def test_nanobench_gets_an_honest_verdict(nanobench):
    """No test signal was flown: nothing is claimed, and the one line says what would help."""
    _, status, out = nanobench
    axis = report_of(out)
    assert status == 3
    assert axis['verdict'] == 'cannot_tell'
    assert axis['effects'] == []
    assert axis['gains'] is None
    assert 'PRBS' in axis['reason']
    parameters = {p['name']: p for p in axis['base']['parameters']}
    for name in ('lag', 'delay'):
        low, high = parameters[name]['interval_95']
        assert low <= parameters[name]['value'] <= high
        assert low < high
    low, high = axis['trusted_band_rad_s']
    assert 0.0 < low < high < np.pi * axis['sample_rate_hz']


def test_a_crazyflie_surges_and_sways_by_gravity(tmp_path: Path):
    """The gain over the lean is gravity, to 3 %; the model errs by a sixth of the held speed."""
    file = measured('nanobench/B7_oval_fast_rep1.csv.gz')
    motors = [f'motor_motor_m{i}' for i in range(1, 5)]
    units = [word for name in motors for word in ('--unit', f'{name}=pwm16')]
    assert not cli.main([
        'import', str(file), '--axis', 'all', '--time', 't', '--motors', ','.join(motors),
        '--mixer', MIXER, '--rate', 'imu_gyro_x,imu_gyro_y,imu_gyro_z', *units,
        '--angle', 'roll,pitch,yaw', '--velocity', 'vx,vy,vz', '--position', 'px,py,pz',
        '--out', str(tmp_path / 'bag'),
    ])  # fmt: skip
    found = quad_sysid.identify(tmp_path / 'bag', axes=('surge', 'sway'), effects=())
    for axis in found:
        model, error = found[axis].answer.model, found[axis].errors
        assert model.value('gain') == pytest.approx(9.81, rel=0.03)
        assert 0.2 < model.value('damping') < 0.6
        assert error['before'] < error['hold_last_value'] / 6.0


def crazypad(folder: Path, flight: str) -> Record:
    """One of those flights, imported and split for roll."""
    axes = ('roll', 'pitch', 'yaw')
    units = [word for axis in axes for word in ('--unit', f'cmd_{axis}=pwm16')]
    assert cli.main([
        'import', str(measured(f'flights/crazypad_{flight}.csv')), '--axis', 'all', '--time', 't',
        '--control', ','.join(f'cmd_{axis}' for axis in axes), '--thrust', 'cmd_thrust',
        '--rate', 'p,q,r', *units, '--unit', 'cmd_thrust=pwm16', '--out', str(folder / 'bag'),
    ]) == 0  # fmt: skip
    return split_segments(read_bag(folder / 'bag'), axes=('roll',))


@pytest.mark.long
@pytest.mark.parametrize('flight', ['normal', 'weight_near_m3'])
def test_crazypad_landings_are_no_effects(tmp_path, flight):
    """Their impacts, of 2.7 rad/s in flights of 0.1 rad/s, were once named as three effects."""
    assert answer_of(crazypad(tmp_path, flight)).verdict == 'cannot_tell'


def test_a_delay_of_one_cycle_is_not_taken_for_two(tmp_path):
    """At 100 Hz there is a second maximum, 10 nats lower, to which all starts lead."""
    data = axis_data([crazypad(tmp_path, 'normal')], 'roll')
    base = best_base(Problem(data, data.train))
    assert base.value('delay') == pytest.approx(0.0099, abs=0.001)


# effects added to recordings


def with_torque(
    record: Record, torque: Callable[[float, float], float], damping: float, friction: float,
    gyro_hz: float | None = None,
) -> Record:
    """The record as the same commands would have turned the axis under one more torque.

    torque(rate, angle) in rad/s². What it changes, d, obeys d' = torque - damping d - friction's
    change, along the measured motion plus d; midpoint rule, then the gyro's filter.
    """
    rate, angle, dt = record.rates[:, 0], record.angles[:, 0], record.dt
    d, s = np.zeros(record.n), np.zeros(record.n)

    def slope(k: int, v: float, moved: float) -> float:
        dry = friction * (np.tanh((rate[k] + v) / 0.01) - np.tanh(rate[k] / 0.01))
        return torque(rate[k] + v, angle[k] + moved) - damping * v - dry

    for k in range(record.n - 1):
        half = d[k] + 0.5 * dt * slope(k, d[k], s[k])
        moved = s[k] + 0.5 * dt * d[k]
        d[k + 1] = d[k] + 0.5 * dt * (slope(k, half, moved) + slope(k + 1, half, moved))
        s[k + 1] = s[k] + 0.5 * dt * (d[k] + d[k + 1])
    seen = d if gyro_hz is None else lfilter(*butter(2, gyro_hz, fs=1.0 / dt), d)
    rates, angles = record.rates.copy(), record.angles.copy()
    rates[:, 0] += seen
    angles[:, 0] += s
    return dataclasses.replace(record, rates=rates, angles=angles)


def answer_of(record: Record) -> AxisAnswer:
    return pipeline.identify([record], pipeline.Options(axes=('roll',)))['roll']


@pytest.mark.long
def test_pendulum_added_to_the_independent_flight_is_found():
    """2 rad/s² per rad, well below what a hanging quadrotor shows: within 5 %."""
    bag = read_bag(measured('independent/flight'))
    record = split_segments(bag, (5.0, 30.0), (47.0, 60.0), ('roll',))
    loaded = with_torque(record, lambda _, a: -2.0 * np.sin(a), 0.397, 0.163, gyro_hz=42.0)
    answer = answer_of(loaded)
    assert answer.verdict == 'effects_added'
    assert {e.name for e in answer.model.effects} >= {'pendulum_stiffness'}
    assert any('rate' in e.signals for e in answer.model.effects)  # the rig's own friction
    assert answer.findings.verdict.after < 0.0107  # 0.0097 without the pendulum
    found = answer.model.value('pendulum_stiffness.stiffness')
    assert found == pytest.approx(2.0, rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize(('log', 'yaw_of_the_rear_left'), [
    ('bf_sitl_quad', 1), ('bf_sitl_quad_props_out', -1)])
def test_betaflights_propellers_in_or_out_give_the_same_names(tmp_path, log, yaw_of_the_rear_left):
    """Truth in the README: gain 879, 639; lag 30 ms; damping 2.50, 1.82; yaw leads."""
    bag = tmp_path / 'bag'
    file = measured(f'autopilots/{log}.BFL')
    assert cli.main(['import', str(file), '--grid', '250', '--out', str(bag)]) == 0
    record = split_segments(read_bag(bag))
    assert record.craft.places == ('rear right', 'front right', 'rear left', 'front left')
    assert record.craft.motors[2].spin == yaw_of_the_rear_left
    few = tuple(effect for effect in EFFECTS if effect.label in {
        'thrust_curve', 'inertia_coupling', 'mode:rotor_lead', 'saturation/upper'})
    answers = pipeline.identify([record], pipeline.Options(effects=few))
    assert [sorted(e.name for e in answers[axis].model.effects) for axis in AXES] == [
        ['inertia_coupling', 'thrust_curve'], ['inertia_coupling', 'thrust_curve'],
        ['inertia_coupling', 'mode:rotor_lead']]
    for axis, gain, damping in (('roll', 879.0, 2.5), ('pitch', 639.0, 1.82)):
        model = answers[axis].model
        assert model.value('gain') == pytest.approx(gain, rel=0.02)
        assert model.value('lag') == pytest.approx(0.03, rel=0.05)
        assert model.value('damping') == pytest.approx(damping, rel=0.05)
    assert answers['yaw'].model.value('lag') == pytest.approx(0.03, rel=0.05)
