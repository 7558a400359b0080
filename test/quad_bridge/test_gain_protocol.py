"""A set of gains is in force whole or not at all, and what is said of it is true: every state.

The first half walks through all that protocol and STM32 can do to each other: every state of the
protocol × every event (answer, loss, duplicate, delay, time-out, restart of either end, what is
asked for), breadth first over the real code of both ends. The invariants, checked in each state:

1. What the STM32 flies is the set of before or a set that was written whole: no mixture.
2. After two seconds without the bridge it flies the last confirmed set.
3. What was confirmed was asked to be confirmed, and is told so only when it is.
4. What is told to be active was in force; a copy that is being written never is.
5. Left alone, the two agree within some seconds: the protocol rests, and says what is flown.
"""

import copy
import math
from collections import deque
from itertools import product

import pytest
from flight_controller import DROPPED, Fault, FlightController, answers_of, changed, clone
from gain_store import GainStore

from quad_bridge.errors import RefusedError
from quad_bridge.gains import protocol
from quad_bridge.gains.protocol import GainProtocol, State, What, float32
from quad_bridge.gains.table import CONTRACT_NAMES
from quad_bridge.wire.frames import (
    GainsAction,
    GainsCommand,
    GainsPhase,
    ParamRequestRead,
    ParamValue,
)

A, B = 'ROLL_RATE_KP', 'ROLL_RATE_KI'
OLD = {A: 1.0, B: 2.0}
WRITES = ({A: 1.5, B: 2.5}, {A: 3.0})
LEGAL = {(1.0, 2.0), (1.5, 2.5), (3.0, 2.0), (3.0, 2.5)}
TICK_S, WATCH_MS = 0.5, 1000


