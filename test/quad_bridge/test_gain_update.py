"""An update of the gains, every state × every event: what is not gated whole never flies.

`Walk` drives the real update machine and protocol against the STM32's own store; watch and pulses
are stand-ins that speak when the walk says so. In every state that can be reached:

1. What the STM32 flies is a set that the gate has let through whole, inside its bounds, by no more
   than the largest step from the set before (or one that flew well), with the polarity of its axis
   known.
2. An update is refused in every state but IDLE, and a NaN in all. Its next step waits for the end
   of an excitation.
3. Alarmed, gestured at or asked back, a set in flight goes back; it is not confirmed. Killed, in
   failsafe, or disarmed after it was in force armed, it goes back also while it is confirmed,
   unless the STM32 has confirmed it by then. The gesture, and who asks back, end a check of the
   polarity too, and drop what waits for it.
4. What is published as active is what the STM32 flies, as long as nothing else has happened.
5. Nothing is good that has not flown well: what the STM32 confirms has flown for the watch's time
   since it was in force, without an alarm. Nothing is asked for without a fresh stamp.
6. Left alone in flight, the machine comes to IDLE within the time of an update; on the ground a
   set stays on trial.
"""

import json
import math
import re
import threading
from dataclasses import replace

import pytest
from flight_controller import STILL, ZERO, Store, clone, explore

from quad_bridge.errors import RefusedError
from quad_bridge.gains import gate, history, protocol, update
from quad_bridge.gains.cycles import Gesture
from quad_bridge.gains.history import History, Worker
from quad_bridge.gains.protocol import State as Protocol
from quad_bridge.gains.table import DEFAULT_BOUNDS
from quad_bridge.gains.update import GainSettings, GainUpdates, State
from quad_bridge.gains.watch import GainWatch
from quad_bridge.wire import frames as f

KP = 'ROLL_RATE_KP'
BOUND = DEFAULT_BOUNDS['roll.rate.kp']
NOW_US, STEP_S, OLDEST_S = 10_000_000, 1.0, 2.5
HELD = object()


class Watch:
    """A watch that alarms when it is told to."""

    def __init__(self):
        self.bad = self.begun = False

    good, climbs, before, known = False, False, [], None
    step = restart = know = staticmethod(lambda *_: None)

    def begin(self, *_):
        self.begun = True

    def end(self):
        self.begun = self.bad = False

    def alarm(self):
        return 'roll: shakes' if self.begun and self.bad else None

    def figures(self):
        return {}


class Pulses:
    """Pulses that answer in the second cycle."""

    def __init__(self):
        self.left, self.known, self.trouble, self.record = 0, False, '', {}
        self.rate_hz = 250.0

    running = property(lambda self: self.left > 0)
    refuse_faults = load = staticmethod(lambda *_: None)

    def unchecked(self, _):
        return [] if self.known else ['roll']

    def faults(self):
        return []

    def words(self):
        return 'roll correct'

    def start(self, _):
        self.left, self.trouble = 2, ''

    def abort(self, trouble):
        self.left, self.trouble = 0, trouble

    def step(self, frame):
        self.left -= 1
        if not frame.flags & f.Flag.ARMED:
            self.abort('stopped: disarmed')
        elif not self.left:
            self.known = True
        return f.Excitation(ZERO, 0, 0)


def cycle(flags):
    return replace(STILL, flags=int(flags))


