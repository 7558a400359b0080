"""Sets of gains on an autopilot that knows single parameters only. No I/O.

PARAM_SET, read back, one after the other; what `GainProtocol` leaves to the STM32 is done here. An
autopilot stores each parameter and never takes it back by itself, so the last good set is on the
disk (`keep`) before the first write, is written back whole where a trial ends badly, and where the
bridge begins and finds that a trial had not ended, unless somebody has tuned it since. A parameter
that somebody else writes in a trial ends it; a second stays, and gains are refused from then on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from enum import Enum

from quad_bridge.autopilots.table import Table, UnfitError, Units
from quad_bridge.errors import RefusedError
from quad_bridge.gains.protocol import GainEvent, Keep, What, float32
from quad_bridge.link.parameters import encoded, number
from quad_bridge.wire import frames as f

Request = f.ParamSet | f.ParamRequestRead
TRIES = 4
REPEAT_S, LOOK_S = 0.25, 0.25  # between two tries; between two looks at what is on trial
AT_ONCE = 8  # names that are asked for at the same time
STALE_S = 1.0
"""So long after a write an answer may still bear the value of before: ArduPilot answers questions
in a queue of its own, later than writes."""
RETRY_S = 1.0
"""Between two tries, once the first have failed, to write a good value back or to read one."""


class State(Enum):
    """State of the gain set."""

    READING = 'reading'
    READY = 'read back'
    SAVING = 'keeping the last good set'
    WRITING = 'writing'
    ON_TRIAL = 'on trial'
    CONFIRMING = 'confirming'
    REVERTING = 'taking back'


AT_REST = (State.READY, State.ON_TRIAL)
LOST = 'which gains are in force is read once it is heard again; then the good set is restored'
ASKED = 'it is being asked which aircraft it is'  # and nothing is written to it meanwhile


class ParameterGains:
    """One conversation with one autopilot. Times in s on a steady clock."""

    names: Mapping[str, str] = {}  # contract names are its own
    pulses = False  # it takes no test pulses: that it flies shows its signs
    whole_sets = False  # its parameters are written one after the other

    def __init__(self, table: Table, *, bytewise: bool) -> None:
        """`bytewise`: an integer's bytes lie in a value's float (PX4)."""
        self.events: list[GainEvent] = []
        self.active: Mapping[str, float] = {}
        self.state = State.READING
        self.aircraft = ''  # a name of the aircraft for its files; see `identify`
        self.units: Callable[[Mapping[str, float]], Units | None] = lambda _: None
        """U per torque of roll, pitch, yaw by what is read; None while that is not known."""
        self.cycles_hz = 0.0
        self.sure = False
        """Whether it is the aircraft of this name; while it may be another, nothing is written."""
        self.refused = ''  # why no set is taken any more
        self.keep: Keep = lambda _, done: done(False)
        self._table, self._bytewise = table, bytewise
        self._extra: tuple[str, ...] = ()
        self.values: dict[str, float] = {}
        self._kinds: dict[str, int] = {}
        self._requested: dict[str, tuple[int, float]] = {}
        self._good: dict[str, float] = {}  # of the trial that goes on, or has not ended
        self._trial: tuple[Mapping[str, float], ...] = ()
        """Values of the good set, of before the last step, and of that step."""
        self._recalled = False  # whether the disk has said what it knows
        self._stored: bool | None = None
        self._queue: dict[str, float] = {}  # still to be written, with the value
        self._whole: dict[str, float] = {}  # the set that is written: parameter to value
        self._tries, self._due_s = 0, -math.inf
        self._reported: float | None = None
        self._outcome, self._reason = What.REVERTED, ''
        self._foreign = 0
        self._checks = 0
        self._replaced: dict[str, tuple[float, float]] = {}
        """By a write of ours: the value of before, and until when it may still come."""

    @property
    def busy(self) -> str:
        """The current activity; empty where a set may be written."""
        if self.state in AT_REST and not self.sure:
            return ASKED
        if self.state in AT_REST and not self._recalled:
            return "the aircraft's files are being read"
        if self.state is State.READY and self._good:
            return 'it is being read what an unfinished trial has left'
        if self.state is State.READY and not self.cycles_hz:  # at which a trial is watched
            return 'the rate of its attitudes is being measured'
        return '' if self.state in AT_REST else self.state.value

    @property
    def at_rest(self) -> bool:
        """Whether there is no good set that may have to be written back."""
        return not self._good

    @property
    def reading(self) -> bool:
        """Whether it has not been read as a whole yet."""
        return self.state is State.READING

    @property
    def in_common(self) -> frozenset[str]:
        """Contract names whose parameter is one for all axes."""
        return self._table.in_common

    def identify(self, aircraft: str) -> None:
        """Set the aircraft's name: it is sure from now on."""
        self.aircraft, self.sure = aircraft, True

    def want(self, *names: str) -> None:
        """Read these parameters too."""
        self._extra = tuple(dict.fromkeys((*self._extra, *names)))

    def write(self, writes: Mapping[str, float], watch_ms: int) -> None:
        """Begin to write a set by contract names. Raises RefusedError before anything is sent."""
        del watch_ms  # it knows no watch of its own
        if self.refused:
            raise RefusedError(self.refused)
        units = self.units(self.values)
        if self.busy or units is None:
            raise RefusedError(f'the parameters are busy: {self.busy or "its craft is not known"}')
        try:
            targets = self._table.parameters(writes, self.values, units)
        except UnfitError as error:
            raise RefusedError(str(error)) from error
        for name, value in targets.items():
            if name not in self.values:
                raise RefusedError(f'{name}: not reported by the autopilot, so no value to '
                                   'return to')
            if not math.isfinite(value):
                raise RefusedError(f'{name}: must be finite: found {value}')
        targets = {name: float32(value) for name, value in targets.items()}
        before = {n: self.values[n] for n in self._table.written if n in self.values}
        if self.state is State.READY:
            self._good = before
        self._trial = self._good, before, targets
        self._whole = self._queue = targets
        self._go(State.SAVING)
        self._keep({'trial': {'good': self._good, 'before': before, 'tried': targets}})

    def confirm(self) -> None:
        """Keep the set on trial."""
        if self.state is State.ON_TRIAL:
            self._go(State.CONFIRMING)
            self._keep({})

    def revert(self, reason: str) -> None:
        """Take back the set that is being written or on trial."""
        if self.state in {State.ON_TRIAL, State.CONFIRMING}:
            self._take_back(What.REVERTED, reason)
        elif self.state in {State.SAVING, State.WRITING}:
            self._take_back(What.FAILED, reason)

    def restart(self) -> None:
        """Read all parameters again; a running trial is then rolled back."""
        if self.state not in {State.READING, State.READY}:
            self.events.append(GainEvent(What.LOST, reason=LOST))
        self.active, self.values, self._kinds, self._requested = {}, {}, {}, {}
        self._go(State.READING)

    def convert(self) -> None:
        """Give what is active in other units, in which no trial goes on."""
        self.revert('the craft was described anew, which changes the units of the gains')
        if self.state is State.READY:
            self._prove(State.READY, What.READ)

    def recall(self, record: object) -> None:
        """Take what the disk knows of a trial of this aircraft that has not ended; {} for none."""
        self._recalled = True
        if not self._good and isinstance(record, dict):
            self._trial = tuple(_finite(record.get(key)) for key in ('good', 'before', 'tried'))
            self._good = {n: v for n, v in self._trial[0].items() if n in self._table.written}

    # The wire.

    def poll(self, now_s: float) -> Request | None:
        """Say what to send now."""
        if self.state is State.READY and self._good:
            self._settle()
        if self.state is State.READING:
            return self._next_to_read(now_s)
        if self.state in {State.SAVING, State.CONFIRMING}:
            self._saved()
            return None
        if self.state in AT_REST:
            return self._look(now_s)
        if now_s < self._due_s or not self.sure:
            return None
        if self._tries >= TRIES and self.state is State.WRITING:
            self._unanswered()
        if not self._queue:
            return None
        self._tries += 1
        retries = self._tries > max(TRIES, len(self._queue))
        self._due_s = now_s + (RETRY_S if retries else REPEAT_S)
        name, value = next(iter(self._queue.items()))
        if self.state is State.REVERTING:  # it may hear without being heard: each in its turn
            self._queue = {n: v for n, v in self._queue.items() if n != name} | {name: value}
        kind = self._kinds.get(name, f.REAL32)
        return f.ParamSet(name, encoded(value, kind, bytewise=self._bytewise), kind=kind)

    def take(self, frame: f.ParamValue | f.GainsState, now_s: float) -> None:
        """Take a parameter's value, whoever has asked for it."""
        if not isinstance(frame, f.ParamValue) or frame.name not in self._watched():
            return
        name, value = frame.name, number(frame, bytewise=self._bytewise)
        replaced, until_s = self._replaced.get(name, (math.nan, 0.0))
        late = value == replaced and now_s < until_s and name not in self._queue
        if late or not math.isfinite(value):
            return
        previous = self.values.get(name)
        if previous is not None and value == self._queue.get(name) != previous:
            self._replaced[name] = previous, now_s + STALE_S
        self.values[name], self._kinds[name] = value, frame.kind
        if self.state is State.READING:
            self._read()
        elif name in self._queue and self.state in {State.WRITING, State.REVERTING}:
            self._answered(name, value)
        elif value != previous:
            self._changed(name, value, is_first=previous is None)

    # Reading.

    def _watched(self) -> tuple[str, ...]:
        return (*self._table.names, *self._extra)

    def _open(self, name: str) -> bool:
        is_due = name in self._good or self._requested.get(name, (0, 0.0))[0] <= TRIES
        return name not in self.values and is_due

    def _next_to_read(self, now_s: float) -> Request | None:
        for name in [name for name in self._watched() if self._open(name)][:AT_ONCE]:
            tries, due_s = self._requested.get(name, (0, -math.inf))
            if now_s >= due_s:
                self._requested[name] = tries + 1, now_s + REPEAT_S
                if tries < TRIES or name in self._good:
                    return f.ParamRequestRead(name)
        self._read()
        return None

    def _read(self) -> None:
        if any(self._open(name) for name in self._watched()) or not self.values:
            return
        if self.units(self.values) is None:
            return  # the craft is described by other parameters, which come as well
        self._prove(State.READY, What.READ)

    def _settle(self) -> None:
        """Go back from a trial that had not ended; not where somebody has tuned it since."""
        if not self.sure or not self._good.keys() <= self.values.keys():
            return
        tuned = [n for n in self._good if all(self.values[n] != of.get(n) for of in self._trial)]
        if tuned:
            self._good = {}
            self._take_back(What.LEFT, f'{", ".join(tuned)} set elsewhere since a trial that had '
                            'not ended, so nothing was restored')
        else:
            self._take_back(What.REVERTED, 'found a trial of an earlier bridge that had not ended')

    # Writing.

    def _keep(self, record: Mapping[str, object]) -> None:
        self._stored = None
        self.keep(record, self._on_stored)

    def _on_stored(self, done: bool) -> None:
        self._stored = done  # from the thread that writes; read by `poll`

    def _saved(self) -> None:
        if self._stored is None:
            return
        if self.state is State.CONFIRMING:
            if self._stored:
                self._good = {}
                self._go(State.READY)
                self.events.append(GainEvent(What.CONFIRMED, self.active))
            else:
                self._take_back(What.REVERTED, 'the disk does not take the confirmation')
        elif self._stored:
            self._go(State.WRITING)
        else:
            steps = any(self.values.get(name) != value for name, value in self._good.items())
            self._good = self._good if steps else {}
            self._take_back(What.FAILED, 'the last good set cannot be kept on the disk, so '
                            f'{"the next step" if steps else "nothing"} was not written')

    def _answered(self, name: str, value: float) -> None:
        """Take the value of a parameter that is still to be written."""
        if not self.sure:
            return  # another aircraft's, perhaps
        if value != self._queue[name]:
            if self.state is State.WRITING and next(iter(self._queue)) == name and self._tries:
                self._reported, self._due_s = value, -math.inf  # try again at once
            return
        self._queue = {n: v for n, v in self._queue.items() if n != name}
        self._tries, self._reported, self._due_s = 0, None, -math.inf
        if self._queue:
            return
        if self.state is State.WRITING:
            self._prove(State.ON_TRIAL, What.COMMITTED)
        else:
            self._back_again()

    def _prove(self, state: State, what: What) -> None:
        units = self.units(self.values)
        if units is not None:
            self.active = self._table.gains(self.values, units)
        self._go(state)
        self.events.append(GainEvent(what, self.active))

    def _unanswered(self) -> None:
        name, value = next(iter(self._queue.items()))
        words = f'{name}: no answer to {TRIES} tries'
        if self._reported is not None:
            words = f'{name}: the autopilot kept {self._reported:g} instead of {value:g}'
        self._take_back(What.FAILED, words)

    def _look(self, now_s: float) -> Request | None:
        """Read what is on trial, one after the other: another program may have written it.

        Otherwise what has not answered yet: a line may be silent for a while.
        """
        names, pause_s = [*self._whole], LOOK_S
        if self.state is State.READY:
            names, pause_s = [n for n in self._watched() if n not in self.values], RETRY_S
        if now_s < self._due_s or not names:
            return None
        self._due_s, self._checks = now_s + pause_s, self._checks + 1
        return f.ParamRequestRead(names[self._checks % len(names)])

    def _changed(self, name: str, value: float, *, is_first: bool) -> None:
        """Somebody else has written it: a gain, its multiplier, a limit or a filter.

        `is_first`: it had not answered before, so nobody need have written it.
        """
        if not is_first:
            if name not in self._table.names:
                return
            if self.state in {State.ON_TRIAL, State.WRITING, State.SAVING, State.CONFIRMING}:
                self._foreign += 1
                self._take_back(What.REVERTED, f'{name} was set to {value:g} by another program '
                                'during the trial')
            elif self._foreign:  # a second one, after or while the good set is written back
                self.refused = (f'{name} was set to {value:g} by another program again: it is '
                                'left alone, and gains are refused until the bridge is restarted')
        if self.state is State.READY:
            self._prove(State.READY, What.READ)

    # The way back.

    def _take_back(self, outcome: What, reason: str) -> None:
        self._outcome, self._reason = outcome, reason
        first = [name for name in self._whole if name in self._good]
        self._queue = {n: self._good[n] for n in dict.fromkeys([*first, *self._good])}
        self._go(State.REVERTING)
        if not self._queue:
            self._back_again()

    def _back_again(self) -> None:
        self._good, self._whole = {}, {}
        self.keep({}, lambda _: None)  # where that fails, the good set is written once more
        self.events.append(GainEvent(self._outcome, reason=self._reason))
        self._prove(State.READY, What.READ)

    def _go(self, state: State) -> None:
        self.state, self._tries, self._reported, self._due_s = state, 0, None, -math.inf


def _finite(stored: object) -> dict[str, float]:
    """The numbers of an object from the disk."""
    items = stored.items() if isinstance(stored, dict) else ()
    return {n: float(v) for n, v in items if isinstance(v, int | float) and math.isfinite(v)}
