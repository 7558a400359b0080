"""Updates flown by the virtual STM32: good ones, bad ones, abuse.

What a line can do to frames is walked through in test_gain_protocol.py and test_gain_update.py.
"""

import json
import math
import re
import shutil

import pytest
from flight_controller import DROPPED, Fault

from quad_bridge.errors import RefusedError
from quad_bridge.gains.protocol import float32
from quad_bridge.gains.table import WIRE_NAMES, Bound
from quad_bridge.gains.update import State
from quad_bridge.virtual.receiver import Event
from quad_bridge.wire import frames as f

KP, ANGLE = 'roll.rate.kp', 'roll.angle.kp'
OLD_KP = 0.07448451


def history(folder):
    (path,) = folder.rglob('gains.jsonl')
    return [json.loads(line) for line in path.read_text().splitlines()]


def flown(bench):
    return {n: None if (v := bench.gain(n)) is None else float32(v) for n in WIRE_NAMES}


def test_a_good_update_is_written_whole_watched_and_confirmed(bench, tmp_path):
    made = bench(sources=('test', 'design*'))
    made.ask(roll_rate_kp=0.1, roll_angle_kp=5.0, source='designer', model='model.json',
             aircraft=made.updates.aircraft)
    assert made.updates.state is State.WRITING
    made.fly_until('step 1 of 1 of designer is in force')
    assert made.gain(KP) == pytest.approx(0.1)
    assert made.told[ANGLE] == made.gain(ANGLE) == 5.0
    begin = made.now_s
    made.fly_until('confirmed')
    assert made.now_s - begin == pytest.approx(10.0, abs=0.3)
    found, active, confirmed = history(tmp_path)
    assert (found['reason'], found['gains'][ANGLE]) == ('read from the aircraft', 3.0)
    assert (active['source'], active['model'], active['gains'][ANGLE]) == (
        'designer', 'model.json', 5.0,
    )  # fmt: skip
    assert (confirmed['state'], confirmed['update']) == ('confirmed', active['update'])
    assert confirmed['flown'] is True
    made.cut = True
    made.fly(20.0)
    assert made.gain(ANGLE) == 5.0


def assert_old(made):
    """The STM32 flies the old gains, and the bridge knows."""
    assert made.told[KP] == pytest.approx(OLD_KP)
    assert made.gain(KP) == pytest.approx(OLD_KP)
    assert made.told[ANGLE] == made.gain(ANGLE) == 3.0


BAD_UPDATES = [
    ({'roll_rate_kp': math.nan}, 'must be finite'),
    ({'roll_rate_kp': 1e6}, 'must lie in'),
    ({'roll_rate_kp': 'fast'}, r'roll\.rate\.kp: must be a number'),
    ({'source': 'a stranger'}, 'source is not allowed'),
    ({'aircraft': 'A'}, 'aircraft A: connected is'),
    ({'predicted': '{"roll.peak": NaN}'}, 'roll.peak must be finite'),
    ({'predicted': '{"roll.colour": 1}'}, 'roll.colour is not known'),
    ({'flown': '{"roll.rate.kp": 0.2}'}, 'the design began from 0.2, and the aircraft has 0.07'),
    ({'rollback': 'false'}, "rollback: must be true or false: found 'false'"),
    ({'model': 3.0}, r'model: must be a text: found 3\.0'),
    ({'roll_angle_kp': None}, 'must be a number'),
    ({'predicted': 'good'}, 'predicted: must be a JSON object'),
    ({'predicted': '{"roll.peak": "high"}'}, 'must be a JSON object of numbers: roll.peak'),
    ({'predicted': '[' * 200_000}, 'at most: found 200000'),
    ({'predicted': f'{{"roll.peak": {10**400}}}'}, 'too large a number'),
    ({'model': '\x1b[2J\nevil'}, 'model: must be printable'),
]


def test_bad_updates_are_refused_and_change_nothing(bench):
    made = bench(sources=('test', 'designer*'))
    before = flown(made)
    for asked, words in BAD_UPDATES:
        with pytest.raises(RefusedError, match=words):
            made.ask(**{'roll_rate_kp': 0.1, **asked})
        made.fly(0.2)
        assert re.search(words, made.updates.refused)
        assert len(made.updates.refused) < 300
    made.fly(1.0)
    assert flown(made) == before