class Walk:
    """Time stands still; what waits for a time moves towards it."""

    def __init__(self, tmp_path):
        self.gains = GainUpdates(GainSettings(), History(tmp_path, lambda _: None))
        self.gains.watch, self.gains.polarity = Watch(), Pulses()
        self.stm32 = Store.begun({KP: 0.1})
        self.gains.protocol.gated = frozenset({0.1})
        self.asks, self.faults = 2, 1
        self.armed = False  # while a set of the update in flight was in force
        self.good, self.seen_s = self.flown('good'), 0.0  # flight seen of what is on trial
        for _ in range(20):
            self.exchange()
        self.cycle(f.Flag.ARMED)
        self.gains.notes.clear()

    state = property(lambda self: self.gains.state)

    def copy(self):
        new = clone(self)
        new.stm32, new.gains = clone(self.stm32), clone(self.gains)
        g = new.gains
        g.protocol, g.watch, g.polarity = clone(g.protocol), clone(g.watch), clone(g.polarity)
        g._update, g._cycles = g._update and clone(g._update), clone(g._cycles)
        g._gesture = clone(g._gesture)
        g._gesture.ends = g._gesture.ends.copy()
        return new

    def flown(self, which='active'):
        (value,) = self.stm32.of([KP], which)
        return value

    def key(self):
        g, s, p, c = self.gains, self.stm32, self.gains.protocol, self.gains._cycles
        flight = g._update and (g._update.written, str(g._update.steps), g._update.armed)
        return (
            g.state, flight, bool(g._pending), c.flags, c.arrived_s, c.excited_s > -0.5,
            g.state is State.WATCHING and g._remaining_s, c.flying, g.watch.bad, g.watch.begun,
            g.polarity.left, g.polarity.known, p.state, p._tries, p._due_s, p._number % 4,
            tuple(p._queue), len(p._values), p._values.get(KP), self.flown(), self.flown('good'),
            s.staging and self.flown('copy'), s.watching and (s.flown_us, s.heard_us), self.asks,
            self.faults, self.armed, p._late, self.seen_s)

    # Events.

    def exchange(self, *, lost=False):
        frame = self.gains.poll(0.0)
        if frame is not None and not lost:
            for answer in self.stm32.answers(frame, NOW_US):
                self.gains.take(answer, 0.0)

    def lose(self):
        self.faults -= 1
        self.exchange(lost=True)

    def cycle(self, flags):
        before, armed = self.gains.state, flags & f.Flag.ARMED
        if before is State.WATCHING and armed:
            self.seen_s = min(self.seen_s - min(self.gains._cycles.arrived_s, 0.0), 2.0)
        self.gains.cycle(cycle(flags), 0.0)
        if flags & (f.Flag.RC_KILL | f.Flag.RC_FAILSAFE) or (self.armed and not armed):
            self.goes_back(before, STOPPED_IN)

    def alarm(self):
        before = self.gains.state
        self.gains.watch.bad = True
        begun = self.gains.watch.begun
        self.gains.cycle(cycle(f.Flag.ARMED), 0.0)
        if begun:
            self.goes_back(before)

    def gesture(self):
        before = self.gains.state
        for end, at_s in ((1.0, -4.2), (-1.0, -2.1), (1.0, 0.0)):
            self.gains.sticks(end, at_s)
        assert self.gains.state is before  # too slow
        for end in (-1.0, 1.0):
            self.gains.sticks(end, 0.0)
        self.goes_back(before)
        assert self.gains.state is not State.CHECKING

    def ends(self):
        before = self.gains.state
        self.gains.end('the node was deactivated')
        self.goes_back(before)

    def goes_back(self, before, within=(State.WRITING, State.WATCHING)):
        if before in within:
            assert self.gains.state is State.REVERTING

    def tick(self, *, excited=False):
        g, s = self.gains, self.stm32
        for part, name in (
            (g._cycles, 'arrived_s'), (g._cycles, 'excited_s'), (g.protocol, '_due_s'),
        ):  # fmt: skip
            setattr(part, name, max(getattr(part, name) - STEP_S, -OLDEST_S))
        s.pass_by(STEP_S, NOW_US)
        g._gesture.ends.clear()
        if excited:
            self.cycle(f.Flag.ARMED | f.Flag.EXCITATION)
        before, told = g.state, s.tick(NOW_US, flying=bool(g._cycles.flags & f.Flag.ARMED))
        if told is not None:
            g.take(told, 0.0)
        g.tick(0.0)
        if excited and before is not State.WRITING:  # the next step waits
            assert g.state is not State.WRITING

    def ask(self, value, age_s=0.0, **more):
        before, refusals = self.gains.state, self.gains.refusals
        gains = {'roll.rate.kp': value} if value is not HELD else {}
        try:
            self.gains.ask({**gains, 'source': 'test', **more}, 0.0, age_s=age_s)
        except RefusedError:
            assert self.gains.state is before
            assert self.gains.refusals == refusals + 1
        else:
            assert -0.1 <= age_s <= 0.5
            if more.get('rollback'):
                dropped = before is State.CHECKING
                assert self.gains.state is (State.IDLE if dropped else State.REVERTING)
                assert self.gains._pending is None
            else:
                assert before is State.IDLE
                assert math.isfinite(value)
                self.asks -= 1

    def restarts(self):
        self.faults -= 1
        self.stm32, before = self.stm32.restarted(), self.gains.state
        self.gains.restarted()
        assert self.gains.state is not State.CHECKING  # another one would get its pulses
        if before in {*STOPPED_IN, State.REVERTING}:  # all that is known, whatever was in force
            assert 'link lost: which gains are in force is read' in self.gains.refused

    def moves(self):
        armed, g = f.Flag.ARMED, self.gains
        found = {
            'answer': Walk.exchange, 'cycle': lambda w: w.cycle(armed),
            'killed': lambda w: w.cycle(f.Flag.RC_KILL),
            'failsafe': lambda w: w.cycle(armed | f.Flag.RC_FAILSAFE),
            'excited': lambda w: w.tick(excited=True), 'disarmed': lambda w: w.cycle(f.Flag.NONE),
            'alarm': Walk.alarm, 'gesture': Walk.gesture, 'tick': Walk.tick, 'ends': Walk.ends,
            'nan': lambda w: w.ask(math.nan), 'back': lambda w: w.ask(HELD, rollback=True),
            'late': lambda w: w.ask(0.15, 0.6),
            'ahead': lambda w: w.ask(HELD, -0.2, rollback=True),
            'disturb': lambda w: w.gains.disturb()}
        if self.asks or g.state is not State.IDLE:
            found |= {'ask': lambda w: w.ask(0.15), 'ask far': lambda w: w.ask(0.3)}
        if self.faults:
            found |= {'lost': Walk.lose, 'restart': Walk.restarts}
        return found

    def check(self):
        g, flown = self.gains, self.flown()
        in_force = bool(g._update and g._update.written)
        self.armed = in_force and (self.armed or bool(g._cycles.flags & f.Flag.ARMED))
        for item in g.notes:
            if item.active is not None:
                assert item.active['roll.rate.kp'] == flown
        g.notes.clear()
        assert any(abs(flown - gated) < 1e-6 for gated in g.protocol.gated), 'never gated'
        if self.flown('good') != self.good:
            self.good = self.flown('good')
            assert self.seen_s >= update.WATCH_S, 'good without a good flight'
        if g.state is not State.WATCHING and g.state is not State.CONFIRMING:
            self.seen_s = 0.0
        assert flown == self.flown('good') or g.polarity.known
        if g.state is State.IDLE:
            assert g._update is None
            assert g.protocol.state not in {*PROTOCOL_BUSY, Protocol.ON_TRIAL}
        if g.state is State.WATCHING:
            assert g.protocol.state in {Protocol.ON_TRIAL, Protocol.REVERTING}

    def comes_to_rest(self):
        for _ in range(60):
            for _ in range(8):
                self.exchange()
            self.cycle(f.Flag.ARMED)
            self.tick()
        assert self.state is State.IDLE
        assert self.gains.active['roll.rate.kp'] == self.flown() == self.flown('good')


