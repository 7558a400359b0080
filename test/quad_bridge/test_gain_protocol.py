"""A set of gains is in force whole or not at all, and what is said of it is true: every state.

The first half walks through all that protocol and STM32 can do to each other: every state of the
protocol × every event (answer, loss, duplicate, delay, time-out, restart of either end, what is
asked for), breadth first over the real code of both ends. The invariants, checked in each state:

1. What the STM32 flies is the set of before or a set that was written whole: no mixture.
2. After two seconds without the bridge, or when the watch has ended, it flies the last confirmed
   set. On the ground the watch stands still.
3. What was confirmed was asked to be confirmed and has flown for half of the watch, and is told
   so only when it is.
4. What is told to be active was in force; a copy that is being written never is.
5. Left alone, the two agree within some seconds: the protocol rests, and says what is flown.
"""

import functools
import math
from functools import partial

import pytest
from flight_controller import Store, clone, explore

from quad_bridge.errors import RefusedError
from quad_bridge.gains import protocol
from quad_bridge.gains.protocol import GainProtocol, State, What
from quad_bridge.gains.table import CONTRACT_NAMES
from quad_bridge.wire.frames import ParamRequestList, ParamRequestRead, ParamValue

A, B = NAMES = ('ROLL_RATE_KP', 'ROLL_RATE_KI')
OLD = {A: 0.25, B: 0.5}
REVOCABLE = (*protocol.WRITING, State.ON_TRIAL, State.CONFIRMING)
WRITES = ({A: 0.375, B: 0.625}, {A: 0.75})
LEGAL = {(0.25, 0.5), (0.375, 0.625), (0.75, 0.5), (0.75, 0.625)}
NOW_US, TICK_S, OLDEST_S, WATCH_MS = 10_000_000, 0.5, 2.5, 1000


@functools.cache
def others():
    """What the STM32 says of the parameters beside the two."""
    answers = Store.begun({}).answers(ParamRequestList(), 0)
    return tuple(x for x in answers if x.name not in NAMES)