class World:
    """Both ends and what is on the way; time stands at 0 and deadlines move towards it."""

    def __init__(self):
        self.bridge = GainProtocol()
        self.stm32 = GainStore(OLD, lambda *_: True, 7)
        self.up, self.down = (), ()
        self.faults, self.restarts, self.writes = 1, 1, 2
        """How many there may still be."""
        self.flown, self.asked = frozenset({(1.0, 2.0)}), frozenset({(1.0, 2.0)})
        """Sets that have been in force, and that were to be confirmed."""
        self.unnoticed = False
        """The STM32 has restarted, and its cycle counter has not told yet."""

    def key(self):
        """What the future depends on; times count only while somebody waits for them."""
        b, s = self.bridge, self.stm32
        rests = b.state in protocol.AT_REST
        idle = s._copy is None and not s._watching
        return (
            b.state, b._number, b._checksum, tuple(sorted(b._values.items())), tuple(b._queue),
            rests or (b._left, b._due_s, tuple(b._writes.items()), b._outcome),
            b.told and b.told.transaction, tuple(s.active.values()), tuple(s._good.values()),
            s._copy and tuple(s._copy.values()), s._number, s._watching,
            idle or (s._heard_s, s._watching and s._deadline_s), self.up, self.down, self.faults,
            self.restarts, self.writes, self.flown, self.asked, self.unnoticed,
        )  # fmt: skip

    def then(self, move, *arguments, **more):
        """Another world, one move on; None where it is not possible."""
        if not self.can(move, *arguments, **more):
            return None
        new = copy.copy(self)
        new.bridge, new.stm32 = clone(self.bridge), clone(self.stm32)
        getattr(new, move)(*arguments, **more)
        new.note()
        return new

    def can(self, move, way='', *, doubled=False):
        """Whether a move is possible."""
        possible = True
        if move == 'report':
            possible = not self.down
        elif move == 'arrives_up':
            possible = self.up and len(self.down) < 2 and doubled <= self.faults
        elif move == 'arrives_down':
            possible = self.down and doubled <= self.faults
        elif move == 'lost':
            possible = self.faults and getattr(self, way)
        elif move == 'write':
            possible = self.writes and not self.bridge.busy
        elif move == 'ask':
            at_all = (*protocol.WRITING, State.ON_TRIAL) if way == 'revert' else (State.ON_TRIAL,)
            possible = self.bridge.state in at_all
        elif move in {'bridge_restarts', 'stm32_restarts'}:
            possible = self.restarts
        elif move == 'noticed':
            possible = self.unnoticed
        return bool(possible)

    def note(self):
        self.flown |= {tuple(self.stm32.active.values())}
        if self.bridge.state is State.CONFIRMING:
            self.asked |= {tuple(self.bridge._values[name] for name in OLD)}

    def send(self):
        """What the bridge has to say goes out, as far as the line takes it."""
        if len(self.up) < 2:
            frame = self.bridge.poll(0.0)
            self.up += () if frame is None else (frame,)

    def tick(self):
        """Half a second passes."""
        for part, name in (
            (self.bridge, '_due_s'), (self.stm32, '_deadline_s'), (self.stm32, '_heard_s'),
        ):  # fmt: skip
            setattr(part, name, max(getattr(part, name) - TICK_S, -2.5))
        told = self.stm32.tick(0.0)
        self.down += () if told is None else (told,)
        self.send()

    def report(self):
        """The STM32 says unasked where it stands."""
        self.down += (self.stm32.state(),)

    def arrives_up(self, *, doubled=False):
        frame, *rest = self.up
        self.up = self.up if doubled else tuple(rest)
        self.faults -= doubled
        self.stm32.heard(0.0)
        self.down += tuple(answers_of(self.stm32, frame))

    def arrives_down(self, *, doubled=False):
        frame, *rest = self.down
        self.down = self.down if doubled else tuple(rest)
        self.faults -= doubled
        before = tuple(self.stm32._good.values())
        self.bridge.take(frame, 0.0)
        for event in self.bridge.events:
            if event.active is not None:
                active = tuple(event.active[CONTRACT_NAMES[name]] for name in OLD)
                assert active in self.flown, 'told of gains that were never in force'
                if event.what is What.CONFIRMED:
                    assert active == before, 'told of a confirmation that is none'
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
        self.stm32 = GainStore(self.stm32._good, lambda *_: True, 7)
        self.unnoticed = True

    def noticed(self):
        self.unnoticed = False
        self.bridge.restart()
        self.bridge.events.clear()
        self.send()

    def check(self):
        active, good = tuple(self.stm32.active.values()), tuple(self.stm32._good.values())
        assert active in LEGAL, 'a mixture of sets is in force'
        assert good in self.asked, 'confirmed without having been asked'
        alone = clone(self.stm32)
        alone.tick(alone._heard_s + 2.1)
        assert alone.active == alone._good, 'unconfirmed gains survive the bridge'
        before = self.bridge.state
        if not self.can('ask', 'confirm'):
            self.bridge.confirm()
        if not self.can('ask', 'revert'):
            self.bridge.revert('why')
        assert self.bridge.state is before

    def agree(self):
        """Left alone, with a report now and then."""
        world = self
        for k in range(100):
            for move in ('noticed', 'arrives_up', 'arrives_down', *['report'] * (k % 4 == 0)):
                world = world.then(move) or world
            world = world.then('tick')
            rests = world.bridge.state in protocol.AT_REST
            if rests and not world.up and not world.down and k > 12:
                break
        told = {name: world.bridge.active[CONTRACT_NAMES[name]] for name in OLD}
        assert rests
        assert told == world.stm32.active


MOVES = [
    ('tick',), ('report',), ('arrives_up',), ('arrives_down',), ('lost', 'up'), ('lost', 'down'),
    ('write',), ('ask', 'confirm'), ('ask', 'revert'), ('bridge_restarts',), ('stm32_restarts',),
    ('noticed',),
]  # fmt: skip
CASES = [
    *((move, {}) for move in MOVES),
    *(((move,), {'doubled': True}) for move in ('arrives_up', 'arrives_down')),
]


def explore(world, most):
    """Every world within reach, breadth first; the states and moves that were met."""
    seen, left, met = {world.key()}, deque([world]), set()
    while left and len(seen) < most:
        world = left.popleft()
        world.check()
        if len(seen) % 50 == 0:
            world.agree()
        for move, more in CASES:
            new = world.then(*move, **more)
            if new is None:
                continue
            met.add((world.bridge.state, *move))
            key = new.key()
            if key not in seen:
                seen.add(key)
                left.append(new)
    return met, len(seen), len(left)


@pytest.fixture
def connected(monkeypatch):
    """A world in which all was read; fewer tries, for fewer states."""
    monkeypatch.setattr(protocol, 'TRIES', 2)
    monkeypatch.setattr(protocol, 'STUBBORN_TRIES', 3)
    world = World()
    for _ in range(10):
        for move in ('arrives_up', 'arrives_down', 'tick'):
            world = world.then(move) or world
    assert world.bridge.state is State.READY
    return world


