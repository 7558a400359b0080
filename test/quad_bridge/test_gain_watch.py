"""The watch stays silent over good gains in gusts, and speaks in time over bad ones.

bench/watch.py has the study on 100 airframes; here a few flights through the whole machine.
"""

import numpy as np
import pytest

from quad_bridge.gains.watch import ClimbWatch, GainWatch, Predicted
from quad_bridge.virtual.receiver import Event

DT = 0.004
STILL = np.zeros(3)
INERTIA = np.array([0.0135, 0.0140, 0.008])


class Gusts:
    """Coloured torque of 1.5 rad/s^2 and pushes of twice that."""

    def __init__(self):
        self.rng, self.state = np.random.default_rng(1), np.zeros(3)

    def __call__(self, t_s, *_):
        self.state += -0.002 * self.state + 0.063 * self.rng.normal(size=3)
        push = 2.0 * (t_s % 4.0 > 3.0)
        return 1.5 * INERTIA * (self.state + push)


def test_good_gains_are_confirmed_in_gusts_and_with_sticks(bench):
    rng = np.random.default_rng(1)
    sticks = [
        Event(2.0 + 0.7 * k, str(rng.choice(('roll', 'pitch'))), float(rng.uniform(-0.6, 0.6)))
        for k in range(20)
    ]
    made = bench(effect=Gusts(), events=sticks, mount='hover', profile='hover')
    made.fly(1.0)
    made.ask(roll_angle_kp=5.5, roll_rate_kp=0.085, pitch_angle_kp=5.5, pitch_rate_kp=0.085)
    made.fly_until('confirmed', seconds=12.0)


def fed(watch, seconds, size, omega, rate_hz=250.0):
    """Feed an oscillation of the rate, rad/s; the time of the alarm, None without one."""
    for k in range(round(seconds * rate_hz)):
        turns = np.array([size * np.sin(omega * k / rate_hz), 0.0, 0.0])
        watch.step(turns, STILL, STILL, STILL)
        if watch.alarm() is not None:
            return k / rate_hz
    return None


@pytest.mark.parametrize(('omega', 'rate_hz'), [
    (6.0, 250.0), (12.0, 250.0), (25.0, 250.0), (50.0, 50.0), (50.0, 250.0), (50.0, 1000.0)])
def test_a_new_oscillation_is_heard_and_named_at_every_rate_of_the_loop(omega, rate_hz):
    watch = GainWatch(rate_hz)
    assert fed(watch, 5.0, 0.05, omega, rate_hz=rate_hz) is None
    watch.begin()
    assert fed(watch, 3.0, 0.05, omega, rate_hz=rate_hz) is None
    # in seconds, whatever a cycle lasts
    assert 0.1 < fed(watch, 2.0, 1.2, omega, rate_hz=rate_hz) < 1.5
    alarm = str(watch.alarm())
    assert 'roll' in alarm


@pytest.mark.parametrize(('rms', 'heard'), [(0.2, False), (0.6, True)])
def test_gusts_out_of_calm_air_are_no_alarm_and_a_shaken_aircraft_is(rms, heard):
    """Coloured rates (0.1 s) that begin with the update; the bound is 0.3 rad/s RMS."""
    rng, watch, rate = np.random.default_rng(3), GainWatch(250.0), 0.0
    fed(watch, 5.0, 0.0, 1.0)
    watch.begin()
    alarms = []
    for _ in range(round(10.0 / DT)):
        rate += -10.0 * DT * rate + rms * np.sqrt(20.0 * DT) * rng.normal()
        watch.step(np.array([0.0, rate, 0.0]), STILL, STILL, STILL)
        alarms.append(watch.alarm())
    assert any(alarms) is heard


@pytest.mark.parametrize(('size', 'heard'), [(0.3, False), (1.0, True)])
def test_a_first_flight_may_turn_but_not_swing(size, heard):
    """1 rad/s at 50 rad/s is an amplitude of 1.1 degrees; nothing is known of the aircraft."""
    watch = GainWatch(250.0)
    watch.begin()
    assert (fed(watch, 5.0, size, 50.0) is not None) is heard
    assert watch.alarm() is None or 'oscillation near 64 rad/s' in str(watch.alarm())


@pytest.mark.parametrize(('size', 'alarm'), [(0.36, None), (0.48, 'near 16 rad/s')])
def test_out_of_calm_air_an_octave_may_swing_by_its_floor(size, alarm):
    """Of 1.5 deg, which at 16 rad/s is 0.42 rad/s; of the whole rate it is less than its floor."""
    watch = GainWatch(50.0)
    fed(watch, 2.0, 0.0, 16.0, rate_hz=50.0)
    watch.begin()
    assert (fed(watch, 4.0, size, 16.0, rate_hz=50.0) is None) is (alarm is None)
    assert str(alarm) in str(watch.alarm())


