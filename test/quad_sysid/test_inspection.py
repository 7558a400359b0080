"""What `inspect` says of a bag is what was put into it, and costs no fit."""

import json
from dataclasses import replace

import numpy as np
import pytest
from flown_axis import Axis, Plan, fly
from flown_craft import DT as STEP_S
from flown_craft import Airframe, X
from flown_craft import fly as flown

import quad_sysid as qs
from quad_sysid.bags import write_bag
from quad_sysid.cli import main
from quad_sysid.contract import MIXER
from quad_sysid.inspection.content import content
from quad_sysid.inspection.page import lines


@pytest.fixture(scope='module')
def record():
    return fly(Axis(volts=(12.4, 12.3)), 3, Plan(
        30.0, (('idle', 'none', 0.0, 1.0), ('train', 'prbs', 1.0, 18.0),
               ('validation', 'square', 19.0, 30.0)),
    ))


@pytest.fixture(scope='module')
def bag(record, tmp_path_factory):
    rates = record.rates.copy()
    rates[2000:2051] = np.nan
    motors = np.clip(record.control @ np.ones((4, 4)), 0.0, 0.9)
    motors[:250] = 0.0  # on the ground
    motors[250:950, 0] = 1.0
    lossy = replace(record, rates=rates, motors=motors, control=motors)
    return write_bag(lossy, tmp_path_factory.mktemp('inspect') / 'bag')


def test_topics_gaps_limits_and_battery(bag, record):
    held = content(bag)
    topics = {topic.name: topic for topic in held.topics.present}
    imu = topics['/imu/data']
    assert (imu.messages, imu.gaps) == (record.n - 51, 1)
    assert (imu.rate_hz, topics['/battery'].rate_hz) == pytest.approx((250.0, 10.0))
    assert imu.longest_gap_s == pytest.approx(52 * record.dt)
    assert topics['/excitation/segment'].rate_hz is None
    assert '/control/wrench' in held.topics.absent
    assert held.lost_pct == pytest.approx(100.0 * 51 / record.n, abs=0.001)
    assert held.longest_gap_s == pytest.approx(51 * record.dt)
    assert held.motors_at_limit_pct == pytest.approx((10.0, 0.0, 0.0, 0.0), abs=0.02)
    assert (held.battery.first, held.battery.last) == pytest.approx((12.4, 12.3), abs=0.01)
    assert not held.split


def test_an_axis_and_its_uses(record, tmp_path):
    held = content(write_bag(record, tmp_path / 'bag'))
    (roll,) = held.axes
    assert roll.axis == 'roll'
    assert (roll.train_s, roll.validation_s) == pytest.approx((17.0, 11.0))
    assert roll.windows == 20
    train = record.rates[250:4500, 0]
    assert roll.rate_rms == pytest.approx(float(np.std(train)), rel=1e-3)
    low, high = roll.coherent_band_rad_s
    # levels of up to 0.7 s through a loop of some 3 rad/s: coherent around there, not at 300 rad/s
    assert low < 3.0
    assert 8.0 < high < 300.0
    uses = {use.name: use for use in roll.uses}
    assert uses['identify roll'].possible
    assert uses['closed-loop check'].possible
    assert uses['gain design'].possible
    assert 'throttle stays' in uses['find thrust curve'].because
    assert 'only: the voltage moves by' in uses['find battery sag'].because
    of_angle = 'find effects of the measured angle'
    (blind,) = qs.inspect(replace(record, angles=None)).axes
    allowed = {use.name: use.possible for use in blind.uses}
    assert (uses[of_angle].possible, allowed['identify roll'], allowed[of_angle]) == (
        True, True, False)
    (unasked,) = qs.inspect(replace(record, attitude_setpoint=None)).axes
    allowed = {use.name: use.possible for use in unasked.uses}
    assert (allowed['closed-loop check'], allowed['gain design']) == (False, True)


