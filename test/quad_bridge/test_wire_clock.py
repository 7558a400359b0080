"""The clock finds offset and drift through jitter and stalls, and starts again after a jump."""

import numpy as np
import pytest

from quad_bridge.wire.clock import ClockEstimator

OFFSET_NS = 1_700_000_000_000_000_000


class Pair:
    """A host and a device whose clock runs `drift` slow, joined by a jittery line."""

    def __init__(self, drift, seed):
        self.drift, self.offset_ns, self.now_s = drift, OFFSET_NS, 0.0
        self.rng = np.random.default_rng(seed)

    def host(self, device_s):
        return self.offset_ns + round(1e9 * device_s * (1.0 + self.drift))

    def trip(self, step_s, stall_s=0.0):
        self.now_s += step_s
        there = 0.0002 + self.rng.exponential(0.0002)
        back = 0.0002 + self.rng.exponential(0.0002) + stall_s
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


@pytest.mark.parametrize('drift', [-50e-6, 0.0, 50e-6])
def test_stamps_follow_a_drifting_clock_through_stalls(drift):
    clock, pair = ClockEstimator(), Pair(drift, 3)
    errors = errors_ms(clock, pair, 60.0, stalls=0.3)
    # contract of the link: 0.5 ms RMS, 2 ms at most
    assert np.sqrt(np.mean(errors**2)) < 0.1
    assert np.abs(errors).max() < 0.5
    assert clock.state.drift_ppm == pytest.approx(1e6 * drift, abs=5.0)
    assert clock.state.rejected > 10  # trips over 10 ms


def test_not_converged_before_eight_good_trips():
    clock, pair = ClockEstimator(), Pair(0.0, 1)
    for _ in range(7):
        assert clock.add(*pair.trip(0.05))
        assert not clock.add(*pair.trip(0.05, stall_s=0.02))
    assert not clock.converged
    clock.add(*pair.trip(0.05))
    assert clock.converged


def test_a_jump_of_the_device_restarts_the_estimate():
    clock, pair = ClockEstimator(), Pair(20e-6, 2)
    errors_ms(clock, pair, 10.0)
    pair.offset_ns += 40_000_000
    clock.add(*pair.trip(0.2))
    assert clock.converged  # a single outlier is not believed
    assert clock.state.restarts == 0
    clock.add(*pair.trip(0.2))
    assert not clock.converged
    assert clock.state.restarts == 1
    errors = errors_ms(clock, pair, 20.0)
    assert np.abs(errors).max() < 0.5


def test_stamps_never_run_backwards():
    clock, pair = ClockEstimator(), Pair(80e-6, 4)
    stamps = []
    while pair.now_s < 20.0:
        trip = pair.trip(0.05)
        stamps += [clock.host_ns(round(1e9 * (pair.now_s - 0.04 + 0.004 * k))) for k in range(10)]
        clock.add(*trip)
    settled = np.diff(stamps[200:])
    assert settled.min() >= 0


def test_reset_of_a_fresh_estimator_is_no_restart():
    clock = ClockEstimator()
    clock.reset()
    assert clock.state.restarts == 0
