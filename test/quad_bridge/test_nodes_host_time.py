"""Stamps where somebody sets the system clock: followed on the ground, not in flight, not back."""

from quad_bridge.nodes.host_time import CLOSE_NS, Epoch, HostTime, read_epoch

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
    assert 'until the port is opened again' in time.measured(400 * MS, armed=False)
    assert (time.epoch_ns, time.behind_ns) == (1000 * MS, -600 * MS)
    time.opened(400 * MS)
    assert time.measured(400 * MS, armed=False) == ''
    assert time.epoch_ns == 400 * MS


def test_a_process_that_is_pre_empted_between_two_clocks_sees_no_step():
    now, pauses = [1_000_000], iter([25 * MS, 0, 25 * MS])

    def steady():
        now[0] += 1000
        return now[0]

    def ros():
        now[0] += next(pauses, 0)
        return 7_000_000_000 + now[0]

    epoch = read_epoch(ros, steady)
    assert abs(epoch.ns - 7_000_000_000) <= epoch.error_ns <= CLOSE_NS
    time = HostTime(*epoch)
    assert time.measured(*read_epoch(ros, steady), armed=False) == ''
    assert time.epoch_ns == epoch.ns


def test_clocks_that_cannot_be_read_closely_bound_what_counts_as_a_step():
    time = HostTime(*Epoch(0, 20 * MS))
    assert time.measured(22 * MS, armed=False) == ''
    assert time.measured(-30 * MS, 10 * MS, armed=False) == ''
    assert 'stamps move' in time.measured(40 * MS, 10 * MS, armed=False)
