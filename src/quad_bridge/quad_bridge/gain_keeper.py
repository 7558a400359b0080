"""Keeps an aircraft's gains: gate, polarity, steps, watch and the way back, as one state machine.

Pure but for the store of the aircraft's files: cycles, events and ticks come in with their time (s
on a steady clock), what is to be published or logged waits in `news`. The wire is gain_line.py's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from quad_bridge import gain_gate
from quad_bridge.errors import QuadBridgeError, RefusedError
from quad_bridge.gain_line import GainEvent, GainLine, What
from quad_bridge.gain_log import GainLog
from quad_bridge.gain_request import GainRequest, read_request
from quad_bridge.gain_state import KeeperSettings, News, State
from quad_bridge.gain_watch import AXES, GainWatch
from quad_bridge.gains.table import WIRE_NAMES
from quad_bridge.polarity_check import PolarityCheck
from quad_bridge.stick_gesture import StickGesture
from quad_bridge.wire.axes import flip_attitude, flip_body
from quad_bridge.wire.frames import Cycle, Excitation, Flag, Injection

STEP_WATCH_S, WATCH_S = 3.0, 10.0
"""Between the steps of a larger change, and after the last."""
STM32_WATCH_MS = 15_000
"""After which the STM32 takes an unconfirmed set back: the watch, and time to confirm."""
QUIET_S = 0.5
"""Without excitation before gains may change; without a cycle after which a check ends."""
LINK_S = 1.0
"""Without a control cycle after which gains on trial are asked back."""


@dataclass
class _Update:
    """The update in flight."""

    asked: GainRequest
    steps: list[dict[str, float]]
    identity: str
    written: int = 0


class GainKeeper:
    """See the module. `ask` and `check` raise RefusedError, the rest never."""

    def __init__(self, settings: KeeperSettings, line: GainLine) -> None:
        self.news: list[News] = []
        self.refused = ''
        """Why the last update was refused, failed or taken back; empty after a good one."""
        self.refusals = self.commits = self.rollbacks = 0
        self.state = State.IDLE
        self.watch = GainWatch()
        self.polarity = PolarityCheck(settings.polarity)
        self._settings, self._line = settings, line
        self._files = GainLog(settings.folder)
        self._gesture = StickGesture()
        self._update: _Update | None = None
        self._pending: tuple[GainRequest, list[str]] | None = None
        self._checked: Callable[[str], None] | None = None
        self._until_s = 0.0
        self._cycle_s = self._excited_s = float('-inf')
        self._flags = 0
        self._rate_kp = np.ones(3)

    @property
    def words(self) -> str:
        """The state in a few words."""
        if self.state is State.IDLE or self._update is None:
            return self._line.busy or self.state.value
        source, left = self._update.asked.source, self._until_s - self._cycle_s
        text = f'{self.state.value} gains of {source}'
        return f'{text}, {max(left, 0.0):.0f} s left' if self.state is State.WATCHING else text

    @property
    def disk_fault(self) -> str:
        """What keeps the history from being written."""
        return self._files.fault

    # What is asked for.

    def ask(self, parameters: Mapping[str, object], now_s: float) -> str:
        """Take on what a message or `ros2 param set` asks for; what happens next, in words.

        Raises RefusedError; the refusal is in `news` too.
        """
        source = gain_gate.shorten(str(parameters.get('source', 'unknown source')))
        try:
            return self._request(read_request(parameters), now_s)
        except RefusedError as error:
            self._refuse(source, error)
            raise

    def _request(self, asked: GainRequest, now_s: float) -> str:
        gain_gate.check_source(asked.source, self._settings.sources)
        if asked.rollback and self.state in {State.WRITING, State.WATCHING}:
            self._take_back(f'{asked.source} asked for it')
            return 'taking back the gains in flight'
        path = self._admit(asked, now_s)
        axes = self.polarity.missing(asked.gains)
        if axes:
            self._start_check(axes, now_s)
            self._pending = asked, axes
            return f'checking the polarity of {", ".join(axes)} before the first update'
        self._begin(asked, path)
        return f'writing {len(asked.gains)} gains of {asked.source} in {len(path)} steps'

    def _refuse(self, source: str, error: RefusedError) -> None:
        self.refusals += 1
        self._fault(f'gains of {source} refused: {error}')

    def check(self, now_s: float, told: Callable[[str], None], *, motors: bool = False) -> None:
        """Fly the pulses about all axes, or of each motor; `told` is called with the result."""
        if self.state is not State.IDLE:
            raise RefusedError(f'the gains are busy: {self.words}')
        self._start_check(() if motors else AXES, now_s)
        self._checked = told

    def disturb(self, why: str = 'the excitation has started') -> None:
        """Somebody else excites, or nobody may: a check cannot go on."""
        if self.state is State.CHECKING:
            self.polarity.abort(f'stopped: {why}')
            self._end_check()

    def _admit(self, asked: GainRequest, now_s: float) -> list[dict[str, float]]:
        path = gain_gate.steps(asked.gains, self._line.active, self._settings.bounds)
        if now_s - self._cycle_s > QUIET_S:
            raise RefusedError('the link is down: no control cycle in the last 0.5 s')
        if self.state is not State.IDLE:
            raise RefusedError(f'an earlier update is in flight: {self.words}')
        if self._line.busy:
            raise RefusedError(f'the parameters are busy: {self._line.busy}')
        if now_s - self._excited_s < QUIET_S:
            raise RefusedError('not while the excitation runs: send them when it is idle')
        if self._flags & (Flag.RC_KILL | Flag.RC_FAILSAFE):
            raise RefusedError("the pilot's kill switch or the receiver's failsafe is on")
        return path

    def _begin(self, asked: GainRequest, path: list[dict[str, float]]) -> None:
        update = _Update(asked, path, self._files.identity())
        self._write_step(update)
        self._update, self.refused = update, ''

    def _write_step(self, update: _Update) -> None:
        step = update.steps[update.written]
        self._line.write({WIRE_NAMES[n]: v for n, v in step.items()}, STM32_WATCH_MS)
        self.state = State.WRITING

    # What comes from the STM32.

    def cycle(self, frame: Cycle, now_s: float) -> Excitation | None:
        """Take one control cycle; a pulse to send while the polarity is checked."""
        self._cycle_s, self._flags = now_s, frame.flags
        rates = flip_body(frame.gyro)
        added = np.array(flip_body(frame.excitation))
        inside = np.zeros(3)
        if frame.injection == Injection.RATE:
            inside = added
        elif frame.injection == Injection.CONTROL:
            inside = added / self._rate_kp
        attitude, reference = (
            np.array(flip_attitude(rpy)) for rpy in (frame.attitude, frame.attitude_setpoint)
        )
        self.watch.step(np.array(rates), attitude, reference, inside)
        if self._line.events:
            self._take_events(now_s)
        if self.state is State.CHECKING:
            pulse = self.polarity.step(frame)
            if not self.polarity.running:
                self._end_check()
            return pulse
        if frame.flags & Flag.EXCITATION:
            self._excited_s = now_s
        if self.state in {State.WATCHING, State.WRITING}:
            alarm = self.watch.alarm()
            if alarm is not None:
                self._take_back(str(alarm))
            elif frame.flags & Flag.RC_KILL:
                self._take_back("the pilot's kill switch")
        return None

    def sticks(self, yaw: float, now_s: float) -> None:
        """Take the yaw stick's place, -1..1."""
        gesture = self._gesture.step(yaw, now_s)
        if gesture and self.state in {State.WATCHING, State.WRITING}:
            self._take_back("the pilot's stick gesture")

    def tick(self, now_s: float) -> None:
        """Go on where it is time, and take over what the line has done."""
        self._take_events(now_s)
        self._open_files()
        watching = self.state is State.WATCHING
        if self.state is State.CHECKING and now_s - self._cycle_s > QUIET_S:
            self.disturb(f'no control cycle for {QUIET_S:g} s')
        if watching and now_s - self._cycle_s > LINK_S:
            self._take_back(f'no control cycle for {LINK_S:g} s')
        elif watching and now_s >= self._until_s and not self._line.busy:
            self._go_on(now_s)

    def _go_on(self, now_s: float) -> None:
        update = self._update
        if update is not None and update.written < len(update.steps):
            if now_s - self._excited_s < QUIET_S:
                return  # the step waits for the excitation's end, watched all the time
            try:
                self._write_step(update)
            except QuadBridgeError as error:
                self._take_back(str(error))
            return
        self.state = State.CONFIRMING
        self._line.confirm()

    def _take_events(self, now_s: float) -> None:
        events, self._line.events = self._line.events, []
        for event in events:
            self._event(event, now_s)

    def _event(self, event: GainEvent, now_s: float) -> None:
        if event.what is What.READ:
            self._read(event)
        elif event.what is What.COMMITTED:
            self._committed(event, now_s)
        elif event.what is What.CONFIRMED:
            self._ended('confirmed')
            self.news.append(News('the new gains are confirmed'))
        elif event.what is What.REVERTED:
            who = 'the STM32 took its last good gains' if event.by_stm32 else 'old gains'
            self.rollbacks += 1
            self._ended('rolled back', event.reason)
            self._fault(f'rolled back, {who}: {event.reason}')
        else:
            busy = self.state is not State.IDLE
            lost = event.what is What.LOST
            self._ended('link lost' if lost else 'not taken over', event.reason)
            if busy:
                self._fault(f'gains not taken over: {event.reason}')

    def _read(self, event: GainEvent) -> None:
        active = event.active or {}
        self._know(active)
        self._files.found(active)
        self.news.append(News(f'{len(active)} gains and constants read back', active=active))

    def _committed(self, event: GainEvent, now_s: float) -> None:
        update, active = self._update, event.active or {}
        self._know(active)
        if update is None:
            return
        if update.written == 0:
            touched = {name.partition('.')[0] for name in update.asked.gains}
            axes = touched if touched <= set(AXES) else AXES
            self.watch.begin(update.asked.predicted, axes)
        update.written += 1
        self.commits += 1
        last = update.written == len(update.steps)
        self._until_s = now_s + (WATCH_S if last else STEP_WATCH_S)
        if self.state is State.WRITING:
            self.state = State.WATCHING
        self._log('active', active, step=update.written, steps=len(update.steps))
        text = f'step {update.written} of {len(update.steps)} of {update.asked.source} is in force'
        self.news.append(News(text, active=active))

    def _know(self, active: Mapping[str, float]) -> None:
        kp = [active.get(f'{axis}.rate.kp', 1.0) for axis in AXES]
        self._rate_kp = np.maximum(kp, 1e-3)

    # The way back.

    def _take_back(self, reason: str) -> None:
        if self.state is State.REVERTING:
            return
        self.state = State.REVERTING
        self.refused = f'rolling back: {reason}'
        self._line.revert(reason)

    def _ended(self, outcome: str, reason: str = '') -> None:
        if self._update is not None:
            figures = {k: round(v, 4) for k, v in self.watch.figures().items()}
            self._log(outcome, reason=reason, figures=figures)
        if self.state is State.CHECKING:
            self.polarity.abort(f'stopped: {reason}')
            self._end_check()
        self._update, self.state = None, State.IDLE
        self.watch.end()

    def _fault(self, text: str) -> None:
        self.refused = text
        if not self.news or self.news[-1].text != text:  # a flood is told once
            self.news.append(News(text, fault=True))

    # Polarity.

    def _start_check(self, axes: Sequence[str], now_s: float) -> None:
        if now_s - self._cycle_s > QUIET_S or not self._flags & Flag.ARMED:
            raise RefusedError(
                f'the polarity of {", ".join(axes) or "the motors"} has not been checked on this '
                'aircraft and it is not armed: mount it free on the rig, arm it and try again'
            )
        if now_s - self._excited_s < QUIET_S:
            raise RefusedError('not while the excitation runs')
        self.polarity.start(axes)
        self.state = State.CHECKING

    def _end_check(self) -> None:
        self.state, trouble = State.IDLE, self.polarity.trouble
        if not trouble:
            self._files.keep_polarity(self.polarity.record)
        words = trouble or self.polarity.words()
        told, self._checked = self._checked, None
        if told is not None:
            told(words)
        self.news.append(News(f'polarity: {words}', fault=bool(self.polarity.faults())))
        pending, self._pending = self._pending, None
        if pending is not None:
            self._after_check(pending, trouble)

    def _after_check(self, pending: tuple[GainRequest, list[str]], trouble: str) -> None:
        asked, axes = pending
        silent = self.polarity.silent(axes)
        if trouble:
            self._refuse(asked.source, RefusedError(f'the check of the polarity was {trouble}'))
            return
        if silent:
            words = f'{", ".join(silent)} did not answer to the pulses: mount it free about it'
            self._refuse(asked.source, RefusedError(words))
            return
        try:
            self.polarity.missing(asked.gains)
            self._begin(asked, self._admit(asked, self._cycle_s))
        except RefusedError as error:
            self._refuse(asked.source, error)

    # The aircraft's files.

    def _open_files(self) -> None:
        name = self._settings.name_of(self._line.state)
        record = self._files.open(name) if name else None
        if record is not None:
            self.polarity.load(record)
            if self._line.reader.complete:
                self._files.found(self._line.active)

    def _log(self, state: str, active: Mapping[str, float] | None = None, **more: object) -> None:
        update = self._update
        if update is not None:
            self._files.write(state, active, update.asked, update=update.identity, **more)
