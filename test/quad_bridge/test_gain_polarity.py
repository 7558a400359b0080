"""Pulses find the right sign, a wrong one, a fixed axis, and which motor is which."""

import json
from dataclasses import replace

import numpy as np
import pytest
from flight_controller import STILL

from quad_bridge.craft import LAYOUTS, X
from quad_bridge.errors import RefusedError
from quad_bridge.gains.history import History
from quad_bridge.gains.polarity import PolarityCheck, PulseRun, judge_axes, merge_motors, pulses_of
from quad_bridge.wire import frames as f

ROLL = {'roll_rate_kp': 0.1}


def checked(made, *, motors=False):
    words = []
    made.updates.check(made.now_s, words.append, motors=motors)
    for _ in range(200):
        made.fly(0.1)
        if words:
            return words[0]
    raise AssertionError('no answer')


def test_the_first_update_of_an_axis_waits_for_its_pulses_the_next_bridge_knows_them(bench):
    made = bench(polarity='auto')
    assert 'checking the polarity of roll' in made.ask(**ROLL)
    made.fly_until('in force')
    assert 'polarity: roll correct' in made.notes
    assert np.degrees(made.peak_rad) < 3.0
    again = bench(polarity='manual')
    assert 'writing' in again.ask(**ROLL)


def test_a_wrong_sign_refuses_every_update_until_it_is_mended(bench):
    made = bench(polarity='auto')
    made.down.fault = lambda x: [
        replace(x, gyro=(-x.gyro[0], *x.gyro[1:])) if isinstance(x, f.Cycle) else x]
    made.ask(**ROLL)
    assert 'roll responds with the wrong sign: correct' in made.fly_until('refused')
    for wanted in (ROLL, {'yaw_rate_kp': 0.2}):
        with pytest.raises(RefusedError, match='wrong sign'):
            made.ask(**wanted)
    made.down.fault = None
    assert 'roll correct' in checked(made)
    made.ask(**ROLL)
    made.fly_until('in force')


def test_a_fixed_axis_is_silent_and_its_gains_are_refused(bench):
    made = bench(polarity='auto')
    made.ask(pitch_rate_kp=0.1)
    assert 'pitch did not respond to the pulses' in made.fly_until('refused')
    assert made.gain('pitch.rate.kp') == pytest.approx(0.0744845, rel=1e-5)


def test_pulses_stop_when_an_excitation_starts_and_an_unarmed_aircraft_gets_none(bench):
    made = bench(polarity='auto')
    made.ask(**ROLL)
    made.fly(0.3)
    made.updates.disturb()
    assert 'stopped: the excitation has started' in made.fly_until('refused')
    made.fly(1.0)
    made.ask(**ROLL)
    made.fly(0.3)
    made.updates.know({})
    assert 'stopped: the record of this aircraft' in made.fly_until('refused')
    made.fly(1.0)
    assert made.updates.commits == 0
    made.endpoint.firmware.arm(False)
    made.fly(1.0)
    with pytest.raises(RefusedError, match='not armed'):
        made.ask(**ROLL)


def test_a_check_whose_link_is_cut_ends_and_is_not_gone_on_with_later(bench):
    made = bench(polarity='auto')
    before = made.gain('roll.rate.kp')
    made.ask(**ROLL)
    made.fly(0.6)
    made.cut = True
    assert 'no control cycle for 0.5 s' in made.fly_until('refused', seconds=1.0)
    made.fly(10.0)
    made.cut = False
    excited = []
    for _ in range(60):
        made.fly(0.05)
        excited.append(made.cycle.flags & f.Flag.EXCITATION)
    assert not any(excited)
    assert made.gain('roll.rate.kp') == before
    assert 'roll correct' in checked(made)


