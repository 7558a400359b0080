"""The bridge's side of the aircraft's sets of gains: read, stage, commit, confirm, revert. No I/O.

`poll` says what to send, `take` what came back, `events` what happened. The rule: what is in force
is known only while the checksum of what was read is the one that the STM32 states, and whatever
cannot be proven is reverted. The state diagram and the invariants stand in
docs/reference/gain_machines.md; test_gain_protocol.py walks through every state and every event.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from quad_bridge.errors import RefusedError
from quad_bridge.gains.table import CONTRACT_NAMES, WIRE_NAMES
from quad_bridge.wire import frames as f

Request = f.GainsCommand | f.ParamSet | f.ParamRequestList | f.ParamRequestRead
Keep = Callable[[Mapping[str, object], Callable[[bool], None]], None]
"""Writes a record to the disk, {} for none, and says from any thread whether it is there."""
TRIES, SAFETY_TRIES = 4, 41
"""Tries of one request; of CONFIRM and REVERT, which last until the STM32 decides itself."""
REPEAT_S, READ_S, QUIET_S = 0.25, 0.5, 0.1
"""Between two tries; between two while reading; silence that ends a list of parameters."""


class State(Enum):
    """State of the conversation."""

    READING = 'reading'
    READY = 'read back'
    OPENING = 'opening'
    STAGING = 'writing'
    COMMITTING = 'committing'
    VERIFYING = 'reading back'
    ON_TRIAL = 'on trial'
    CONFIRMING = 'confirming'
    REVERTING = 'taking back'


WRITING = (State.OPENING, State.STAGING, State.COMMITTING, State.VERIFYING)
AT_REST = (State.READY, State.ON_TRIAL)
_ACTIONS = {
    State.OPENING: f.GainsAction.OPEN,
    State.COMMITTING: f.GainsAction.COMMIT,
    State.CONFIRMING: f.GainsAction.CONFIRM,
    State.REVERTING: f.GainsAction.REVERT,
}


class What(Enum):
    """Events of the gains."""

    READ = 'all read'
    COMMITTED = 'committed and read back'
    FAILED = 'not taken over'
    CONFIRMED = 'confirmed'
    REVERTED = 'taken back'
    LOST = 'link lost'
    LEFT = 'left as they are'


@dataclass(frozen=True)
class GainEvent:
    """One event; `active` (contract names, SI) where the gains in force were proven."""

    what: What
    active: Mapping[str, float] | None = None
    reason: str = ''
    by_stm32: bool = False  # the STM32 has reverted by itself


LOST = GainEvent(What.LOST, reason='which gains are in force is read once the STM32 answers again'
                 '; it takes unconfirmed ones back by itself')


class GainProtocol:
    """One conversation with one STM32; `restart` begins another. Times in s on a steady clock."""

    names = WIRE_NAMES
    pulses = whole_sets = True
    cycles_hz = 0.0
    in_common: frozenset[str] = frozenset()

    def __init__(self) -> None:
        self.state = State.READING
        self.events: list[GainEvent] = []
        self.active: Mapping[str, float] = {}
        """The active gains, contract names, SI; empty until they are read back."""
        self.reported: f.GainsState | None = None  # the STM32's last word on its sets
        self.keep: Keep = lambda _, done: done(True)  # nothing: the STM32 reverts by itself
        self._forget()
        self._number = 0
        self._checksum = 0  # that of the gains in force, or of those that are being written
        self._writes: dict[str, float] = {}
        self._queue: list[str] = []  # names that are still to be written, or to be read back
        self._watch_ms = 0
        self._reported: float | None = None
        """The value that the STM32 reported instead of the written one."""
        self._outcome, self._reason = What.REVERTED, ''
        """The event that follows once the gains are reverted, and its reason."""
        self._late = False  # the STM32 may have confirmed what is asked back
        self._tries, self._due_s = 0, -math.inf

    @property
    def busy(self) -> str:
        """The current activity; empty where a set may be written."""
        return '' if self.state in AT_REST else self.state.value

    @property
    def aircraft(self) -> str:
        """The STM32's unique number; empty while it is not known."""
        return f'{self.reported.aircraft:016x}' if self.reported is not None else ''

    @property
    def reading(self) -> bool:
        """Whether the gains have not been read as a whole yet."""
        return self.state is State.READING

    def recall(self, record: object) -> None:
        """Do nothing: the STM32 itself reports whether a trial goes on."""

    # Requests.

    def write(self, writes: Mapping[str, float], watch_ms: int) -> None:
        """Begin to write a set (wire names) that gate.py has let through.

        Raises RefusedError before anything is sent.
        """
        if self.busy or self.reported is None:
            raise RefusedError(f'the parameters are busy: {self.busy}')
        for name in writes:
            if name not in self._values:
                raise RefusedError(f'{name}: not reported by the STM32, so no value to return to')
        self._writes = {name: float32(value) for name, value in writes.items()}
        merged = {**self._values, **self._writes}
        self._checksum = checksum([merged[name] for name in self._ordered()])
        self._number, self._watch_ms = self.reported.transaction % 255 + 1, watch_ms
        self._go(State.OPENING)

    def confirm(self) -> None:
        """Confirm the set on trial."""
        if self.state is State.ON_TRIAL:
            self._go(State.CONFIRMING)

    def revert(self, reason: str) -> None:
        """Revert the set that is being written, on trial or being confirmed.

        One that the STM32 has confirmed by then stays: the event is CONFIRMED, with the reason.
        """
        if self.state in {State.ON_TRIAL, State.CONFIRMING}:
            self._take_back(What.REVERTED, reason)
        elif self.state in WRITING:
            self._take_back(What.FAILED, reason)

    def restart(self) -> None:
        """Read everything again, after a restart or from another aircraft."""
        if self.state not in {State.READING, State.READY}:
            self.events.append(LOST)
        self.reported, self._number = None, 0
        self._read_again()

    # The wire.

    def poll(self, now_s: float) -> Request | None:
        """Frames to send now; also detects that the tries are used up."""
        if self.state in AT_REST or now_s < self._due_s:
            return None
        if self.state is State.READING:
            self._due_s = now_s + READ_S
            return self._next_to_read()
        if self._tries == 0:
            self._unanswered()
            return self.poll(now_s)
        self._tries -= 1
        self._due_s = now_s + REPEAT_S
        action = _ACTIONS.get(self.state)
        if action is f.GainsAction.COMMIT:
            return f.GainsCommand(int(action), self._number, self._checksum, self._watch_ms)
        if action is not None:
            return f.GainsCommand(int(action), self._number)
        name = self._queue[0]
        staging = self.state is State.STAGING
        return f.ParamSet(name, self._writes[name]) if staging else f.ParamRequestRead(name)

    def take(self, frame: f.ParamValue | f.GainsState, now_s: float) -> None:
        """Take an answer; those to other questions are ignored."""
        if isinstance(frame, f.ParamValue):
            if self.state is State.READING:
                self._read(frame, now_s)
            elif self._queue and frame.name == self._queue[0]:
                self._answered(frame)
            return
        self.reported = frame
        if frame.result in {f.GainsResult.LINK_LOST, f.GainsResult.NOT_CONFIRMED}:
            self._gave_up_by_itself(f.GainsResult(frame.result))
        elif self.state in _ACTIONS and frame.action == _ACTIONS[self.state]:
            if frame.transaction == self._number or frame.result == f.GainsResult.WRONG_ID:
                self._acted(frame)
        else:
            self._compare(frame, now_s)

    # Reading.

    def _next_to_read(self) -> Request:
        if self._count:
            missing = [i for i in range(self._count) if i not in self._names]
            if missing:
                return f.ParamRequestRead('', missing[0])
        elif self.reported is not None:
            return f.ParamRequestList()
        return f.GainsCommand(int(f.GainsAction.QUERY), 0)

    def _read(self, frame: f.ParamValue, now_s: float) -> None:
        if frame.index >= frame.count:
            return  # an echo that nobody has asked for
        self._count = frame.count
        self._names[frame.index], self._values[frame.name] = frame.name, frame.value
        complete = len(self._names) >= self._count
        self._due_s = -math.inf if complete else now_s + QUIET_S

    def _compare(self, state: f.GainsState, now_s: float) -> None:
        """Compare the STM32's active checksum with the expected one."""
        if self.state in {State.READING, State.READY} and state.phase != f.GainsPhase.IDLE:
            self._number = state.transaction
            self._take_back(What.REVERTED, 'found unconfirmed gains of an earlier bridge')
        elif self.state is State.READING:
            if not self._count:
                self._due_s = -math.inf
            elif len(self._names) >= self._count:
                self._checksum = checksum([self._values[name] for name in self._ordered()])
                if self._checksum == state.checksum:
                    self._proven(State.READY, What.READ)
                else:  # changed while it was read
                    self._forget()
                    self._due_s = now_s + READ_S
        elif self.state is State.READY:
            if state.checksum != self._checksum:
                self._read_again()
        elif (
            self.state in {State.VERIFYING, State.ON_TRIAL, State.CONFIRMING}
            and state.checksum != self._checksum
        ):
            outcome = What.FAILED if self.state is State.VERIFYING else What.REVERTED
            self._take_back(outcome, 'the STM32 has other gains in force')

    def _proven(self, state: State, what: What) -> None:
        names = [name for name in sorted(self._values) if name in CONTRACT_NAMES]
        self.active = {CONTRACT_NAMES[name]: self._values[name] for name in names}
        self._go(state)
        self.events.append(GainEvent(what, self.active))

    # Writing.

    def _answered(self, frame: f.ParamValue) -> None:
        """Take the value of the parameter that is being written, or read back."""
        if frame.value != self._writes[frame.name]:
            self._reported, self._due_s = frame.value, -math.inf  # try again at once
            return
        self._queue.pop(0)
        if self._queue:
            self._go(self.state)
        elif self.state is State.STAGING:
            self._go(State.COMMITTING)
        else:
            self._values.update(self._writes)
            self._proven(State.ON_TRIAL, What.COMMITTED)

    def _acted(self, state: f.GainsState) -> None:
        """Take the answer to an action."""
        is_ok = state.result == f.GainsResult.OK
        if self.state is State.REVERTING:
            idle = state.phase == f.GainsPhase.IDLE
            if self._late and idle and state.checksum == self._checksum:
                self._confirmed(self._reason)
            else:
                self.events.append(GainEvent(self._outcome, reason=self._reason))
                self._read_again()
        elif not is_ok and self.state is not State.CONFIRMING:
            words = f.GainsResult(state.result).name.lower().replace('_', ' ')
            self._take_back(What.FAILED, f'the STM32 refused the set: {words}')
        elif self.state is State.OPENING:
            self._queue = list(self._writes)
            self._go(State.STAGING)
        elif not is_ok or state.checksum != self._checksum:
            outcome = What.REVERTED if self.state is State.CONFIRMING else What.FAILED
            self._take_back(outcome, 'the STM32 has other gains in force')
        elif self.state is State.COMMITTING:
            self._queue = list(self._writes)
            self._go(State.VERIFYING)
        else:
            self._confirmed()

    def _confirmed(self, reason: str = '') -> None:
        self._go(State.READY)
        self.events.append(GainEvent(What.CONFIRMED, self.active, reason))

    def _unanswered(self) -> None:
        words = f'no answer to {TRIES} tries while {self.state.value}'
        if self.state in {State.CONFIRMING, State.REVERTING}:
            self.events.append(LOST)
            self._read_again()
        elif self._queue and self._reported is not None:
            name = self._queue[0]
            self._take_back(What.FAILED, f'{name}: the STM32 kept {self._reported:g} '
                                         f'instead of {self._writes[name]:g}')
        else:
            name = f'{self._queue[0]}: ' if self._queue else ''
            self._take_back(What.FAILED, name + words)

    # The way back.

    def _take_back(self, outcome: What, reason: str) -> None:
        self._outcome, self._reason, self._queue = outcome, reason, []
        self._late = self.state is State.CONFIRMING
        self._go(State.REVERTING)

    def _gave_up_by_itself(self, result: f.GainsResult) -> None:
        """The STM32 reverted, without a frame or a confirmation from us."""
        if self.state is State.READY:
            return  # it has reverted no set of ours; its checksum will show
        words = result.name.lower().replace('_', ' ')
        self.events.append(GainEvent(What.REVERTED, reason=words, by_stm32=True))
        self._read_again()

    def _go(self, state: State) -> None:
        self.state, self._reported, self._due_s = state, None, -math.inf
        is_vital = state in {State.CONFIRMING, State.REVERTING}
        self._tries = SAFETY_TRIES if is_vital else TRIES

    def _read_again(self) -> None:
        self._forget()
        self._go(State.READING)

    def _forget(self) -> None:
        self.active = {}
        self._queue = []
        self._count = 0  # number of the STM32's parameters; 0 while unknown
        self._names: dict[int, str] = {}
        self._values: dict[str, float] = {}  # what is in force as far as it was read, wire names

    def _ordered(self) -> list[str]:
        return [self._names[i] for i in sorted(self._names)]


def float32(value: float) -> float:
    """The value as the wire carries it. gate.py lets no other through."""
    return float(struct.unpack('<f', struct.pack('<f', value))[0])


def checksum(values: Sequence[float]) -> int:
    """CRC-32 over all parameters in the order of their index, as QUAD_GAINS has it."""
    return zlib.crc32(struct.pack(f'<{len(values)}f', *values))
