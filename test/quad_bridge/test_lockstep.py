"""Simulated time waits for the slowest process, and for nothing that nobody owes."""

import itertools

import pytest
from node_process import until

from quad_bridge.lockstep import START_NS, STREAMS, WINDOW_NS, WIRE, Participant
from quad_bridge.virtual.line import Line

CYCLE_NS = 4_000_000
WINDOW = WINDOW_NS // CYCLE_NS + 1
"""Cycles after which time stands still."""


class Master:
    """A line whose time the test moves, and processes on it that have their steps run by it."""

    def __init__(self, folder):
        self.said = []
        self.path = folder / 'line'
        self.line = Line(self.path, self.said.append)
        self.now_ns = START_NS
        self.members = []
        self.meanwhile = lambda: None

    def join(self, name):
        member = Participant(self.path, name)
        self.members.append(member)
        self.until(lambda: name in self.line.names)
        return member

    def until(self, condition):
        until(condition, 'on the line', lambda: (self.line.attend(0.005), self.meanwhile()))

    def cycle(self):
        """One more cycle, when all are ready for it."""
        self.until(lambda: self.line.ready)
        self.now_ns += CYCLE_NS
        self.line.tell(self.now_ns)

    def goes_on(self, then=lambda: None):
        """Time does not stand still, with this after each cycle."""
        for _ in range(3 * WINDOW):
            self.cycle()
            then()

    def stuck(self):
        """Run until time stands still; how many cycles that were."""
        count = 0
        for _ in range(20):
            for _ in range(20):
                self.line.attend(0.005)
            if self.line.ready:
                count += 1
                self.cycle()
        return count


@pytest.fixture
def master(tmp_path):
    master = Master(tmp_path)
    yield master
    for member in master.members:
        member.close()
    master.line.close()


def test_time_waits_for_who_holds_it_until_it_goes_on_or_ends(master):
    assert not master.line.ready  # nobody there, no time passes
    member = master.join('bridge')
    assert member.now_ns() == 0
    master.goes_on()
    slow, other = master.join('slow'), master.join('other')
    slow.hold()
    assert master.stuck() <= WINDOW
    master.until(lambda: member.now_ns() == master.now_ns)
    slow.release()
    master.goes_on()
    other.hold()
    master.stuck()
    other.close()
    master.until(lambda: master.line.names == ['bridge', 'slow'])
    master.goes_on()
    master.until(lambda: member.now_ns() == master.now_ns)


def test_a_stream_is_waited_for_from_its_first_message_until_its_publisher_ends(master):
    publisher, reader = master.join('publisher'), master.join('reader')

    def publish():
        publisher.published('stream', master.now_ns)
        publisher.handled(WIRE, master.now_ns)

    master.goes_on(publish)  # nothing was received yet: nothing is waited for
    reader.handled('stream', master.now_ns)
    master.goes_on(lambda: (publish(), reader.handled('stream', master.now_ns)))
    publish()
    master.cycle()
    publish()
    assert master.stuck() <= 2 * WINDOW
    publisher.close()
    master.goes_on()


def test_the_wire_is_waited_for_until_it_is_forgotten(master):
    bridge = master.join('bridge')
    master.cycle()
    bridge.handled(WIRE, master.now_ns)
    assert master.stuck() <= WINDOW
    bridge.forget(WIRE)
    master.goes_on()


def test_time_goes_on_while_the_thread_of_timers_and_subscriptions_waits(master):
    bridge, other, ran = master.join('bridge'), master.join('other'), []
    bridge.on_due = bool  # as long as that thread waits
    bridge.timer(0.004, lambda: ran.append(None))
    bridge.handled(STREAMS[0], master.now_ns)
    other.published(STREAMS[0], master.now_ns + CYCLE_NS)
    assert master.stuck() <= 2 * WINDOW
    master.meanwhile = lambda: bridge.rest(0.0)
    master.goes_on()
    assert ran


def test_timers_run_at_every_time_that_is_theirs(master):
    member, seen, slow = master.join('node'), [], []
    wakes = []
    member.on_due = lambda: wakes.append(None)
    timer = member.timer(0.004, lambda: seen.append(member.now_ns()))
    member.timer(0.05, lambda: slow.append(member.now_ns()))
    assert master.stuck() <= WINDOW + 1
    assert wakes
    assert not seen
    master.meanwhile = member.step
    while master.now_ns < START_NS + 60 * CYCLE_NS:
        master.cycle()
    master.until(lambda: member.now_ns() == master.now_ns)
    assert [b - a for a, b in itertools.pairwise(seen)] == [CYCLE_NS] * (len(seen) - 1)
    assert len(seen) >= 55
    assert {b - a for a, b in itertools.pairwise(slow)} <= {48_000_000, 52_000_000}
    timer.cancel()
    count = len(seen)
    master.cycle()
    master.until(lambda: member.now_ns() == master.now_ns)
    assert len(seen) == count
