"""Simulated time waits for the slowest process, and for nothing that nobody owes."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from quad_bridge.errors import BadInputError
from quad_bridge.lockstep import START_NS, WINDOW_NS, WIRE, Participant
from quad_bridge.virtual.line import Line

CYCLE_NS = 4_000_000
PATIENCE_S = 120.0


class Master:
    """A line whose time the test moves, and processes on it that have their steps run by it."""

    def __init__(self, folder: Path) -> None:
        self.said: list[str] = []
        self.path = folder / 'line'
        self.line = Line(self.path, self.said.append)
        self.now_ns = START_NS
        self.members: list[Participant] = []
        self.meanwhile: Callable[[], None] = lambda: None

    def join(self, name: str) -> Participant:
        member = Participant(self.path, name)
        self.members.append(member)
        self.until(lambda: name in self.line.names)
        return member

    def until(self, condition: Callable[[], object]) -> None:
        end_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end_s, (self.line.names, self.line.slowest_ns)
            self.line.attend(0.005)
            self.meanwhile()

    def cycle(self) -> None:
        """One more cycle, when all are ready for it."""
        self.until(lambda: self.line.ready)
        self.now_ns += CYCLE_NS
        self.line.tell(self.now_ns)

    def stuck(self) -> int:
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
def master(tmp_path: Path) -> Iterator[Master]:
    master = Master(tmp_path)
    yield master
    for member in master.members:
        member.close()
    master.line.close()


WINDOW = WINDOW_NS // CYCLE_NS + 1
"""Cycles after which time stands still."""


def test_nobody_there_no_time_passes(master: Master) -> None:
    assert not master.line.ready
    member = master.join('bridge')
    assert member.now_ns() == 0
    for _ in range(3 * WINDOW):
        master.cycle()
    master.until(lambda: member.now_ns() == master.now_ns)


def test_time_waits_for_who_holds_it(master: Master) -> None:
    quick, slow = master.join('quick'), master.join('slow')
    slow.hold()
    assert master.stuck() <= WINDOW
    assert quick.now_ns() == master.now_ns
    slow.release()
    for _ in range(3 * WINDOW):
        master.cycle()


def test_who_ends_is_waited_for_no_more(master: Master) -> None:
    member, other = master.join('one'), master.join('other')
    other.hold()
    master.stuck()
    other.close()
    master.until(lambda: master.line.names == ['one'])
    master.cycle()
    master.until(lambda: member.now_ns() == master.now_ns)


def test_a_stream_is_waited_for_from_the_first_message_until_its_publisher_ends(
    master: Master,
) -> None:
    publisher, reader = master.join('publisher'), master.join('reader')

    def publish() -> None:
        publisher.published('stream', master.now_ns)
        publisher.handled(WIRE, master.now_ns)

    for _ in range(2 * WINDOW):  # nothing was received yet: nothing is waited for
        master.cycle()
        publish()
    reader.handled('stream', master.now_ns)
    for _ in range(3 * WINDOW):
        master.cycle()
        publish()
        reader.handled('stream', master.now_ns)
    publish()
    master.cycle()
    publish()
    assert master.stuck() <= 2 * WINDOW
    publisher.close()
    for _ in range(3 * WINDOW):
        master.cycle()


def test_the_wire_is_waited_for_until_it_is_forgotten(master: Master) -> None:
    bridge = master.join('bridge')
    master.cycle()
    bridge.handled(WIRE, master.now_ns)
    assert master.stuck() <= WINDOW
    bridge.forget(WIRE)
    for _ in range(3 * WINDOW):
        master.cycle()


def test_timers_run_at_every_time_that_is_theirs(master: Master) -> None:
    member, seen, slow = master.join('node'), [], []
    wakes: list[None] = []
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
    member.step()
    assert len(seen) == count


def test_a_callback_that_fails_does_not_stop_time(master: Master) -> None:
    member = master.join('node')

    def fail() -> None:
        raise ZeroDivisionError

    member.on_due = lambda: None
    member.timer(0.004, fail)
    failed = 0

    def step() -> None:
        nonlocal failed
        try:
            member.step()
        except ZeroDivisionError:
            failed += 1

    master.meanwhile = step
    for _ in range(3 * WINDOW):
        master.cycle()
    assert failed > WINDOW


def test_a_socket_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r'--lockstep .*cannot listen there'):
        Line(tmp_path / ('x' * 200))