@pytest.mark.parametrize(
    ('faults', 'restarts', 'writes', 'most'),
    [
        (1, 0, 1, math.inf),
        (0, 1, 1, 20_000),
        (0, 0, 2, 10_000),
        pytest.param(0, 1, 1, 300_000, marks=pytest.mark.long),
        pytest.param(0, 0, 2, 300_000, marks=pytest.mark.long),
        pytest.param(2, 1, 2, 300_000, marks=pytest.mark.long),
    ],
)
def test_no_state_and_no_event_breaks_an_invariant(connected, faults, restarts, writes, most):
    connected.faults, connected.restarts, connected.writes = faults, restarts, writes
    met, seen, left = explore(connected, most)
    assert seen > 5000
    assert most < math.inf or left == 0
    if faults:  # whatever can happen in a state has happened in it
        events = {'tick', 'report', 'arrives_up', 'arrives_down', 'lost'}
        assert {(s, e) for s in State for e in events} <= {(s, m[0]) for s, *m in met}
        assert (State.ON_TRIAL, 'ask', 'confirm') in met
        assert {(s, 'ask', 'revert') for s in (*protocol.WRITING, State.ON_TRIAL)} <= met
        assert {s for s, *m in met if m[0] == 'write'} == {State.READY}


def test_the_walk_finds_a_late_write_that_goes_straight_into_force(connected, monkeypatch):
    def straight(store, name, value):
        (store.active if store._copy is None else store._copy)[name] = value

    monkeypatch.setattr(GainStore, 'write', straight)
    connected.restarts = 0
    with pytest.raises(AssertionError, match='a mixture of sets is in force'):
        explore(connected, math.inf)


# One conversation after the other, told by name.

SET = {A: 1.5, B: 0.1}
WRITTEN = {name: float32(value) for name, value in SET.items()}


def label(frame):
    """`OPEN`, `COMMIT`, or the name of a parameter."""
    if isinstance(frame, GainsCommand):
        return GainsAction(frame.action).name
    return getattr(frame, 'name', '')


def lost(what, times=99, how=DROPPED):
    return Fault(lambda frame: label(frame) == what, how, times=times)


class Talk:
    """A protocol and a flight controller, 10 ms after 10 ms; `up` and `deaf` lose frames."""

    def __init__(self, **options):
        self.far, self.now_s = FlightController(parameters=OLD, **options), 0.0
        self.bridge, self.events = GainProtocol(), []
        self.up = self.deaf = lambda frame: [frame]

    def until(self, *whats, seconds=30.0):
        """Talk until one of these has happened; the event."""
        for _ in range(round(100 * seconds)):
            self.now_s += 0.01
            frame = self.bridge.poll(self.now_s)
            for arrived in self.up(frame) if frame is not None else []:
                for reply in self.far.answer(arrived, round(1e9 * self.now_s)):
                    if self.deaf(arrived):
                        self.bridge.take(reply, self.now_s)
            events, self.bridge.events = self.bridge.events, []
            self.events += events
            for event in events:
                if event.what in whats:
                    return event
        raise AssertionError(f'never {whats}: {self.events}')

    def state(self):
        self.bridge.take(self.far.store.state(), self.now_s)


@pytest.fixture
def talk():
    made = Talk()
    made.bridge.take(ParamValue(B, 9.0, 2, 2), 0.0)  # an echo that nobody has asked for
    event = made.until(What.READ, seconds=protocol.READ_S)
    assert event.active == {'roll.rate.kp': 1.0, 'roll.rate.ki': 2.0}
    made.far.heard.clear()
    return made


def test_all_are_written_and_take_effect_together_and_stay_when_confirmed(talk):
    versions, write = [], talk.far.store.write
    talk.far.store.write = lambda *a: (write(*a), versions.append(dict(talk.far.store.active)))
    talk.far.store._number = 255  # by an earlier bridge; after it they begin anew, at 1
    talk.state()
    talk.bridge.write(SET, 9000)
    with pytest.raises(RefusedError, match='busy: opening'):
        talk.bridge.write(SET, 9000)
    event = talk.until(What.COMMITTED)
    assert event.active['roll.rate.ki'] == float32(0.1)
    assert versions == [OLD, OLD]  # nothing is in force while it is written
    assert talk.far.store.active == WRITTEN
    assert talk.far.store.phase is GainsPhase.WATCH
    assert [label(x) for x in talk.far.heard] == ['OPEN', A, B, 'COMMIT', A, B]
    assert talk.far.heard[0].transaction == 1
    talk.bridge.confirm()
    assert talk.until(What.CONFIRMED).active == event.active
    talk.far.store.tick(99.0)
    assert talk.far.store.active == WRITTEN


