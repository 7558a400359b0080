"""The clock finds offset and drift through jitter and stalls, and starts again after a jump."""

from dataclasses import replace

import numpy as np
import pytest
from flight_controller import STILL

from quad_bridge.link.clock import MAX_IN_BLOCK, ClockEstimator
from quad_bridge.sensors.live import MAX_SAMPLES, LiveSensors

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
    # through a silence of ten seconds the drift goes on
    later_s = pair.now_s + 10.0
    assert 1e-6 * abs(clock.host_ns(round(1e9 * later_s)) - pair.host(later_s)) < 0.6


def test_arrivals_do_where_nobody_answers_and_answers_end_it():
    clock, pair = ClockEstimator(), Jitter(20e-6, 6)
    errors = []
    for k in range(5000):
        pair.now_s = 0.004 * (k ^ 1)  # the next one overtakes each on a network
        late_s = 0.001 + pair.rng.exponential(0.0005)
        device_ns = round(1e9 * pair.now_s)
        clock.add_arrival(device_ns, pair.host(pair.now_s + late_s))
        if clock.converged:
            errors.append(1e-6 * (clock.host_ns(device_ns) - pair.host(pair.now_s)))
    assert clock.one_way
    # late by the transport, here 1 ms at least
    assert len(errors) > 4000
    assert 0.5 < min(errors) < max(errors) < 1.5
    for k in range(8):  # one now and then would leave it without a time
        clock.add(*pair.trip(20.0))
        assert clock.converged
        assert clock.one_way is (k < 7)


def test_a_device_clock_that_hardly_moves_fills_no_memory():
    clock, sensors = ClockEstimator(), LiveSensors(correct=True)
    for k in range(2 * MAX_SAMPLES):
        clock.add_arrival(1_000_000 + k, 4_000_000 * k)
        sensors.cycle(replace(STILL, flags=0, time_us=1_000_000 + k))
    assert len(sensors.standing()) == MAX_SAMPLES
    assert len(clock._block) <= MAX_IN_BLOCK