@pytest.mark.parametrize('rate_hz', [50.0, 250.0, 1000.0])
@pytest.mark.parametrize(('sign', 'verdict'), [(1.0, 'right'), (-1.0, 'wrong')])
def test_pulses_last_as_long_at_every_rate_of_the_loop(rate_hz, sign, verdict):
    run, rate, added, cycles, rates = PulseRun(['roll'], rate_hz), 0.0, (0.0, 0.0, 0.0), 0, []
    while not run.finished:
        rate += sign * 40.0 * added[0] / rate_hz
        added, cycles = run.step((rate, 0.0, 0.0)), cycles + 1
        rates.append(rate)
    # each of the two pulses takes back what it gave: half-way, and in the end, it turns no more
    assert max(abs(rates[cycles // 2]), abs(rates[-1])) < 0.1 * max(map(abs, rates))
    assert judge_axes(run.answers) == {'roll': verdict}
    assert judge_axes({'roll': np.array([0.1 * sign, 0.2, 0.0])}) == {'roll': 'crossed'}
    assert cycles / rate_hz == pytest.approx(1.52, abs=0.05)


def test_all_axes_answer_in_hover_and_the_motors_are_found_mount_by_mount(bench):
    made = bench(polarity='manual')
    words = checked(made, motors=True)
    assert 'motor_1 rear left or front left; motor_2 rear right or front right' in words
    flying = bench(polarity='manual', mount='hover', profile='paper_hover')
    three = 'roll correct; pitch correct; yaw correct;'
    assert checked(flying).startswith(f'{three} motor_1 rear left or')
    assert np.degrees(flying.peak_rad) < 6.0
    words = checked(flying, motors=True)
    names = ('rear left', 'rear right', 'front right', 'front left')
    motors = '; '.join(f'motor_{k + 1} {name}' for k, name in enumerate(names))
    assert words == f'{three} {motors}'


def answers(order, spins=(1, 1, 1, 1)):
    """What pulses show where channel k drives the motor `order[k]`."""
    rows = {}
    for k, motor in enumerate(order):
        roll, pitch, yaw = X.signs[motor]
        rows[f'motor_{k + 1}'] = np.array([0.2 * roll, 0.2 * pitch, 0.03 * yaw * spins[k]])
    return rows


def test_noise_is_no_answer_and_a_lost_receiver_ends_the_pulses():
    rng, run = np.random.default_rng(1), PulseRun(['roll', 'pitch', 'yaw'], 50.0)
    while not run.finished:
        run.step(tuple(0.1 * rng.standard_normal(3)))
    assert judge_axes(run.answers) == dict.fromkeys(('roll', 'pitch', 'yaw'), 'silent')
    check = PolarityCheck('auto', 50.0)
    for flags, runs in ((f.Flag.ARMED, True), (f.Flag.ARMED | f.Flag.RC_FAILSAFE, False)):
        check.start(('roll',))
        check.step(replace(STILL, flags=int(flags)))
        assert check.running is runs
    check.start(())
    check.craft = LAYOUTS['plus']  # described late, and these pulses push motors of an X
    check.step(replace(STILL, flags=int(f.Flag.ARMED)))
    assert check.trouble == 'stopped: another craft has been described'


def test_an_axis_counts_where_three_of_the_motors_moved_it():
    three = {**answers(range(4)), 'motor_2': np.zeros(3)}
    assert [*merge_motors({}, three)] == ['motor_1', 'motor_3', 'motor_4']
    assert merge_motors({}, {**three, 'motor_4': np.zeros(3)}) == {}


def test_the_craft_that_describes_itself_says_where_its_motors_have_to_be():
    check, turned = PolarityCheck('auto', 250.0), answers(range(4), (-1,) * 4)
    check.load({'motors': merge_motors({}, turned)})
    assert check.faults() == [f'motor_{k} turns the wrong way' for k in range(1, 5)]
    check.craft = replace(X, motors=tuple(replace(m, spin=-m.spin) for m in X.motors))
    assert check.faults() == []
    check.craft = LAYOUTS['plus']
    check.load({'motors': {'motor_1': {'pitch': 1}, 'motor_2': {'roll': -1, 'yaw': -1}}})
    assert check.faults() == ['motor_1 drives the rear, must be the front']
    pushes = pulses_of(check.craft)
    for k, row in enumerate(check.craft.mixer):
        motors = check.craft.mixer @ (0.0, *pushes[f'motor_{k + 1}'].direction)
        assert np.argmax(motors) == k
        assert row @ (1.0, 0.0, 0.0, 0.0) == 1.0


def test_a_motor_fault_refuses_updates_and_survives_the_disk():
    check = PolarityCheck('auto', 250.0)
    motors = merge_motors({}, answers((1, 0, 2, 3)))
    check.load({'axes': {'roll': 'right'}, 'motors': motors})
    with pytest.raises(RefusedError, match=r'motor_1 drives the rear right.* call ~/find_motors$'):
        check.refuse_faults()
    check.load({'axes': {'roll': 'wrong'}, 'motors': motors})
    with pytest.raises(RefusedError, match=r'call ~/check_polarity and ~/find_motors$'):
        check.refuse_faults()
    check.load({'axes': {'roll': 'crossed'}, 'motors': {}})
    with pytest.raises(RefusedError, match=r'call ~/check_polarity$'):
        check.refuse_faults()


@pytest.mark.parametrize(
    'record',
    [
        {}, {'axes': 3}, {'axes': {'roll': 1}, 'motors': {'a': 'b'}},
        {'motors': {'1': {'roll': [1]}}}, '[' * 100_000, '[1]', '{', '\xff',
    ],
)
def test_a_damaged_record_counts_as_no_check(tmp_path, record):
    check = PolarityCheck('auto', 250.0)
    text = record if isinstance(record, str) else json.dumps(record)
    (tmp_path / 'one').mkdir()
    (tmp_path / 'one' / 'polarity.json').write_text(text, encoding='latin-1')
    check.load(History(tmp_path, lambda job: job()).open('one'))
    assert check.unchecked(['roll.rate.kp', 'sensor.gyro_filter_hz']) == ['roll']