STOPPED_IN = (State.WRITING, State.WATCHING, State.CONFIRMING)
PROTOCOL_BUSY = (Protocol.OPENING, Protocol.STAGING, Protocol.COMMITTING, Protocol.VERIFYING)


@pytest.mark.parametrize('most', [6000, pytest.param(100_000, marks=pytest.mark.long)])
def test_no_state_and_no_event_lets_an_ungated_set_fly(tmp_path, monkeypatch, most):
    walk = Walk(tmp_path)
    write = type(walk.gains.protocol).write

    def gated(machine, writes, watch_ms):
        (value,) = writes.values()
        now = machine._values[KP]
        assert BOUND.lower <= value <= BOUND.upper
        assert max(value / now, now / value) <= BOUND.max_factor
        machine.gated |= {value}  # in this walk's past
        write(machine, writes, watch_ms)

    monkeypatch.setattr(type(walk.gains.protocol), 'write', gated)
    for module, short in (
        (protocol, {'TRIES': 2, 'SAFETY_TRIES': 3}),
        (update, {'STEP_WATCH_S': 1.0, 'WATCH_S': 2.0, 'STM32_WATCH_MS': 4000}),
    ):  # fewer states
        for name, value in short.items():
            monkeypatch.setattr(module, name, value)
    met, _, _ = explore(walk, most, rest_every=40)
    assert met >= {(state, name) for state in State for name in Walk(tmp_path).moves()}