class World:
    """Both ends and what is on the way; time stands still and deadlines move towards it."""

    def __init__(self):
        self.bridge, self.stm32 = GainProtocol(), Store.begun(OLD)
        self.up, self.down = (), ()
        self.flies = True
        self.faults, self.restarts, self.writes = 1, 1, 2
        """How many there may still be."""
        self.flown = self.asked = frozenset({(0.25, 0.5)})
        """Sets that have been in force, and that were to be confirmed."""
        self.known = self.good = (0.25, 0.5)
        """The confirmed set, as last told."""
        self.unnoticed = False
        """The STM32 has restarted, and its cycle counter has not told yet."""

    state = property(lambda self: self.bridge.state)

    def copy(self):
        new = clone(self)
        new.bridge, new.stm32 = clone(self.bridge), clone(self.stm32)
        return new

    def key(self):
        """What the future depends on; times count only while somebody waits for them."""
        b, s = self.bridge, self.stm32
        values = (len(b._values), *(b._values.get(name) for name in NAMES))
        return (
            b.state, b._number, b._checksum, values, tuple(b._queue),
            b.state in protocol.AT_REST
            or (b._tries, b._due_s, tuple(b._writes.items()), b._outcome, b._late),
            b.reported and b.reported.transaction, s.of(NAMES), s.of(NAMES, 'good'),
            s.staging and s.of(NAMES, 'copy'), s.transaction, s.watching,
            (s.staging or s.watching) and (s.heard_us, s.watching and s.flown_us),
            self.up, self.down, self.faults, self.restarts, self.writes, self.flown, self.asked,
            self.unnoticed, self.known,
        )  # fmt: skip

    def moves(self):
        room = self.up and len(self.down) < 2
        possible = {
            'tick': True, 'report': not self.down, 'arrives up': room, 'arrives down': self.down,
            'lost up': self.faults and self.up, 'lost down': self.faults and self.down,
            'doubled up': self.faults and room, 'doubled down': self.faults and self.down,
            'write': self.writes and not self.bridge.busy, 'confirm': self.state is State.ON_TRIAL,
            'revert': self.state in REVOCABLE, 'bridge restarts': self.restarts,
            'stm32 restarts': self.restarts, 'noticed': self.unnoticed}
        return {name: MOVES[name] for name, yes in possible.items() if yes}

    def send(self):
        """What the bridge has to say goes out, as far as the line takes it."""
        if len(self.up) < 2:
            frame = self.bridge.poll(0.0)
            self.up += () if frame is None else (frame,)

    def tick(self):
        """Half a second passes."""
        self.bridge._due_s = max(self.bridge._due_s - TICK_S, -OLDEST_S)
        self.stm32.pass_by(TICK_S, NOW_US)
        told = self.stm32.tick(NOW_US, flying=self.flies)
        self.down += () if told is None else ((told,),)
        self.send()

    def report(self):
        """The STM32 says unasked where it stands."""
        self.down += ((self.stm32.state(),),)

    def arrives_up(self, *, doubled=False):
        frame, *rest = self.up
        self.up = self.up if doubled else tuple(rest)
        self.faults -= doubled
        whole = isinstance(frame, ParamRequestList)
        asked = [ParamRequestRead(name) for name in NAMES] if whole else [frame]
        answers = [x for one in asked for x in self.stm32.answers(one, NOW_US)]
        # the parameters beside the two never change, and come all at once, behind them
        alone = getattr(answers[0], 'name', A) not in NAMES
        *first, last = [()] if alone else [(x,) for x in answers]
        self.down += (*first, (*last, *others()) if whole or alone else last)

    def arrives_down(self, *, doubled=False):
        frames, *rest = self.down
        self.down = self.down if doubled else tuple(rest)
        self.faults -= doubled
        before = self.stm32.of(NAMES, 'good')
        for frame in frames:
            self.bridge.take(frame, 0.0)
        for event in self.bridge.events:
            if event.active is not None:
                active = tuple(event.active[CONTRACT_NAMES[name]] for name in NAMES)
                assert active in self.flown, 'told of gains that were never in force'
                if event.what is What.CONFIRMED:
                    assert active == before, 'told of a confirmation that is none'
                if event.what in {What.READ, What.CONFIRMED}:
                    self.known = active
            if event.what in {What.REVERTED, What.FAILED} and event.reason == 'why':
                assert before == self.known, 'told of a way back that is none'
        self.bridge.events.clear()
        self.send()

    def lost(self, way):
        self.faults -= 1
        setattr(self, way, getattr(self, way)[1:])

    def write(self):
        self.bridge.write(WRITES[2 - self.writes], WATCH_MS)
        self.writes -= 1
        self.send()

    def ask(self, what):
        before = self.bridge.state
        getattr(self.bridge, what)(*(('why',) if what == 'revert' else ()))
        assert self.bridge.state is not before
        self.send()

    def bridge_restarts(self):
        self.restarts -= 1
        self.bridge = GainProtocol()
        self.send()

    def stm32_restarts(self):
        self.restarts -= 1
        self.stm32 = self.stm32.restarted()
        self.unnoticed = True

    def noticed(self):
        self.unnoticed = False
        self.bridge.restart()
        self.bridge.events.clear()
        self.send()

    def check(self):
        active, good = self.stm32.of(NAMES), self.stm32.of(NAMES, 'good')
        self.flown |= {active}
        if self.state is State.CONFIRMING:
            self.asked |= {tuple(self.bridge._values[name] for name in NAMES)}
        assert active in LEGAL, 'a mixture of sets is in force'
        assert good in self.asked, 'confirmed without having been asked'
        if good != self.good:
            assert 2 * self.stm32.flown_us >= self.stm32.watch_us, 'good without a flight'
            self.good = good
        if active != good:
            for silent_us, more_us in ((2_100_000, 0), (0, self.stm32.watch_us + 1)):
                alone = clone(self.stm32)
                alone.heard_us, alone.ticked_us = NOW_US - silent_us, NOW_US - more_us
                alone.tick(NOW_US)
                assert alone.of(NAMES) == good, 'unconfirmed gains survive bridge or watch'
        state = self.state
        if state is not State.ON_TRIAL:
            self.bridge.confirm()
            if state not in REVOCABLE:
                self.bridge.revert('why')
        assert self.state is state

    def does(self, name):
        move = self.moves().get(name)
        if move is not None:
            move(self)
            self.check()

    def comes_to_rest(self):
        """Left alone, with a report now and then, the two agree."""
        for k in range(100):
            for name in ('noticed', 'arrives up', 'arrives down', *['report'] * (k % 4 == 0)):
                self.does(name)
            self.does('tick')
            rests = self.state in protocol.AT_REST
            if rests and not self.up and not self.down and k > 12:
                break
        assert rests
        told = self.bridge.active
        assert tuple(told[CONTRACT_NAMES[name]] for name in NAMES) == self.stm32.of(NAMES)


