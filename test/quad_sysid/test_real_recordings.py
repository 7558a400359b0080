"""Recordings that nobody here made: what the commands say of them.

The data lie beside the checkout (shared/data); without them the tests skip. Figures to compare
with are those of its README. Most take minutes and are long.
"""

from pathlib import Path

import numpy as np
import pytest

import quad_sysid as qs
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

DATA = Path(__file__).resolve().parents[2] / '../shared/data'
EMPS = ('--axis roll --time t --control vir --angle qm --reference qg --unit vir=V --unit qm=m '
        '--unit qg=m')
MOTORS = [f'motor_motor_m{i}' for i in range(1, 5)]
NANOBENCH = (f'--time t --motors {",".join(MOTORS)} --mixer crazyflie '
             + ' '.join(f'--unit {name}=pwm16' for name in MOTORS))
CRAZYPAD = ('--axis all --time t --control cmd_roll,cmd_pitch,cmd_yaw --thrust cmd_thrust '
            '--rate p,q,r --unit cmd_roll=pwm16 --unit cmd_pitch=pwm16 --unit cmd_yaw=pwm16 '
            '--unit cmd_thrust=pwm16')


def measured(path: str) -> Path:
    """The file or folder of that name in the shared data, or a skip with the reason."""
    found = DATA / path
    if not found.exists():
        pytest.skip(f'shared/data/{path} is not beside this checkout')
    return found


@pytest.fixture
def imported(tmp_path):
    def bag_of(path: str, options: str) -> Path:
        bag = tmp_path / Path(path).stem
        words = ['import', str(measured(path)), *options.split(), '--out', str(bag)]
        assert cli.main(words) == 0
        return bag

    return bag_of


@pytest.mark.long
def test_emps_has_the_friction_of_its_makers_and_foresees_the_second_file(imported):
    """35.15 N/V, 95 kg, 204 N s/m, 20.4 N: within 5 % and 15 %, whatever curves carry it.

    In a quick motion at 0.1 m/s; half the difference between forwards and backwards. The unseen
    file, by the first rung: at most 0.0040 m/s; the base at most the 0.0117 m/s of a plain fit,
    which flatters no effect. Each file is answered by dry friction, 0.215 m/s² by its makers; the
    second one's derived speed has next to no white noise.
    """
    first, second = (imported(f'emps/{name}.csv', EMPS)
                     for name in ('DATA_EMPS', 'DATA_EMPS_PULSES'))
    results = [qs.identify(file, 'roll') for file in (first, second)]
    for result in results:
        (claimed,) = result.effects
        assert claimed.name == 'coulomb_friction'
        assert claimed.parameters[0].value == pytest.approx(0.215, abs=0.03)
        assert result.errors['after'] < 0.4 * result.errors['before']
    model = results[0].model
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
        for part, where in zip(run.structure.parts, run.structure.slices, strict=True)
    )
    assert 0.5 * (torque[0] - torque[1]) == pytest.approx((204.0 * 0.1 + 20.4) / 95.0, rel=0.15)
    found = qs.evaluate(model, second)
    assert found.before <= 0.0117
    assert found.after <= 0.0040