# One update after the other, told by name.


class Bench:
    """An aircraft that lies still, 20 ms after 20 ms, with these `flags` and `throttle`.

    In flight it rolls with a rate of `shakes` rad/s at 12 rad/s.
    """

    def __init__(self, folder, rate_hz=50.0, **settings):
        self.period_s, self.shakes = 1.0 / rate_hz, 0.0
        self.folder, self.history = folder, History(folder, lambda job: job())
        self.gains = GainUpdates(GainSettings(polarity='off', **settings), self.history)
        self.gains.watch, self.stm32 = Watch(), Store.begun({KP: 0.1})
        self.now_s, self.flags, self.throttle = 1.0, f.Flag.NONE, 0.5
        self.number, self.executor_late = 7, False
        self.until('read back')

    def goes_on(self, seconds=20.0):
        g = self.gains
        for _ in range(round(seconds / self.period_s)):
            self.now_s += self.period_s
            control, armed = (self.throttle, 0.0, 0.0, 0.0), bool(self.flags & f.Flag.ARMED)
            turns = armed * self.shakes * math.sin(12.0 * self.now_s)
            time_us = round(1e6 * self.now_s)
            g.cycle(replace(cycle(self.flags), control=control, gyro=(turns, 0.0, 0.0),
                            time_us=time_us), self.now_s)
            self.stm32.hears(time_us)
            told = self.stm32.tick(time_us, flying=armed and self.throttle > 0.05)
            if told is not None:
                g.take(told, self.now_s)
            frame = g.poll(self.now_s)
            if frame is not None:
                for answer in self.stm32.answers(frame, round(1e6 * self.now_s)):
                    own = isinstance(answer, f.GainsState)
                    g.take(replace(answer, aircraft=self.number) if own else answer, self.now_s)
            record = None if self.executor_late else self.history.open(g.aircraft)
            if record is not None and not self.history.leave(g.aircraft):
                g.know(record)
            g.tick(self.now_s)
            new, g.notes = g.notes, []
            yield from (item.text for item in new)

    def until(self, said):
        """Let time go by until a line of news holds `said`; the line."""
        return next(text for text in self.goes_on() if said in text)

    @property
    def stored(self):
        (path,) = self.folder.rglob('gains.jsonl')
        return json.loads(path.read_text().splitlines()[-1])


def test_gains_stay_on_trial_on_the_ground_and_are_good_after_ten_seconds_of_flight(tmp_path):
    bench, told = Bench(tmp_path, sources=('test', 'design*')), []
    found = bench.stored
    assert (found['reason'], found['gains']['roll.rate.kp']) == (
        'read from the aircraft', pytest.approx(0.1),
    )  # fmt: skip
    asked = {'roll.rate.kp': 0.15, 'source': 'designer', 'model': 'model.json',
             'aircraft': bench.gains.aircraft}  # fmt: skip
    bench.gains.ask(asked, bench.now_s, lambda *x: told.append(x))
    assert not told
    assert not any('confirmed' in text for text in bench.goes_on(40.0))
    active = bench.stored
    assert (active['source'], active['model'], active['gains']['roll.rate.kp']) == (
        'designer', 'model.json', pytest.approx(0.15),
    )  # fmt: skip
    assert told == [(True, '')]  # read back, and no more
    assert 'on trial on the ground' in bench.gains.status().message
    bench.flags, bench.throttle = f.Flag.ARMED, 0.0  # the motors turn, but do not control
    assert not any('confirmed' in text for text in bench.goes_on())
    assert bench.stm32.of([KP], 'good') == pytest.approx((0.1,))
    bench.throttle = 0.5
    begin_s = bench.now_s
    bench.until('confirmed: they flew well')
    assert bench.now_s - begin_s == pytest.approx(10.0, abs=0.3)
    assert (bench.stored['state'], bench.stored['flown']) == ('confirmed', True)
    assert bench.stored['update'] == active['update']
    assert bench.stm32.of([KP], 'good') == pytest.approx((0.15,))


