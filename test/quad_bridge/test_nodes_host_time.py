"""Stamps where somebody sets the system clock: followed on the ground, not in flight, not back."""

from quad_bridge.nodes.host_time import HostTime

MS = 1_000_000


def test_a_step_forward_is_followed_on_the_ground_only():
    time = HostTime(0)
    assert time.measured(3 * MS, armed=True) == ''  # reading two clocks is not a step
    assert time.epoch_ns == 0
    words = time.measured(200 * MS, armed=True)
    assert 'set by 200 ms: stamps still use the old time until disarmed' in words
    assert time.measured(201 * MS, armed=True) == ''  # said once
    assert (time.epoch_ns, time.behind_ns) == (0, 201 * MS)
    assert 'stamps move by 201 ms' in time.measured(201 * MS, armed=False)
    assert (time.epoch_ns, time.behind_ns) == (201 * MS, 0)


def test_a_step_back_waits_for_the_next_opening():
    time = HostTime(1000 * MS)
    assert 'until the port is opened anew' in time.measured(400 * MS, armed=False)
    assert (time.epoch_ns, time.behind_ns) == (1000 * MS, -600 * MS)
    time.opened(400 * MS)
    assert time.measured(400 * MS, armed=False) == ''
    assert time.epoch_ns == 400 * MS
