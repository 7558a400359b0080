"""An update of the gains: gate, polarity, steps, watch and rollback, as one state machine. Pure.

What to do with a set; how it gets to the STM32 and what is proven of it is protocol.py's, what
cycles and sticks say is cycles.py's. Cycles, frames and ticks come in with their time (s on a
steady clock); what is to be published or logged waits in `notes`. The watch counts time in flight
only: a set is good once it has flown well.
The state diagram stands in docs/reference/gain_machines.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from quad_bridge.errors import QuadBridgeError, RefusedError
from quad_bridge.fresh import refuse_stale
from quad_bridge.gains import gate
from quad_bridge.gains.cycles import ARMED, LINK_S, MAX_HZ, MIN_HZ, QUIET_S, Cycles, Gesture
from quad_bridge.gains.history import FLIGHT, TRIAL, History
from quad_bridge.gains.polarity import PolarityCheck, Push
from quad_bridge.gains.protocol import GainEvent, GainProtocol, Request, What
from quad_bridge.gains.table import AXES, DEFAULT_BOUNDS, Bound
from quad_bridge.gains.watch import GainWatch
from quad_bridge.status import ERROR, OK, WARN, Status
from quad_bridge.wire import frames as f
from quad_bridge.wire.axes import flip_attitude, flip_body, upwards

STEP_WATCH_S, WATCH_S = 3.0, 10.0  # between the steps of a larger change, and after the last
STM32_WATCH_MS = 15_000
"""Time after which the STM32 reverts an unconfirmed set: the watch, and time to confirm."""
LOOK_S = 1.0  # interval at which the gains in force are judged


class State(Enum):
    """State of the gains."""

    IDLE = 'read back'
    CHECKING = 'checking polarity'
    WRITING = 'writing'
    WATCHING = 'watching'
    CONFIRMING = 'confirming'
    REVERTING = 'taking back'


IN_FLIGHT = (State.WRITING, State.WATCHING, State.CONFIRMING)
"""States of an update that the pilot ends by switch or by disarming."""
ON_TRIAL = (State.WATCHING, State.WRITING)


@dataclass(frozen=True)
class GainSettings:
    """The configuration."""

    bounds: Mapping[str, Bound] = field(default_factory=lambda: DEFAULT_BOUNDS)
    sources: Sequence[str] = ('*',)
    polarity: str = 'auto'
    aircraft: str = ''  # name of the folder of its files; empty: the STM32's unique number
    folder: Path = Path()


@dataclass(frozen=True)
class Note:
    """One event: a line, and the active gains where they are now known."""

    text: str
    fault: bool = False
    active: Mapping[str, float] | None = None


Reply = Callable[[bool, str], None]
"""A callback, called once: whether the aircraft has read a set back, and why not or which step."""


@dataclass
class _Update:
    """The update in flight."""

    request: gate.GainRequest
    steps: list[dict[str, float]]
    identity: str
    reply: Reply | None = None
    written: int = 0
    armed: bool = False  # at any time since the first step was in force

    def tell(self, reason: str = '', *, done: bool = False) -> None:
        """Answer who waits, once: it is read back (`reason`: how far), or why it is not."""
        reply, self.reply = self.reply, None
        if reply is not None:
            reply(done, reason)


class GainUpdates:
    """See the module. `ask` and `check` raise RefusedError, the rest never."""

    def __init__(self, settings: GainSettings, history: History) -> None:
        """Begin with the protocol of this project's firmware; `use` sets another."""
        self.notes: list[Note] = []
        self.refused = ''
        """Why the last update was refused, failed or reverted; empty after a good one."""
        self.refusals = self.commits = self.rollbacks = 0
        self.state = State.IDLE
        self._settings, self._history = settings, history
        self.use(GainProtocol())
        self.rate_hz = gate.USUAL_HZ
        self.watch = GainWatch(gate.USUAL_HZ)
        self.polarity = PolarityCheck(settings.polarity, gate.USUAL_HZ)
        self._cycles, self._gesture = Cycles(), Gesture()
        self._update: _Update | None = None
        self._pending: tuple[gate.GainRequest, Reply | None] | None = None
        """The update that waits for the check of its axes."""
        self._going_back: list[Reply] = []  # callers that wait for the earlier gains
        self._checked: Callable[[str], None] | None = None
        self._remaining_s = 0.0  # time of flight until the next step, or the confirmation
        self._checked_s = float('-inf')  # time of the last judgement
        self._flown = False  # the gains in force have flown well, and the history says so
        self._in_force: Mapping[str, float] = {}  # as last read back or written
        self._good: list[Mapping[str, float]] = []  # sets that have flown well under this bridge
        self._rate_kp = np.ones(3)

    def use(self, protocol: Any) -> None:
        """Use this protocol for the aircraft's sets of gains (aircraft.py, `Gains`).

        It may be of another aircraft: what is in flight ends, and files are opened by its name.
        """
        if self.state is not State.IDLE:
            self.restarted()
        self.protocol, self._good, self._flown = protocol, [], False
        protocol.keep = self._history.keep_trial
        self._history.leave('')

    @property
    def active(self) -> Mapping[str, float]:
        """Active gains and loop constants, contract names, SI; empty until they are read back."""
        active: Mapping[str, float] = self.protocol.active
        return active

    @property
    def aircraft(self) -> str:
        """Name of the folder of the aircraft's files; '' while it is not known."""
        return self._settings.aircraft or str(self.protocol.aircraft)

    @property
    def words(self) -> str:
        """The state in a few words."""
        if self.state is State.IDLE or self._update is None:
            return self.protocol.busy or self.state.value
        text = f'{self.state.value} gains of {self._update.request.source}'
        if self.state is not State.WATCHING:
            return text
        on_ground = '' if self._cycles.flying else ' (on trial on the ground)'
        return f'{text}, {max(self._remaining_s, 0.0):.0f} s of flight left{on_ground}'

    def status(self, cannot: str = '') -> Status:
        """For /diagnostics; `cannot`: why this aircraft takes no gains now."""
        values: dict[str, object] = {n: f'{v:.9g}' for n, v in self.active.items()}
        values['writes acknowledged'] = self.commits
        values['refused'] = self.refusals
        values['rolled back'] = self.rollbacks
        values['polarity'] = self.polarity.words()
        values['aircraft'] = self.aircraft
        values |= {f'watch {n} (rad/s)': f'{v:.3f}' for n, v in self.watch.figures().items()}
        if self.refused:
            return Status('gains', ERROR, self.refused, values)
        if cannot and self.state is State.IDLE:
            return Status('gains', WARN, f'refused: {cannot}', values)
        if self._history.fault:
            return Status('gains', WARN, self._history.fault, values)
        if self.state is State.IDLE and self.protocol.reading:
            words = 'the aircraft has not reported its parameters yet'
            return Status('gains', WARN, words, values)
        return Status('gains', OK, self.words, values)

    # Requests.

    def ask(
        self, parameters: Mapping[str, object], now_s: float, reply: Reply | None = None,
        *, age_s: float = 0.0,
    ) -> str:  # fmt: skip
        """Take on what a message or a service asks for; what happens next, in words.

        `age_s` is how long ago it was said, by its stamp. Raises RefusedError; the refusal is in
        `notes` too. Else `reply` is called with the outcome.
        """
        source = gate.shorten(str(parameters.get('source', 'unknown source')))
        try:
            refuse_stale(age_s)
            return self._request(gate.read_request(parameters), now_s, reply)
        except RefusedError as error:
            self._refuse(source, error)
            raise

    def _request(self, request: gate.GainRequest, now_s: float, reply: Reply | None) -> str:
        gate.check_source(request.source, self._settings.sources)
        if request.aircraft not in {'', self.aircraft}:
            raise RefusedError(
                f'these gains are for the aircraft {gate.shorten(request.aircraft)}: connected is '
                f'{self.aircraft or "none"}'
            )
        if request.rollback and self.state in ON_TRIAL:
            self._take_back(f'{request.source} asked for it')
            self._going_back += [reply] if reply is not None else []
            return 'taking back the gains on trial'
        if request.rollback and self.state is State.CHECKING:
            self.disturb('a rollback was asked for')  # which drops the gains that waited for it
            if not request.gains:
                if reply is not None:
                    reply(True, 'the check was stopped')
                return 'stopped the check, and dropped what waited for it'
        path = self._admit(request, now_s)
        self.polarity.refuse_faults()
        axes = self.polarity.unchecked(request.gains) if self.protocol.pulses else []
        words = ', '.join(axes)
        if axes and self._settings.polarity == 'manual':
            raise RefusedError(
                f'the polarity of {words} has not been checked on this aircraft: '
                'mount it free about that axis, arm it and call ~/check_polarity'
            )
        if axes:
            self._start_check(axes, now_s)
            self._pending = request, reply
            return f'checking the polarity of {words} before the first update'
        self._begin(request, path, reply)
        return f'writing {len(request.gains)} gains of {request.source} in {len(path)} steps'

    def takes_back(self, parameters: Mapping[str, object]) -> bool:
        """Whether a request ends a trial or goes back to what flew well, which may be at any time.

        Not one that calls a set of gains that nobody has flown a rollback.
        """
        gains = {name: value for name, value in parameters.items()
                 if name in self.active and isinstance(value, float)}
        return parameters.get('rollback') is True and (
            self.state in ON_TRIAL or not gains or self._flew_well(gains))

    def _has_flown(self, gains: Mapping[str, float]) -> bool:
        """Whether the active set with these gains has flown well, and is written as a whole."""
        climbs = any(name.startswith('climb.') for name in gains)  # which fly in one mode only
        return self.protocol.whole_sets and not climbs and self._flew_well(gains)

    def _flew_well(self, gains: Mapping[str, float]) -> bool:
        target = {**self.active, **gains}
        return any(
            target.keys() == good.keys()
            and all(math.isclose(target[n], value, rel_tol=1e-6) for n, value in good.items())
            for good in self._good
        )

    def _refuse(self, source: str, error: RefusedError) -> None:
        self.refusals += 1
        self._fault(f'gains of {source} refused: {error}')

    def check(self, now_s: float, reply: Callable[[str], None], *, motors: bool = False) -> None:
        """Fly the pulses about all axes, or of each motor; `reply` is called with the result."""
        if self.state is not State.IDLE:
            raise RefusedError(f'the gains are busy: {self.words}')
        self._start_check(() if motors else AXES, now_s)
        self._checked = reply

    def disturb(self, why: str = 'the excitation has started') -> None:
        """End a check, because somebody else excites or nobody may."""
        if self.state is State.CHECKING:
            self.polarity.abort(f'stopped: {why}')
            self._end_check()

    def _admit(self, request: gate.GainRequest, now_s: float) -> list[dict[str, float]]:
        gate.check_flown(request, self.active)
        # a rollback to what flew well goes at once: its steps would prolong what flies badly
        path = gate.steps(request.gains, self.active, self._settings.bounds,
                          at_once=request.rollback and self._has_flown(request.gains))
        if now_s - self._cycles.arrived_s > QUIET_S:
            raise RefusedError('the link is down: no control cycle in the last 0.5 s; '
                               '/diagnostics says why')
        if self.state is not State.IDLE:
            raise RefusedError(f'an earlier update is in flight: {self.words}')
        if self.protocol.busy:
            raise RefusedError(f'the parameters are busy: {self.protocol.busy}')
        if now_s - self._cycles.excited_s < QUIET_S:
            raise RefusedError('not while the excitation runs: send them when it is idle')
        gate.refuse_climb(request.gains, self._cycles.flags, flying=self._cycles.flying)
        if self._cycles.flags & (f.Flag.RC_KILL | f.Flag.RC_FAILSAFE):
            raise RefusedError("the pilot's kill switch or the receiver's failsafe is on")
        self._cycles.refuse_slow(self.rate_hz)
        if self._history.fault:
            self._history.note_active(self.active)  # is written again: the disk may be mended
        if self._history.fault:
            raise RefusedError(f'{self._history.fault}; mend that and send them again')
        return path

    def _begin(
        self, request: gate.GainRequest, path: list[dict[str, float]], reply: Reply | None
    ) -> None:
        update = _Update(request, path, self._history.identity(), reply)
        self._write_step(update)
        self._update, self.refused = update, ''
        # what flies from the commit on, seen some time before its answer, is not "before"
        touched = {name.partition('.')[0] for name in request.gains}
        if not touched <= set(AXES) or self.protocol.in_common & set(request.gains):
            touched |= set(AXES)
        self.watch.begin(request.predicted, touched)

    def _write_step(self, update: _Update) -> None:
        step = update.steps[update.written]
        names = self.protocol.names
        self.protocol.write({names.get(n, n): v for n, v in step.items()}, STM32_WATCH_MS)
        self.state = State.WRITING

    # Messages of the STM32.

    def know(self, record: Mapping[str, Any]) -> None:
        """Set the stored polarity record of the connected aircraft."""
        self._good = []
        self.polarity.load(record)
        self.watch.know(record.get(FLIGHT))
        self.protocol.recall(record.get(TRIAL, {}))
        self._take_events()
        self._history.note_active(self.active)

    def take(self, frame: f.ParamValue | f.GainsState, now_s: float) -> None:
        """Take an answer about parameters or sets."""
        self.protocol.take(frame, now_s)
        self._take_events()

    def poll(self, now_s: float) -> Request | None:
        """Frames to send now."""
        request: Request | None = self.protocol.poll(now_s)
        self._take_events()
        return request

    def restarted(self) -> None:
        """Handle a restart of the STM32, or another one."""
        self._good = []
        self.disturb('the aircraft has begun again')
        self.protocol.restart()
        self._take_events()

    def cycle(self, frame: f.Cycle, now_s: float) -> Push | None:
        """Take one control cycle; a pulse to send while the polarity is checked."""
        flew = self._cycles.flying
        since_s = self._cycles.take(frame, now_s, pulses=self.state is State.CHECKING)
        flies = self._cycles.flying
        if flies is not flew:
            self.watch.restart()
        if flies and self.state is State.WATCHING:  # climb gains fly in the height mode only
            counts = frame.flags & f.Flag.HOLD or not self.watch.climbs
            self._remaining_s -= min(since_s, LINK_S) if counts else 0.0
        injected: Any = (0.0, 0.0, 0.0)
        if frame.injection == f.Injection.RATE:
            injected = flip_body(frame.excitation)
        elif frame.injection == f.Injection.CONTROL:
            injected = flip_body(frame.excitation) / self._rate_kp
        if flies:
            attitude, reference = map(flip_attitude, (frame.attitude, frame.attitude_setpoint))
            self.watch.step(flip_body(frame.gyro), attitude, reference, injected,
                            upwards(frame.accel, frame.attitude))  # fmt: skip
        if self.state is State.CHECKING:
            pulse = self.polarity.step(frame)
            if not self.polarity.running:
                self._end_check()
            return pulse
        if self.state in ON_TRIAL:
            alarm = (flies and self._cycles.slow) or self.watch.alarm()
            if alarm:
                self._take_back(str(alarm))
        self._heed_pilot(frame.flags)
        self._note_flight(now_s)
        return None

    def _heed_pilot(self, flags: int) -> None:
        """Take back what the pilot, or the loss of the receiver, has ended."""
        update = self._update
        if update is None or self.state not in IN_FLIGHT:
            return
        if flags & f.Flag.RC_KILL:
            self._take_back("the pilot's kill switch")
        elif flags & f.Flag.RC_FAILSAFE:
            self._take_back("the receiver's failsafe")
        elif update.armed and not flags & ARMED:
            self._take_back('the aircraft was disarmed while the gains were on trial')
        elif update.written:
            update.armed = update.armed or bool(flags & ARMED)

    def _note_flight(self, now_s: float) -> None:
        """Keep, once, how the gains in force fly where they fly well; the next are held to it."""
        if self._flown or self.state is not State.IDLE or not self.active:
            return
        if self._cycles.flying and now_s - self._checked_s >= LOOK_S:
            self._checked_s = now_s
            if self.watch.good:
                self._flown = True
                self._good = [*self._good, dict(self.active)]
                self._history.write('flown')
                self._history.keep_flight(self.watch.before)
                self.watch.know(self.watch.before)

    def sticks(self, yaw: float, now_s: float) -> None:
        """Take the yaw stick's position, -1..1."""
        if self._gesture.take(yaw, now_s):
            if self.state in ON_TRIAL:
                self._take_back("the pilot's stick gesture")
            self.disturb("the pilot's stick gesture")

    def tick(self, now_s: float) -> None:
        """Continue where a time has come."""
        self._take_rate()
        watching = self.state is State.WATCHING
        if self.state is State.CHECKING and now_s - self._cycles.arrived_s > QUIET_S:
            self.disturb(f'no control cycle for {QUIET_S:g} s')
        if watching and now_s - self._cycles.arrived_s > LINK_S:
            self._take_back(f'no control cycle for {LINK_S:g} s')
        elif watching and self._remaining_s <= 0.0 and not self.protocol.busy:
            self._go_on(now_s)

    def _go_on(self, now_s: float) -> None:
        update = self._update
        if update is not None and update.written < len(update.steps):
            if now_s - self._cycles.excited_s < QUIET_S:
                return  # the step waits for the excitation's end, watched all the time
            try:
                self._write_step(update)
            except QuadBridgeError as error:
                self._take_back(str(error))
            return
        self.state = State.CONFIRMING
        self.protocol.confirm()

    def _take_events(self) -> None:
        events, self.protocol.events = self.protocol.events, []
        for event in events:
            self._event(event)

    def _event(self, event: GainEvent) -> None:
        if event.what is What.READ:
            self._know(event)
            if self._history.leave(self.aircraft):  # plugged in anew, and its files not open yet
                self.polarity.load({})
                self.watch.know(None)
                self._good = []
            self._flown = False
            if self.active != self._in_force:  # another program's: nobody has seen them fly
                self.watch.restart()
            self._in_force = dict(self.active)
            self._history.note_active(self.active)
            if not self.protocol.busy:  # else they are on their way back
                self._answer('the gains of before are in force', done=True)
            text = f'{len(self.active)} gains and constants read back'
            self.notes.append(Note(text, active=self.active))
        elif event.what is What.COMMITTED:
            self._committed(event)
        elif event.what is What.CONFIRMED:
            self._confirmed(event)
        elif event.what is What.REVERTED:
            who = 'the STM32 took its last good gains' if event.by_stm32 else 'old gains'
            self.rollbacks += 1
            self._ended('rolled back', event.reason)
            self._fault(f'rolled back, {who}: {event.reason}')
        else:
            busy = self.state is not State.IDLE
            self._ended(event.what.value, event.reason)
            if busy or event.what is What.LEFT:
                self._fault(f'gains: {event.what.value}: {event.reason}')
            if event.what is What.LEFT:
                self._answer(event.reason)

    def _confirmed(self, event: GainEvent) -> None:
        self._ended('confirmed', event.reason, flown=True)
        self._good = [*self._good, dict(self.active)]
        self.refused = ''  # another may have been refused meanwhile
        self._flown = False  # as the next one's "before", which this flight may still give
        self.notes.append(Note(f'the new gains are confirmed: they flew well for {WATCH_S:g} s'))
        self._answer('the STM32 had confirmed the gains')
        if event.reason:
            self._fault(f'{event.reason}, but the STM32 had confirmed the gains')

    def _know(self, event: GainEvent) -> None:
        active = event.active or {}
        self._rate_kp = np.maximum([active.get(f'{a}.rate.kp', 1.0) for a in AXES], 1e-3)
        self._take_rate()

    def _take_rate(self) -> None:
        """Watch at the rate of the cycles; never within an update, unknown to a new one."""
        if self.state is not State.IDLE or not self.active:
            return
        rate_hz = self.protocol.cycles_hz or self.active.get('loop.rate_hz', gate.USUAL_HZ)
        if rate_hz != self.rate_hz:
            self.rate_hz = self.polarity.rate_hz = rate_hz
            history = self.watch.known
            self.watch = GainWatch(min(max(rate_hz, MIN_HZ), MAX_HZ))
            self.watch.know(history)

    def _committed(self, event: GainEvent) -> None:
        update = self._update
        self._know(event)
        if update is None:
            return
        self._in_force = dict(self.active)
        step, steps = update.written + 1, len(update.steps)
        update.written, last = step, step == steps
        update.armed = update.armed or bool(self._cycles.flags & ARMED)
        self.commits += 1
        self._remaining_s = WATCH_S if last else STEP_WATCH_S
        self.state = State.WATCHING
        self._history.write('active', self.active, update.request, update=update.identity,
                            step=step, steps=steps)
        text = f'step {step} of {steps} of {update.request.source} is in force'
        self.notes.append(Note(text, active=self.active))
        if last:
            update.tell(done=True)
        elif not self._cycles.flying:
            words = f'{text}, on trial: the next after {STEP_WATCH_S:g} s of flight'
            update.tell(words, done=True)

    def end(self, why: str) -> None:
        """Begin to take back what is on trial, which nobody will watch; answer whoever waits."""
        if self.state in ON_TRIAL:
            self._take_back(why)
        self._answer(why)
        if self._update is not None:
            self._update.tell(why)

    # The way back.

    def _answer(self, words: str, *, done: bool = False) -> None:
        """Answer those who wait for the earlier gains."""
        while self._going_back:
            self._going_back.pop(0)(done, words)

    def _take_back(self, reason: str) -> None:
        self.state = State.REVERTING
        self.refused = f'rolling back: {reason}'
        self.protocol.revert(reason)

    def _ended(self, outcome: str, reason: str = '', **more: object) -> None:
        if (update := self._update) is not None:
            figures = {k: round(v, 4) for k, v in self.watch.figures().items()}
            self._history.write(outcome, None, update.request, update=update.identity,
                                reason=reason, figures=figures, **more)
            update.tell(f'{outcome}: {reason}')
        if self.state is State.CHECKING:
            self.polarity.abort(f'stopped: {reason}')
            self._end_check()
        self._update, self.state = None, State.IDLE
        self.watch.end()

    def _fault(self, text: str) -> None:
        self.refused = text
        if not self.notes or self.notes[-1].text != text:  # repeats are reported once
            self.notes.append(Note(text, fault=True))

    # Polarity.

    def _start_check(self, axes: Sequence[str], now_s: float) -> None:
        if now_s - self._cycles.arrived_s > QUIET_S or not self._cycles.flags & ARMED:
            raise RefusedError(
                f'the polarity of {", ".join(axes) or "the motors"} has not been checked on this '
                'aircraft and it is not armed: mount it free on the rig, arm it and try again'
            )
        if now_s - self._cycles.excited_s < QUIET_S:
            raise RefusedError('not while the excitation runs')
        self._cycles.refuse_slow(self.rate_hz)
        self.polarity.start(axes)
        self.state = State.CHECKING

    def _end_check(self) -> None:
        self.state, trouble = State.IDLE, self.polarity.trouble
        if not trouble:
            self._history.keep_polarity(self.polarity.record)
        words = trouble or self.polarity.words()
        reply, self._checked = self._checked, None
        if reply is not None:
            reply(words)
        self.notes.append(Note(f'polarity: {words}', fault=bool(self.polarity.faults())))
        pending, self._pending = self._pending, None
        if pending is not None:
            self._after_check(*pending, trouble)

    def _after_check(self, request: gate.GainRequest, reply: Reply | None, trouble: str) -> None:
        try:
            self._refuse_unanswered(request, trouble)
            self._begin(request, self._admit(request, self._cycles.arrived_s), reply)
        except RefusedError as error:
            self._refuse(request.source, error)
            if reply is not None:
                reply(False, str(error))

    def _refuse_unanswered(self, request: gate.GainRequest, trouble: str) -> None:
        if trouble:
            raise RefusedError(f'the check of the polarity was {trouble}')
        self.polarity.refuse_faults()
        names = ', '.join(self.polarity.unchecked(request.gains))
        if names:
            raise RefusedError(f'{names} did not respond to the pulses: mount it free about it')