def test_on_the_ground_the_next_step_waits_for_flight_and_who_asked_is_told(tmp_path):
    bench, told = Bench(tmp_path), []
    bench.gains.ask({'roll.rate.kp': 0.29}, bench.now_s, lambda *x: told.append(x))
    assert not any('step 2' in text for text in bench.goes_on(20.0))
    ((done, words),) = told
    assert (done, 'step 1 of 2' in words, 'after 3 s of flight' in words) == (True, True, True)
    bench.flags = f.Flag.ARMED
    bench.until('step 2 of 2')


def test_a_rollback_to_what_flew_well_is_one_step_and_any_other_goes_by_steps(
    tmp_path, monkeypatch
):
    bench = Bench(tmp_path)
    bench.flags = f.Flag.ARMED
    for value, steps in ((0.12, 1), (0.45, 2)):
        bench.gains.ask({'roll.rate.kp': value}, bench.now_s)
        bench.until(f'step {steps} of {steps}')
        bench.until('confirmed')
    for value, more, steps in (
        (0.12, {}, 2), (0.119, {'rollback': True}, 2), (0.12, {'rollback': True}, 1),
    ):  # fmt: skip
        words = bench.gains.ask({'roll.rate.kp': value, **more}, bench.now_s)
        assert f'in {steps} steps' in words
        bench.until('in force')
        if steps > 1:
            bench.gains.ask({'rollback': True}, bench.now_s)
            bench.until('read back')
    assert bench.stm32.of([KP]) == pytest.approx((0.12,))
    bench.until('confirmed')
    bench.gains.protocol.whole_sets = False  # as of PX4, where gains of both would mix
    list(bench.goes_on(1.0))
    back = {'roll.rate.kp': 0.45, 'rollback': True}
    news = {'roll.rate.kp': 0.2, 'rollback': True}  # which only a craft that takes gains gets
    assert [bench.gains.takes_back(it) for it in (back, {'rollback': True}, news)] == [1, 1, 0]
    assert 'in 2 steps' in bench.gains.ask(back, bench.now_s)
    bench.until('in force')
    assert bench.gains.takes_back(news)
    bench.until('confirmed')
    monkeypatch.setattr(gate, 'MAX_STEPS', 1)  # however many steps it would be
    with pytest.raises(RefusedError, match='more than 1 steps'):
        bench.gains.ask({**back, 'roll.rate.kp': 0.12}, bench.now_s)
    bench.gains.protocol.whole_sets = True
    # also where it has to wait for the check of an axis
    monkeypatch.setattr(bench.gains.polarity, 'unchecked', lambda _: ['roll'])
    monkeypatch.setattr(bench.gains, '_start_check', lambda *_: None)
    bench.gains.ask({**back, 'roll.rate.kp': 0.12}, bench.now_s)
    monkeypatch.setattr(bench.gains.polarity, 'unchecked', lambda _: [])
    bench.gains._after_check(*bench.gains._pending, '')
    bench.until('step 1 of 1')


def test_gains_that_another_program_has_set_are_watched_anew(tmp_path):
    bench, anew = Bench(tmp_path), []
    gains = bench.gains
    gains.watch.restart = lambda: anew.append(1)
    for value, times in ((0.1, 0), (0.3, 1), (0.3, 1)):
        active = {**gains.active, 'roll.rate.kp': value} if value != 0.1 else gains.active
        gains.protocol.active = active
        gains.protocol.events.append(protocol.GainEvent(protocol.What.READ, active=active))
        gains._take_events()
        assert len(anew) == times