@pytest.mark.long
def test_a_contracts_bag_by_somebody_else_has_its_truth_within_5_percent():
    """Of the base's error no more than 5 % above the plain fit's: it knows its disturbance."""
    result = qs.identify(measured('independent/flight'), 'roll')
    (friction,) = result.effects
    assert friction.name == 'coulomb_friction'
    for name, truth in (('gain', 450.1), ('lag', 0.0426), ('damping', 0.400),
                        ('coulomb_friction.torque', 0.163)):
        assert result.model.value(name) == pytest.approx(truth, rel=0.05), name
    assert abs(result.model.value('bias')) < 0.02
    delay = result.model.parameters['delay']
    assert abs(delay.value - 0.008) < 1.96 * delay.std  # its filter answers sooner
    assert delay.std < 0.0015
    assert 0.85 * 0.0210 < result.errors['before'] < 1.05 * 0.0210
    assert result.errors['after'] == pytest.approx(0.0097, rel=0.05)
    assert result.errors['noise_floor'] == pytest.approx(0.0089, rel=0.05)
    unseen = qs.evaluate(result.model, measured('independent/second_flight'))
    assert 0.85 * 0.0240 < unseen.before < 1.05 * 0.0240
    assert unseen.after == pytest.approx(0.0097, rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize(('path', 'options'), [
    *((f'nanobench/{name}_fast_rep1.csv.gz',
       f'--axis roll --rate imu_gyro_x --angle roll --battery pwr_pm_vbat {NANOBENCH}')
      for name in ('B2_circle', 'B3_figure8', 'B7_oval', 'B10_lissajous')),
    # with landings, whose impacts of 2.7 rad/s in flights of 0.1 rad/s are no effects
    *((f'flights/crazypad_{name}.csv', CRAZYPAD) for name in ('normal', 'weight_near_m3')),
])
def test_a_flight_without_a_test_signal_gets_an_honest_verdict(imported, path, options):
    result = qs.identify(imported(path, options), 'roll')
    assert (result.verdict, result.effects, result.gains) == ('cannot_tell', (), None)
    assert 'PRBS' in result.reason
    assert all(result.model.parameters[name].std > 0.0 for name in ('lag', 'delay'))


@pytest.mark.usefixtures('quick')
def test_a_crazyflie_surges_and_sways_by_gravity(imported):
    found = qs.identify(imported(
        'nanobench/B7_oval_fast_rep1.csv.gz',
        '--axis all --rate imu_gyro_x,imu_gyro_y,imu_gyro_z --angle roll,pitch,yaw '
        f'--velocity vx,vy,vz --position px,py,pz {NANOBENCH}'), ('surge', 'sway'), effects=())
    for axis in found:
        model, error = found[axis].answer.model, found[axis].errors
        assert model.value('gain') == pytest.approx(9.81, rel=0.03)
        assert 0.2 < model.value('damping') < 0.6
        assert error['before'] < error['hold_last_value'] / 6.0


def test_a_delay_of_one_cycle_is_not_taken_for_two(imported):
    """At 100 Hz there is a second maximum, 10 nats lower, to which all starts lead."""
    bag = imported('flights/crazypad_normal.csv', CRAZYPAD)
    data = axis_data([split_segments(read_bag(bag), axes=('roll',))], 'roll')
    base = best_base(Problem(data, data.train))
    assert base.value('delay') == pytest.approx(0.0099, abs=0.001)


@pytest.mark.long
@pytest.mark.parametrize(('log', 'yaw_of_the_rear_left'), [
    ('bf_sitl_quad', 1), ('bf_sitl_quad_props_out', -1)])
def test_betaflights_propellers_in_or_out_give_the_same_names(imported, log, yaw_of_the_rear_left):
    """Truth in the README: gain 879, 639; lag 30 ms; damping 2.50, 1.82; yaw leads.

    Yaw's small coupling is in the reference, behind a lead that explains more than 99 %.
    """
    record = split_segments(read_bag(imported(f'autopilots/{log}.BFL', '--grid 250')))
    assert record.craft.places == ('rear right', 'front right', 'rear left', 'front left')
    assert record.craft.motors[2].spin == yaw_of_the_rear_left
    few = tuple(effect for effect in EFFECTS if effect.label in {
        'thrust_curve', 'inertia_coupling', 'mode:rotor_lead', 'saturation/upper'})
    answers = pipeline.identify([record], pipeline.Options(effects=few))
    assert [sorted(e.name for e in answers[axis].model.effects) for axis in AXES] == [
        ['inertia_coupling', 'thrust_curve'], ['inertia_coupling', 'thrust_curve'],
        ['mode:rotor_lead']]
    found = answers['yaw'].findings
    assert found.ladder.rungs[found.ladder.answer].explains_pct > 99.0
    assert {*found.search.best.structure.labels} == {'inertia_coupling', 'mode:rotor_lead'}
    for axis, gain, damping in (('roll', 879.0, 2.5), ('pitch', 639.0, 1.82)):
        model = answers[axis].model
        assert model.value('gain') == pytest.approx(gain, rel=0.02)
        assert model.value('lag') == pytest.approx(0.03, rel=0.05)
        assert model.value('damping') == pytest.approx(damping, rel=0.05)
    assert answers['yaw'].model.value('lag') == pytest.approx(0.03, rel=0.05)
