"""The clock finds offset and drift through jitter and stalls, and starts again after a jump."""

from dataclasses import replace

import numpy as np
import pytest
from flight_controller import STILL

from quad_bridge.link.clock import ClockEstimator, DeviceTime
from quad_bridge.sensors.live import LiveSensors

OFFSET_NS = 1_700_000_000_000_000_000


class Jitter:
    """A host and a device whose clock runs `drift` slow, joined by a jittery line."""

    def __init__(self, drift, seed, asymmetry_s=0.0):
        self.asymmetry_s, self.drift = asymmetry_s, drift
        self.offset_ns, self.now_s = OFFSET_NS, 0.0
        self.rng = np.random.default_rng(seed)

    def host(self, device_s):
        return self.offset_ns + round(1e9 * device_s * (1.0 + self.drift))

    def trip(self, step_s, stall_s=0.0):
        self.now_s += step_s
        there = 0.0002 + self.rng.exponential(0.0002)
        back = 0.0002 + self.rng.exponential(0.0002) + self.asymmetry_s + stall_s
        sent, middle, end = self.now_s, self.now_s + there, self.now_s + there + back
        return self.host(sent), round(1e9 * middle), self.host(end)


def errors_ms(clock, pair, seconds, *, stalls=0.0):
    found = []
    while pair.now_s < seconds:
        stall = 0.03 * pair.rng.random() if pair.rng.random() < stalls else 0.0
        clock.add(*pair.trip(0.05 if pair.now_s < 1.0 else 0.2, stall))
        if clock.converged:
            device_ns = round(1e9 * pair.now_s)
            found.append((clock.host_ns(device_ns) - pair.host(pair.now_s)) * 1e-6)
    return np.array(found)


@pytest.mark.parametrize(
    ('drift', 'seed', 'asymmetry_s', 'stalls', 'rms_ms', 'most_ms'),
    [
        (0.0, 3, 0.0, 0.3, 0.1, 0.5),
        (50e-6, 3, 0.0, 0.3, 0.1, 0.5),
        # what is demanded of the link, from the first stamp on
        (50e-6, 0, 0.0005, 0.5, 0.5, 2.0),
        (-50e-6, 1, 0.0005, 0.5, 0.5, 2.0),
    ],
)
def test_stamps_follow_a_drifting_clock_through_stalls(
    drift, seed, asymmetry_s, stalls, rms_ms, most_ms
):
    clock, pair = ClockEstimator(), Jitter(drift, seed, asymmetry_s)
    errors = errors_ms(clock, pair, 90.0, stalls=stalls)
    assert np.sqrt(np.mean(errors**2)) < rms_ms
    assert np.abs(errors).max() < most_ms
    assert 1e6 * clock.drift == pytest.approx(1e6 * drift, abs=5.0)
    assert clock.rejected > 10  # trips over 10 ms
    # a constant asymmetry cannot be seen; half the shortest round trip bounds it
    assert np.abs(np.mean(errors)) < 500.0 * clock.round_trip_s


def test_not_converged_before_eight_good_trips():
    clock, pair = ClockEstimator(), Jitter(0.0, 1)
    clock.reset()
    assert clock.restarts == 0  # there was nothing to begin anew
    for _ in range(7):
        assert clock.add(*pair.trip(0.05))
        assert not clock.add(*pair.trip(0.05, stall_s=0.02))
    assert not clock.converged
    clock.add(*pair.trip(0.05))
    assert clock.converged


@pytest.mark.parametrize('jump_ms', [40.0, 2.5])
def test_a_jump_of_the_device_is_not_averaged_away_but_restarts_the_estimate(jump_ms):
    clock, pair = ClockEstimator(), Jitter(20e-6, 2)
    errors_ms(clock, pair, 10.0)
    pair.offset_ns += round(1e6 * jump_ms)
    clock.add(*pair.trip(0.2))
    assert clock.converged  # a single outlier is not believed
    assert clock.doubtful
    assert clock.restarts == 0
    clock.add(*pair.trip(0.05))
    assert not clock.converged
    assert clock.restarts == 1
    assert np.abs(errors_ms(clock, pair, 20.0)).max() < 0.5


def test_arrivals_do_where_nobody_answers_and_an_answer_ends_it():
    clock, pair = ClockEstimator(), Jitter(20e-6, 6)
    errors = []
    for k in range(5000):
        pair.now_s = 0.004 * k
        late_s = 0.001 + pair.rng.exponential(0.0005)
        device_ns = round(1e9 * pair.now_s)
        clock.add_arrival(device_ns, pair.host(pair.now_s + late_s))
        if clock.converged:
            errors.append(1e-6 * (clock.host_ns(device_ns) - pair.host(pair.now_s)))
    assert clock.one_way
    # late by the transport, here 1 ms at least
    assert len(errors) > 4000
    assert 0.5 < min(errors) < max(errors) < 1.5
    clock.add(*pair.trip(0.05))
    assert not clock.one_way
    assert not clock.converged


def test_device_time_that_wraps_at_32_bits_goes_on():
    time, near = DeviceTime(), 60_000_000
    begin = 2**32 - 10_000_000
    told = [time.extend((begin + 4000 * k) % 2**32, near) for k in range(5000)]
    assert np.diff(told).tolist() == [4000] * 4999
    assert time.wraps == 1
    assert time.extend(2**32 - 1000, near) == 2**32 - 1000  # was under way when it wrapped
    time.restart()
    assert time.extend(5000, near) == 5000


@pytest.mark.parametrize(
    'times',
    [
        [(2**32 - 5, 60), (2**32 + 5, 60), (2**40, 60), (2**40 + 4000, 60)],  # 64 bits
        [(1_000, 0), (2_000, 0), (10**15, 60), (3_000, 60)],  # false by far
    ],
)
def test_other_times_are_no_wrap(times):
    time = DeviceTime()
    for now_us, near_s in times:
        assert time.extend(now_us, 1_000_000 * near_s + 60) == now_us
        assert time.peek(2**32 - 1, 60) == 2**32 - 1  # only looked at
    assert time.wraps == 0


def test_a_device_whose_time_stands_still_fills_no_memory():
    clock = ClockEstimator()
    for k in range(20_000):
        clock.add_arrival(1_000_000, 1000 * k)
    assert len(clock._block) <= 5000
    sensors = LiveSensors(correct=True)
    for _ in range(2000):
        sensors.cycle(replace(STILL, flags=0))
    assert len(sensors.standing()) == 1