def test_the_next_flight_is_held_to_the_last_good_one(tmp_path):
    """0.6 rad/s at 12 rad/s: a sound aircraft may, one that has flown with 0.05 may not."""
    for calm in (False, True):
        bench = Bench(tmp_path / str(calm))
        bench.gains.watch = GainWatch(50.0)
        if calm:
            bench.flags, bench.shakes = f.Flag.ARMED, 0.05
            assert not list(bench.goes_on(13.0))
            assert bench.stored['state'] == 'flown'
        again = Bench(tmp_path / str(calm))  # another bridge
        again.gains.watch = GainWatch(50.0)
        again.gains.watch.know(again.history.stored('flight.json').get('flight'))
        again.gains.ask({'roll.rate.kp': 0.15, 'source': 'test'}, again.now_s)
        assert any('in force' in text for text in again.goes_on(2.0))
        again.flags, again.shakes = f.Flag.ARMED, 0.6
        assert any('rolled back' in text for text in again.goes_on(13.0)) is calm


BAD_UPDATES = [
    ({'roll.rate.kp': 'fast'}, r'roll\.rate\.kp: must be a number'),
    ({'roll.rate.kp': None}, 'must be a number'),
    ({'source': 'a stranger'}, 'source is not allowed'),
    ({'aircraft': 'A'}, 'aircraft A: connected is'),
    ({'predicted': '{"roll.peak": NaN}'}, 'roll.peak must be finite'),
    ({'predicted': '{"roll.colour": 1}'}, 'roll.colour is not known'),
    ({'flown': '{"roll.rate.kp": 0.105}'}, 'began from 0.105, and the aircraft has 0.1'),
    ({'rollback': 'false'}, "rollback: must be true or false: found 'false'"),
    ({'model': 3.0}, r'model: must be a text: found 3\.0'),
    ({'predicted': 'good'}, 'predicted: must be a JSON object'),
    ({'predicted': '{"roll.peak": "high"}'}, 'must be a JSON object of numbers: roll.peak'),
    ({'predicted': '[' * 200_000}, 'at most: found 200000'),
    ({'predicted': f'{{"roll.peak": {10**400}}}'}, 'too large a number'),
    ({'model': '\x1b[2J\nevil'}, 'model: must be printable'),
]


def test_bad_updates_are_refused_and_change_nothing(tmp_path):
    bench = Bench(tmp_path, sources=('test', 'designer*'))
    for asked, words in BAD_UPDATES:
        with pytest.raises(RefusedError, match=words):
            bench.gains.ask({'roll.rate.kp': 0.15, 'source': 'test', **asked}, bench.now_s)
        assert re.search(words, bench.gains.refused)
        assert len(bench.gains.refused) < 300
    assert not any('in force' in text for text in bench.goes_on(1.0))
    assert bench.stm32.of([KP]) == pytest.approx((0.1,))


@pytest.mark.parametrize(('rate_hz', 'flags', 'words'), [
    (50.0, f.Flag.RC_KILL, "the pilot's kill switch"),
    (50.0, f.Flag.RC_FAILSAFE, 'failsafe is on'),
    (35.0, f.Flag.NONE, 'the link brings 35 cycles/s: the watch needs 50'),
])
def test_nothing_is_taken_without_a_pilot_or_enough_cycles(tmp_path, rate_hz, flags, words):
    bench = Bench(tmp_path, rate_hz=rate_hz)
    bench.flags = flags
    assert not [*bench.goes_on(12.0)]
    with pytest.raises(RefusedError, match=words):
        bench.gains.ask({'roll.rate.kp': 0.15}, bench.now_s)


@pytest.mark.parametrize('flags', [f.Flag.ARMED, f.Flag.ARMED | f.Flag.HOLD])
def test_climb_gains_fly_in_the_height_mode_only(tmp_path, flags):
    bench = Bench(tmp_path)
    bench.gains.ask({'roll.rate.kp': 0.15}, bench.now_s)
    bench.gains.watch.climbs, bench.flags = True, flags
    assert any('confirmed: they' in text for text in bench.goes_on(12.0)) is (
        f.Flag.HOLD in flags)


