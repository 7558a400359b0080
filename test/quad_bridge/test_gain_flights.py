"""Updates flown by the virtual STM32, and how they are taken back.

What else can happen is walked through in test_gain_protocol.py and test_gain_update.py.
"""

import json
import math
import shutil

import pytest

from quad_bridge.errors import RefusedError
from quad_bridge.gains.table import Bound
from quad_bridge.virtual.receiver import Event
from quad_bridge.wire import frames as f

KP, ANGLE = 'roll.rate.kp', 'roll.angle.kp'
OLD_KP = 0.07448451


def assert_old(made):
    """The STM32 flies the old gains, and the bridge knows."""
    assert made.told[KP] == pytest.approx(OLD_KP)
    assert made.gain(KP) == pytest.approx(OLD_KP)
    assert made.told[ANGLE] == made.gain(ANGLE) == 3.0


def test_a_link_that_dies_in_the_watch_brings_the_old_gains_back(bench):
    """One way only: the STM32 hears the bridge all the time."""
    made = bench()
    made.ask(roll_rate_kp=0.1)
    made.fly_until('in force')
    made.down.cut = True
    made.fly(1.5)
    assert made.gain(KP) == pytest.approx(OLD_KP)
    made.cut = False
    made.fly(3.0)
    assert_old(made)
    assert 'rolled back, old gains: no control cycle' in made.updates.refused


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


EARLIER = [Event(3.0, 'yaw', 0.9), Event(3.2, 'yaw', 0.0)]  # at an end before is no delay
GESTURE = [Event(6.0 + 0.3 * k, 'yaw', v) for k, v in enumerate([0.9, -0.9, 0.9, 0.0])]


@pytest.mark.parametrize(
    ('events', 'words'),
    [([Event(6.0, 'aux1', 1.0)], 'kill switch'), (EARLIER + GESTURE, 'stick gesture')],
)
def test_the_pilot_takes_the_gains_back_by_switch_and_by_gesture(bench, tmp_path, events, words):
    made = bench(events=events)
    # without a clock nothing is stamped
    made.up.fault = lambda frame: [] if isinstance(frame, f.TimeSync) else [frame]
    made.opened()
    made.fly(1.0)
    made.ask(roll_rate_kp=0.1)
    assert words in made.fly_until('rolled back')
    assert made.gain(KP) == pytest.approx(OLD_KP)
    made.fly(1.0)
    (path,) = tmp_path.rglob('gains.jsonl')
    outcome, active = map(json.loads, path.read_text().splitlines()[-2:])
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