MOVES = {
    'tick': World.tick, 'report': World.report, 'arrives up': World.arrives_up,
    'arrives down': World.arrives_down, 'lost up': partial(World.lost, way='up'),
    'lost down': partial(World.lost, way='down'),
    'doubled up': partial(World.arrives_up, doubled=True),
    'doubled down': partial(World.arrives_down, doubled=True), 'write': World.write,
    'confirm': partial(World.ask, what='confirm'), 'revert': partial(World.ask, what='revert'),
    'bridge restarts': World.bridge_restarts, 'stm32 restarts': World.stm32_restarts,
    'noticed': World.noticed,
}  # fmt: skip


@pytest.fixture
def connected(monkeypatch):
    """A world in which all was read; fewer tries, for fewer states."""
    monkeypatch.setattr(protocol, 'TRIES', 2)
    monkeypatch.setattr(protocol, 'SAFETY_TRIES', 3)
    world = World()
    for _ in range(10):
        for name in ('arrives up', 'arrives down', 'tick'):
            world.does(name)
    assert world.state is State.READY
    return world


@pytest.mark.parametrize(
    ('faults', 'restarts', 'writes', 'flies', 'most'),
    [
        (1, 0, 1, True, 9_000), pytest.param(1, 0, 1, True, math.inf, marks=pytest.mark.long),
        (0, 1, 1, True, 8_000), (0, 0, 2, True, 6_000), (0, 0, 2, False, 6_000),
        pytest.param(0, 1, 1, True, 300_000, marks=pytest.mark.long),
        pytest.param(0, 0, 2, True, 300_000, marks=pytest.mark.long),
        pytest.param(2, 1, 2, True, 300_000, marks=pytest.mark.long),
        pytest.param(2, 1, 2, False, 300_000, marks=pytest.mark.long)],
)
def test_no_state_and_no_event_breaks_an_invariant(
    connected, faults, restarts, writes, flies, most
):
    connected.faults, connected.restarts, connected.writes = faults, restarts, writes
    connected.flies = flies
    met, seen, left = explore(connected, most, rest_every=70)
    assert seen > 4000
    assert most < math.inf or left == 0
    if faults:  # whatever can happen in a state has happened in it
        events = ('tick', 'report', 'arrives up', 'arrives down')
        assert {(s, e) for s in State for e in events} <= met
        assert {s for s, name in met if 'lost' in name} == set(State)
        assert {(s, 'revert') for s in REVOCABLE} <= met
        assert (State.ON_TRIAL, 'confirm') in met


def test_the_number_of_a_transaction_begins_anew_and_an_echo_is_no_answer(connected):
    connected.bridge.take(ParamValue(B, 9.0, 2, 2), 0.0)
    assert connected.bridge.active[CONTRACT_NAMES[B]] == OLD[B]
    connected.stm32.transaction = 255
    connected.bridge.take(connected.stm32.state(), 0.0)
    said = []
    connected.write()
    with pytest.raises(RefusedError, match='busy: opening'):
        connected.bridge.write(WRITES[0], WATCH_MS)
    for _ in range(12):
        said += connected.up
        for name in ('arrives up', 'arrives down'):
            connected.does(name)
    assert connected.state is State.ON_TRIAL
    assert said[0].transaction == 1
    assert [getattr(one, 'name', '') for one in said] == ['', A, B, '', A, B]