def test_what_the_watch_is_told_of_axes_excitation_and_flight(tmp_path):
    bench, axes, injected, anew = Bench(tmp_path), [], [], []
    gains, watch = bench.gains, bench.gains.watch
    watch.begin, watch.restart = lambda *a: axes.append(a[1]), lambda: anew.append(1)
    watch.step = lambda *a: injected.append(tuple(a[3]))
    for common in ((), {'roll.rate.kp'}):  # of all axes, as the D filter of PX4
        gains.protocol.in_common = frozenset(common)
        gains.ask({'roll.rate.kp': 0.15}, bench.now_s)
        gains.ask({'rollback': True}, bench.now_s)
        [*bench.goes_on(1.0)]
    assert axes == [{'roll'}, {'roll', 'pitch', 'yaw'}]
    excited = replace(cycle(f.Flag.ARMED), control=(0.5, 0.0, 0.0, 0.0),
                      excitation=(0.05, 0.0, 0.0), injection=int(f.Injection.CONTROL))
    gains.cycle(excited, bench.now_s)
    assert injected[-1] == pytest.approx((0.5, 0.0, 0.0))  # rad/s, by rate.kp of 0.1
    gains.cycle(cycle(f.Flag.NONE), bench.now_s)
    assert anew == [1, 1]  # it took off, and has landed
    gains.protocol.active = {**gains.active, 'climb.rate.kp': 0.2}
    gains._good = [dict(gains.active)]
    assert gains._has_flown({'roll.rate.kp': 0.1})
    assert not gains._has_flown({'climb.rate.kp': 0.2})


@pytest.mark.parametrize(('end', 'counts'), [(0.75, False), (0.85, True)])
def test_the_pilots_gesture_is_from_end_to_end(end, counts):
    gesture = Gesture()
    assert [gesture.take(k * end, 0.3 * t) for t, k in enumerate((1, -1, 0, 1))][-1] is counts


def test_another_aircraft_on_the_port_writes_nothing_into_the_firsts_files(tmp_path):
    bench = Bench(tmp_path)
    (first,) = tmp_path.rglob('gains.jsonl')
    kept = first.read_text()
    bench.gains.polarity.load({'axes': {'roll': 'ok'}})
    bench.number, bench.executor_late, bench.stm32 = 8, True, Store.begun({KP: 0.3})
    bench.gains.restarted()
    bench.until('read back')
    assert bench.gains.aircraft != first.parent.name
    bench.gains.ask({'roll.rate.kp': 0.35, 'source': 'test'}, bench.now_s)
    bench.until('in force')
    assert bench.gains.polarity.record == {'axes': {}, 'motors': {}}
    bench.executor_late, bench.flags = False, f.Flag.ARMED
    bench.until('confirmed')
    assert first.read_text() == kept
    (second,) = set(tmp_path.rglob('gains.jsonl')) - {first}
    assert '"state": "confirmed"' in second.read_text()


def test_a_disk_that_takes_seconds_holds_up_nothing(tmp_path, monkeypatch):
    slow, begun = threading.Event(), threading.Event()
    monkeypatch.setattr(history.os, 'fsync', lambda _: begun.is_set() or hang())
    monkeypatch.setattr(history, 'CLOSE_S', 0.0)

    def hang():
        begun.set()
        slow.wait(60.0)

    def lines():
        return (tmp_path / 'one' / 'gains.jsonl').read_text().splitlines()

    worker = Worker()
    kept = History(tmp_path, worker)
    assert kept.open('one') == {}
    for k in range(3):  # the first one hangs in the disk
        kept.write('active', {'roll.rate.kp': 0.1 + k})
    assert begun.wait(60.0)
    worker.close()
    monkeypatch.setattr(history, 'CLOSE_S', 60.0)
    for k in range(2):  # activated again, the disk still hangs in the first
        kept.write('active', {'roll.rate.kp': 0.2 + k})
    worker.close()
    assert '"roll.rate.kp": 1.2' in lines()[-1]
    slow.set()
    for thread in threading.enumerate():
        if thread.name == 'gain history':
            thread.join(60.0)
    assert len(lines()) == 5