@pytest.mark.usefixtures('quick')
def test_an_axis_that_is_held_is_refused_as_by_identify(record, tmp_path):
    """Its feedback makes noise coherent with itself, and the motors explain its change."""
    rates, control = record.rates.copy(), record.control.copy()
    rates[:, 1:] = 0.005 * np.random.default_rng(7).standard_normal((record.n, 2))
    control[:, 2:] = -0.07 * rates[:, 1:]
    held = replace(record, rates=rates, control=control, motors=control @ MIXER.T, segments=())
    path = write_bag(held, tmp_path / 'bag')
    seen = content(path)
    uses = {use.name: use for one in seen.axes for use in one.uses}
    assert uses['identify roll'].possible
    assert [p.certain for p in seen.layout] == [True, False, False]
    assert seen.axes[0].coherent_band_rad_s is not None
    for axis, one in zip(('pitch', 'yaw'), seen.axes[1:], strict=True):
        assert not uses[f'identify {axis}'].possible
        assert 'do not predict the rate better than past rates do' in uses[
            f'identify {axis}'].because
        assert one.coherent_band_rad_s is None
    assert not [line for line in seen.warnings if 'motor_' in line or '--mixer' in line]
    said = ' '.join(str(qs.identify(path, 'pitch', effects=())).split())
    assert 'the commands do not predict the held-out rates better' in said


def test_a_bag_without_commands_tells_its_topics(record, tmp_path, capsys):
    path = write_bag(
        replace(record, wrench=np.full((record.n, 4), np.nan)), tmp_path / 'uncommanded'
    )
    assert main(['inspect', str(path)]) == 2
    out, err = capsys.readouterr()
    assert (out.startswith('not usable'), '/imu/data' in out) == (True, True)
    assert err.count(str(path)) == 1
    assert '/control/wrench are both missing' in err


def test_the_page_fits_a_terminal_and_json_is_whole(bag, printed):
    held = content(bag)
    page = lines(held)
    assert 'roll can be identified' in ' '.join(' '.join(page[:2]).split())
    assert max(map(len, page)) <= 80
    (imu,) = [line for line in page if line.lstrip().startswith('/imu/data ')]
    assert imu.split()[-1] == '0.204'
    assert sum('0.204' in line for line in page) == 3  # with the line on the flight, and a warning
    assert [(use.possible, use.because) for use in held.uses] == [
        (True, "one of this bag's rate, 250 Hz")]  # a stored model must have it
    tree = json.loads(printed(main, 'inspect', bag, '--json'))
    assert tree['schema'] == 'quad_sysid/inspection/1'
    assert tree['axes'][0]['axis'] == 'roll'
    assert printed(main, 'inspect', bag, '--quiet') == ''


def test_an_excitation_that_was_aborted_says_why_and_that_too_little_is_held_out(record, tmp_path):
    idle, train, validation = (next(s for s in record.segments if s.role == role)
                               for role in ('idle', 'train', 'validation'))
    reason = "the pilot's abort switch is thrown"
    held = content(write_bag(replace(record, segments=(
        idle, train, replace(validation, end_s=21.5),
        replace(idle, start_s=21.5, end_s=30.0, parameters={'reason': reason}),
    )), tmp_path / 'bag'))
    assert f'the excitation ended: {reason}' in '\n'.join(lines(held))
    (identify,) = held.axes[0].uses
    assert (identify.possible, identify.because[:22]) == (False, 'only 3 windows of 0.5 ')


def test_a_log_is_drawn_with_the_motor_that_the_motion_contradicts(tmp_path, refused):
    """In a table: motors 1 and 2 of the X frame exchanged, which roll and pitch tell apart."""
    flight = flown(Airframe(X), 1, 16.0)
    rates, motors = flight['rates'], flight['motors'][:, [1, 0, 2, 3]]
    table = np.column_stack([STEP_S * np.arange(len(rates)), rates, motors])
    log, out = tmp_path / 'flight.csv', tmp_path / 'flight.html'
    np.savetxt(log, table, '%.6g', ',', header='t,gyro_x,gyro_y,gyro_z,m1,m2,m3,m4', comments='')
    assert main(['import', str(log), '--axis', 'roll,pitch,yaw', '--time', 't', '--rate',
                 'gyro_x,gyro_y,gyro_z', '--motors', 'm1,m2,m3,m4', '--mixer', 'X', '--out',
                 str(tmp_path / 'bag')]) == 0
    assert main(['inspect', str(tmp_path / 'bag'), '--out', str(out), '--quiet']) == 0
    wrong = {one.name for one in content(tmp_path / 'bag').motors if one.shown != one.expected}
    assert wrong == {'motor_1', 'motor_2'}
    text = out.read_text()
    assert text.count('stroke="var(--orange)"') == 4  # a disc and an arrow each
    assert 'should be' in text
    assert content(log).axes  # what its columns are is guessed, and no bag is needed
    out.write_text('mine')
    assert 'no page of quad-sysid inspect' in refused(main, 'inspect', log, '--out', out)
    assert out.read_text() == 'mine'