@pytest.mark.parametrize(('calm_s', 'heard'), [(9.0, False), (11.5, True)])
def test_before_are_the_last_ten_seconds(calm_s, heard):
    watch = GainWatch(50.0)
    fed(watch, 3.0, 0.8, 12.0, rate_hz=50.0)
    fed(watch, calm_s, 0.0, 12.0, rate_hz=50.0)
    watch.begin()
    assert (fed(watch, 4.0, 1.1, 12.0, rate_hz=50.0) is not None) is heard
    watch.end()
    watch.restart()
    fed(watch, calm_s - 1.0, 0.0, 12.0, rate_hz=50.0)
    assert watch.good is heard


def test_what_was_there_before_is_no_alarm_unless_the_design_promised_less():
    for ratio, heard in ((1.0, False), (0.5, True)):
        watch = GainWatch(250.0)
        fed(watch, 6.0, 0.8, 12.0)
        watch.begin({'roll': Predicted(ratio, ratio)})
        assert (fed(watch, 4.0, 1.1, 12.0) is not None) is heard


def test_a_step_of_the_stick_may_be_followed_slowly_but_not_for_ever():
    """20 deg are within 8 deg and twice the step; that fades with 0.5 s, and after 0.6 s it ends.

    A step that is followed with a lag of 0.25 s is no alarm.
    """
    for lag_s, alarm_s in ((np.inf, 0.6), (0.25, None)):
        watch, angle, alarms = GainWatch(50.0), STILL, []
        fed(watch, 3.0, 0.0, 1.0, rate_hz=50.0)
        watch.begin()
        for k in range(100):
            step = np.radians([20.0, 0.0, 0.0])
            rate = (step - angle) / lag_s
            watch.step(rate, angle, step, STILL)
            angle = angle + 0.02 * rate
            alarms += [0.02 * k] if watch.alarm() else []
        assert alarms[:1] == ([] if alarm_s is None else [pytest.approx(alarm_s, abs=0.15)])


@pytest.mark.parametrize(('away_deg', 'injected', 'alarm_s'), [
    (15.0, 0.0, 2.04), (20.0, 0.5, None), (25.0, 0.5, 2.04)])
def test_at_take_off_two_seconds_are_left_to_come_upright(away_deg, injected, alarm_s):
    """8 deg are allowed then, and half a second of what is injected as a rate: 14 deg."""
    watch, alarms = GainWatch(50.0), []
    watch.begin()
    for k in range(150):
        watch.step(STILL, np.radians([away_deg, 0.0, 0.0]), STILL, np.full(3, injected))
        alarms += [0.02 * k] if watch.alarm() else []
    assert alarms[:1] == ([] if alarm_s is None else [pytest.approx(alarm_s, abs=0.05)])


@pytest.mark.parametrize(('injected', 'heard'), [(0.0, True), (1.0, False)])
def test_motion_that_is_injected_is_explained_and_a_turn_of_the_heading_is_no_motion(
        injected, heard):
    watch, alarms = GainWatch(50.0), []
    for k in range(250):
        if k == 150:
            watch.begin()
        turns = np.array([0.0, 0.0, 1.2 * np.sin(0.24 * k) * (k > 150)])
        heading = np.array([0.0, 0.0, (1 - 2 * (k % 2)) * (np.pi - 0.001)])
        watch.step(turns, heading, heading, injected * turns)
        alarms.append(watch.alarm())
    assert any(alarms) is heard


def test_stored_levels_that_are_none_are_not_used():
    watch = GainWatch(50.0)
    known = watch.known
    for levels in (np.full((6, 3), -1.0), np.full((6, 3), np.nan), np.zeros((5, 3)), 'high', None):
        watch.know(levels)
        assert watch.known == known
    watch.know(np.full((6, 3), 0.01))
    assert watch.known == [[0.01] * 3] * 6


@pytest.mark.parametrize(('ratio', 'size', 'heard'), [
    (1.0, 1.8, False), (1.0, 2.3, True), (1.5, 2.7, False), (1.5, 3.4, True)])
def test_a_climb_may_swing_twice_as_much_as_predicted(ratio, size, heard):
    watch, alarms = ClimbWatch(), []
    for k in range(3000):
        now = 3.0 * np.sin(0.02 * np.pi * k) * (size if k > 1500 else 1.0)
        if k == 1500:
            watch.begin(ratio)
        watch.step(9.81 + now, 0.02)
        alarms.append(watch.alarm())
    assert any(alarms) is heard


def test_a_drift_away_from_the_reference_is_heard_without_any_oscillation():
    watch, lean = GainWatch(250.0), np.array([0.3, 0.0, 0.0])
    for _ in range(750):
        watch.step(STILL, lean, lean, STILL)
    watch.begin()
    turns = np.array([0.5, 0.0, 0.0])
    for k in range(1000):
        watch.step(turns, lean + DT * k * turns, lean, STILL)
        if watch.alarm() is not None:
            break
    assert str(watch.alarm()).startswith('roll: away from its reference')
    # 8 degrees are allowed, and heard of 0.06 s ahead; then they must last for 0.04 s
    assert 6.0 < np.degrees(0.5 * DT * k) < 8.5