@pytest.mark.parametrize(
    ('ways', 'seconds', 'words'),
    [
        (('up',), 3.0, 'link lost'),
        (('down',), 1.5, 'no control cycle'),  # the STM32 hears the bridge all the time
    ],
)
def test_a_link_that_dies_in_the_watch_brings_the_old_gains_back(bench, ways, seconds, words):
    made = bench()
    made.ask(roll_rate_kp=0.1)
    made.fly_until('in force')
    for way in ways:
        getattr(made, way).cut = True
    made.fly(seconds)
    assert made.gain(KP) == pytest.approx(OLD_KP)
    made.cut = False
    made.fly(3.0)
    assert_old(made)
    assert 'rolled back' in made.updates.refused
    assert words in made.updates.refused


# The watch.


@pytest.mark.parametrize(
    ('mount', 'bound', 'kp', 'axes', 'words'),
    [
        ('hover', Bound(0.0, 1.0), 0.6, ('roll', 'pitch'), 'oscillation'),  # destabilising
        ('rig', Bound(0.0, 1.0, small_step=1.0), 0.9, ('roll',), ''),
    ],
)
def test_a_bad_set_is_taken_back_before_twenty_degrees(bench, mount, bound, kp, axes, words):
    names = [f'{axis}.rate.kp' for axis in axes]
    profile = 'hover' if mount == 'hover' else 'plain'
    made = bench(profile=profile, mount=mount, bounds=dict.fromkeys(names, bound))
    made.ask(**dict.fromkeys(names, kp))
    assert words in made.fly_until('rolled back')
    made.fly(2.0)
    assert_old(made)
    assert math.degrees(made.peak_rad) < 20.0


KILL = [Event(6.0, 'aux1', 1.0)]
FAILSAFE = [Event(6.0, 'failsafe', 1.0)]
EARLIER = [Event(3.0, 'yaw', 0.9), Event(3.2, 'yaw', 0.0)]  # at an end before is no delay
GESTURE = [Event(6.0 + 0.3 * k, 'yaw', v) for k, v in enumerate([0.9, -0.9, 0.9, 0.0])]


@pytest.mark.parametrize(
    ('events', 'words'),
    [
        (KILL, 'kill switch'),
        (FAILSAFE, "receiver's failsafe"),
        (EARLIER + GESTURE, 'stick gesture'),
    ],
)
def test_the_kill_switch_a_failsafe_and_the_stick_gesture_take_the_gains_back(
    bench, tmp_path, events, words
):
    made = bench(events=events)
    made.up.fault = Fault(f.TimeSync, DROPPED)  # without a clock nothing is stamped
    made.opened()
    made.fly(1.0)
    made.ask(roll_rate_kp=0.1)
    assert words in made.fly_until('rolled back')
    assert made.gain(KP) == pytest.approx(OLD_KP)
    made.fly(1.0)
    *_, outcome, active = history(tmp_path)
    assert (outcome['state'], words in outcome['reason']) == ('rolled back', True)
    assert active['gains'][KP] == pytest.approx(OLD_KP)


def test_without_a_history_no_gains_come_in_and_those_on_trial_can_go_back(bench, tmp_path):
    (tmp_path / 'state').write_text('no folder can be made here')
    made = bench()
    with pytest.raises(RefusedError, match='cannot be written'):
        made.ask(roll_rate_kp=0.1)
    (tmp_path / 'state').unlink()
    made.ask(roll_rate_kp=0.1)
    made.fly_until('in force')
    shutil.rmtree(tmp_path / 'state')
    (tmp_path / 'state').write_text('nor here')
    made.ask(rollback=True)
    made.fly_until('rolled back')
    assert made.gain(KP) == pytest.approx(OLD_KP)


def test_climb_gains_are_tried_in_the_height_mode_and_go_back_where_it_swings(bench):
    """By the accelerometer alone: the vertical speed of the swing is more than it was before."""
    names = ('climb.rate.kp', 'climb.rate.ki', 'climb.height.kp')
    made = bench(mount='hover', profile='hover', events=[Event(6.0, 'aux4', 1.0)],
                 bounds={name: Bound(0.005, 5.0, 20.0) for name in names})  # fmt: skip
    with pytest.raises(RefusedError, match='tried in the height mode'):
        made.ask(climb_rate_kp=0.12)
    made.fly(8.0)
    made.ask(climb_rate_kp=0.12)
    made.fly_until('confirmed')
    made.ask(climb_rate_kp=0.02, climb_rate_ki=0.2, climb_height_kp=3.0)
    made.fly_until('climb: vertical speed')
    made.fly(1.0)
    assert made.gain('climb.rate.kp') == made.told['climb.rate.kp'] == pytest.approx(0.12)