@pytest.mark.parametrize(
    ('way', 'what', 'how'),
    [
        *product(('up', 'deaf'), ('OPEN', B, 'COMMIT'), (DROPPED,)),
        ('up', B, changed(value=lambda x: 1.07 * x.value)),
    ],
)
def test_three_faults_of_any_frame_do_no_harm(talk, way, what, how):
    fault = lost(what, 3, how)
    setattr(talk, way, fault)
    talk.bridge.write(SET, 9000)
    talk.until(What.COMMITTED)
    assert talk.far.store.active == WRITTEN
    assert fault.times == 0


def spoilt(spoil):
    """What `spoil` does to the flight controller when the set is to be committed."""

    def fault(talk):
        def pass_on(frame):
            if label(frame) == 'COMMIT':
                spoil(talk.far)
            return [frame]

        talk.up = pass_on

    return fault


def unanswered(way, what):
    """Four losses of a frame, or of the answer to it."""

    def fault(talk):
        by_name = isinstance(what, str)
        setattr(talk, way, lost(what, 4) if by_name else Fault(what, DROPPED, times=4))

    return fault


@pytest.mark.parametrize(
    ('fault', 'reason'),
    [
        (unanswered('up', 'OPEN'), 'no answer to 4 tries while opening'),
        (unanswered('up', B), f'{B}: no answer to 4 tries while writing'),
        (unanswered('up', 'COMMIT'), 'no answer to 4 tries while committing'),
        (unanswered('deaf', 'COMMIT'), 'no answer to 4 tries while committing'),
        (unanswered('up', lambda x: isinstance(x, ParamRequestRead) and x.name == B),
         f'{B}: no answer to 4 tries while reading back'),
        (lambda talk: setattr(talk.far, 'refuses', [B]), f'{B}: the STM32 kept 2 instead of 0.1'),
        # a stray write that nobody read back
        (spoilt(lambda far: far.store.write(B, 7.0)), 'the STM32 refused the set: checksum'),
        (spoilt(lambda far: far.reports.update({B: 7.0})),
         f'{B}: the STM32 kept 7 instead of 0.1'),
    ],
)  # fmt: skip
def test_what_goes_wrong_with_a_set_leaves_the_old_one(talk, fault, reason):
    fault(talk)
    talk.bridge.write(SET, 9000)
    assert talk.until(What.FAILED).reason == reason
    assert (talk.far.store.active, talk.far.store.phase) == (OLD, GainsPhase.IDLE)


@pytest.mark.parametrize('told', [True, False])
def test_a_confirmation_after_the_stm32_has_gone_back_is_none(talk, told):
    talk.bridge.write(SET, 1000)
    talk.until(What.COMMITTED)
    state = talk.far.store.tick(talk.now_s + 1.5)  # not confirmed in time
    if told:
        talk.bridge.take(state, talk.now_s)
    talk.bridge.confirm()
    event = talk.until(What.REVERTED)
    assert event.by_stm32 is told
    assert talk.far.store.active == OLD
    assert talk.until(What.READ).active['roll.rate.kp'] == 1.0


@pytest.mark.parametrize('change', ['set', 'copy'])
def test_what_somebody_else_has_changed_is_read_again_and_an_open_copy_is_not_taken_for_it(
    talk, change
):
    if change == 'set':
        talk.far.store.active[B] = 7.0
        talk.state()
        assert talk.bridge.active == {}
    else:
        talk.far.store.take(GainsCommand(int(GainsAction.OPEN), 9), talk.now_s)
        talk.far.store.write(B, 7.0)
        talk.bridge = GainProtocol()  # another bridge
        talk.until(What.REVERTED)
    wanted = 7.0 if change == 'set' else 2.0
    assert talk.until(What.READ).active['roll.rate.ki'] == wanted


def test_unknown_names_are_refused_before_anything_is_sent(talk):
    with pytest.raises(RefusedError, match='X'):
        talk.bridge.write({B: 1.0, 'X': 1.0}, 1)
    with pytest.raises(RefusedError, match='busy: reading'):
        GainProtocol().write({A: 1.0}, 0)
    talk.now_s += 1.0
    assert talk.bridge.poll(talk.now_s) is None
