"""The monitor: coverage of a known answer and of none, the screen, and the node as a process."""

import itertools
import math
import os
import re
import signal
import subprocess
import time
from dataclasses import replace

import numpy as np
import pytest
from node_process import GRACE_S, node_command
from probe import event, stamp

from quad_bridge.monitor.coverage import BAND, Pairs, coverage, needed_s, reachable
from quad_bridge.monitor.view import WIDTH, Entry, State

DT = 0.004


def answered(seconds: float, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random levels of 0.1 s as angles asked for, and the rate of a loop that follows; noise.

    Rate reference 3 (asked - angle), followed with a lag of 0.05 s.
    """
    rng = np.random.default_rng(seed)
    n = round(seconds / DT)
    x = np.repeat(rng.choice([-1.0, 1.0], n // 25 + 1), 25)[:n]
    y, angle = np.zeros(n), 0.0
    for k in range(1, n):
        y[k] = y[k - 1] + DT / 0.05 * (3.0 * (x[k - 1] - angle) - y[k - 1])
        angle += DT * y[k]
    return x, y + noise * rng.standard_normal(n)


def test_an_answer_covers_the_band_and_noise_none_of_it():
    x, y = answered(40.0, 0.05, 1)
    assert coverage([(x, y)], DT, (0.6, 20.0)).enough
    noise = np.random.default_rng(2).standard_normal((40, x.size))
    shares = [coverage([(x, y)], DT, (0.2, 20.0)).share for y in noise]
    assert np.mean(shares) < 0.03  # chance is 1 % of the frequencies
    assert max(shares) < 0.5


def test_pairs_match_by_stamp_and_break_at_gaps():
    pairs = Pairs()
    for k in range(1000):
        if k >= 10:  # the rate comes later than what was added in its cycle
            pairs.rate((k - 10) * 4_000_000, float(k - 10))
        if k < 400 or k > 600 :
            pairs.excitation(k * 4_000_000, -float(k))
        if k % 77 == 0:
            pairs.parts()
    parts, dt = pairs.parts()
    assert dt == pytest.approx(DT)
    assert [x.size for x, _ in parts] == [400, 389]
    assert all((x == -y).all() for x, y in parts)
    pairs.clear()
    assert pairs.parts() == ([], 0.0)


def full_state() -> State:
    entry = Entry(0, 'control cycles arrive', {}, 100.0)
    x, y = answered(40.0, 0.05, 1)
    return State(
        entries={
            'serial_bridge: link': entry,
            'serial_bridge: clock': Entry(1, 'not converged', {}, 90.0),
            'excitation: schedule': Entry(0, 'running', {
                'progress_pct': '42', 'segment': 'train', 'signal': 'prbs', 'axis': 'roll',
                'angle_limit_deg': '25', 'battery_min_v': '11.8',
            }, 100.0),
            'serial_bridge: excitation': Entry(1, 'a stale set-point', {}, 100.0),
            'bag_logger: recording': Entry(2, 'disk full ' * 12, {}, 99.9),
        },
        rate_hz=250.0, imu_at_s=99.9, angles_deg=(22.0, -1.0, 170.0), battery_v=11.7,
        bag='flights/one', bag_state='recording', segment={'axis': 'roll'}, trained_s=70.0,
        coverage=coverage([(x, y)], DT, (0.5, 20.0)),
    )


def test_the_screen_tells_all_in_one_place():
    state = full_state()
    shown = '\n'.join(state.lines(100.0))
    assert max(len(line) for line in shown.splitlines()) <= WIDTH
    for pattern in (
        r'link +ok +control cycles', r'clock +stale +no news for 10 s', r'imu +ok +250 Hz',
        r'recording +ERROR +disk full', r'42 % train prbs roll',
        r'angles +WARN .*roll  \+22.0.*limit 25', r'battery +ERROR +11.70 V', r'WARN +a stale',
        r'coverage +ok +roll 0.5 to 20 of 0.5 to 20', r'gains +- +nothing received', r'100 %',
        r' 70 s trained, 0 s validated$'):
        assert re.search(pattern, shown, re.MULTILINE), pattern
    blind = replace(state, angles_deg=(math.nan,) * 3)
    assert 'angles      -      not measured' in blind.lines(100.0)
    nothing = '\n'.join(State().lines(0.0))
    assert 'nothing received' in nothing
    assert 'roll' not in nothing


@pytest.mark.parametrize(('logger', 'line'), [
    (Entry(0, 'recording', {'path': 'flights/one'}, 99.0), 'ok     recording one'),
    (Entry(0, 'recording', {'path': 'flights/one'}, 90.0),
     'ERROR  no news of the logger for 10 s, which recorded one'),
    (Entry(0, 'idle', {}, 99.0), 'ERROR  nothing is recorded any more: one did not end'),
    (Entry(0, 'idle', {}, 79.0), 'ERROR  no news of the logger for 21 s'),
])
def test_a_logger_that_died_records_nothing(logger, line):
    state = full_state()
    state.bag_at_s, state.battery_at_s = 80.0, 99.0
    state.entries['bag_logger: recording'] = logger
    shown = state.lines(100.0)
    assert any(text.startswith(f'recording   {line}') for text in shown)
    assert not any(text.startswith(('angles      stale', 'battery     stale')) for text in shown)
    late = state.lines(110.0)
    assert {text[:18] for text in late} >= {'angles      stale ', 'battery     stale '}


def test_the_band_is_what_the_segments_can_tell_and_the_screen_says_so():
    assert BAND == (0.1, 20.0)
    assert reachable(BAND, math.nan) == reachable(BAND, 0.0) == BAND
    assert reachable(BAND, needed_s(0.1)) == pytest.approx(BAND)
    low, high = reachable(BAND, 40.0)
    assert 2.0 * np.pi / low < 40.0 < needed_s(0.1)
    assert high == 20.0
    assert reachable(BAND, 0.1) == (20.0, 20.0)
    x, y = answered(40.0, 0.05, 1)
    state = State(target_band=BAND, validated_s=12.0)
    assert state.reachable_band(BAND) == BAND
    state.entries['excitation: schedule'] = Entry(0, 'running', {'train_s': '40'}, 100.0)
    assert state.reachable_band(BAND) == (low, high)
    state.coverage = coverage([(x, y)], DT, state.reachable_band(BAND))
    assert state.call(10.0) == 'stop now: 0.25 to 20 rad/s covered'
    shown = '\n'.join(state.lines(100.0))
    assert '0.25 to 20 of 0.25 to 20 rad/s' in shown
    assert '0 s trained, 12 s validated; 0.1 rad/s needs 100 s' in shown


def test_the_node_says_when_enough_is_in(probe, start):
    monitor = start('monitor', namespace='/left', band_low_rad_s=2.0,
                    every_s=1, validation_s=1.0)  # fmt: skip
    topics = ('/left/imu/data', '/left/excitation/applied', '/left/excitation/segment')
    probe.meet(*topics, '/left/logger/bag')
    x, y = answered(60.0, 0.05, 5)
    cycles, pauses_s = itertools.count(), itertools.cycle((0.0, 0.3, 0.6))

    def flown_s():
        return re.findall(r'(\d+) s trained, (\d+) s', monitor.printed)

    def fly_until(pattern, role):
        """900 cycles at once, which the middleware holds, until the time flown stands still.

        Stamps, not the clock, say how long it takes. A screen comes each second: one that is drawn
        always as long after the last message may always find the sensors silent.
        """
        probe.publish(topics[2], event({'segment': role, 'axis': 'pitch', 'signal': 'prbs'}))
        while not re.search(pattern, monitor.printed):
            time.sleep(next(pauses_s))
            part, told = [*itertools.islice(cycles, 900)], len(flown_s())
            headers = [{'header': stamp(10**9 + 4_000_000 * k)} for k in part]
            probe.publish(topics[0], *(
                h | {'orientation': {'w': 1.0}, 'angular_velocity': {'y': y[k % y.size]}}
                for h, k in zip(headers, part, strict=True)
            ))  # fmt: skip
            probe.publish(topics[1], *(
                h | {'vector': {'y': x[k % x.size]}} for h, k in zip(headers, part, strict=True)
            ))  # fmt: skip
            probe.until(lambda told=told: (s := flown_s())[told + 1 :] and s[-1] == s[-2])

    fly_until('go on to validation', 'train')
    fly_until('stop now: 2 to 20 rad/s covered', 'validation')
    fly_until(r'imu +ok +250 Hz', 'idle')
    probe.publish('/left/logger/bag', event({'path': 'flights/two', 'state': 'recording'}))
    probe.until(lambda: re.search(r'recording two\n(.*\n)*.* 0 s trained, 0 s', monitor.printed))
    assert monitor.end() == 0
    assert '\x1b' not in monitor.printed


def test_a_terminal_shows_the_screen():
    terminal, its_end = os.openpty()
    with subprocess.Popen(node_command('monitor', '/left'), stdout=its_end, stderr=its_end) as one:
        os.close(its_end)  # where the monitor ends by itself, the next read fails
        shown = b''
        while b'validated' not in shown and b'ERROR' not in shown:
            shown += os.read(terminal, 4096)
        one.send_signal(signal.SIGINT)
        assert one.wait(GRACE_S) == 0
    os.close(terminal)
    assert b'\x1b[H\x1b[Jlink        -      nothing received' in shown
