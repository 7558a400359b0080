"""ArduPilot's own SYSTEM ID mode for a chirp: set up, entered, followed, put back. Pure, no I/O.

Its parameters are written one after the other and read back; where one is not taken the mode is
not entered. SID_MAGNITUDE is always the schedule's: its default of 15 is meant for degrees and is
the whole command at the mixer. The mode ignores the sticks, so they are watched here. The schedule
plays its own signal meanwhile, which is not sent: where it falls silent, so have its limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any

from quad_bridge.autopilots.flight import FlightState
from quad_bridge.autopilots.guard import Guard, ModeSwitch
from quad_bridge.autopilots.takeover import BEAT_S, LATEST_S
from quad_bridge.link.parameters import number
from quad_bridge.wire import frames as f
from quad_bridge.wire.frames import Injection

MODE = 25
MODES_BEFORE = {0: 'Stabilize', 1: 'Acro'}
"""Since 4.6 the axes of attitude, rate and mixer begin in a mode with manual throttle only."""
FIRST_AXIS = {Injection.ATTITUDE: 1, Injection.RATE: 7, Injection.CONTROL: 10}
MOST = {Injection.ATTITUDE: 20.0, Injection.RATE: 200.0, Injection.CONTROL: 0.25}
"""Largest SID_MAGNITUDE, deg, deg/s and share of the command."""
NAMES = ('SID_AXIS', 'SID_MAGNITUDE', 'SID_F_START_HZ', 'SID_F_STOP_HZ', 'SID_T_FADE_IN',
         'SID_T_REC', 'SID_T_FADE_OUT')
REPEAT_S, TRIES = 0.25, 8  # of a parameter: 2 s bridge the drop-outs of a telemetry radio
ENTER_S = 3.0  # until the mode must be there
DELAY_S = 1.0  # from the mode's entry until it injects
SET_UP_S = 2.0  # for parameters and the mode; the segment of the schedule began before them
LEFT_ON = 'set it to 0, and the other SID_* as you want them: a bridge that was killed leaves them'
LEAST_S = 5.0  # of a sweep: a shorter one holds too little of its slow end


class Phase(Enum):
    """State of the experiment."""

    IDLE = 'idle'
    WRITING = 'writing SID parameters'
    ENTERING = 'asking for the mode'
    FLYING = 'in SYSTEM ID'
    LEAVING = 'giving the mode back'
    RESTORING = 'putting SID parameters back'


def sid_parameters(
    axis: int, injection: Injection, segment: Mapping[str, Any]
) -> dict[str, float]:
    """SID parameters of a segment with a chirp. Raises ValueError, one line, where it has none."""
    if injection not in FIRST_AXIS:
        raise ValueError('SYSTEM ID injects at attitude, rate or control')
    names = ('amplitude', 'f0_hz', 'f1_hz', 'sweep_s')
    fields = {name: float(segment.get(name, math.nan)) for name in names}
    bad = [name for name, value in fields.items() if not value > 0.0 or not math.isfinite(value)]
    if bad:
        raise ValueError(f'a chirp for SYSTEM ID needs {", ".join(bad)}')
    is_share = injection is Injection.CONTROL
    size = fields['amplitude'] if is_share else math.degrees(fields['amplitude'])
    if size > MOST[injection] * 1.001:
        raise ValueError(f'SID_MAGNITUDE must be at most {MOST[injection]:g}: found {size:.4g}')
    ramp_s = max(float(segment.get('ramp_s', 0.5)), 0.1)
    steady_s = 2.0 / fields['f0_hz']
    extra_s = SET_UP_S + DELAY_S + steady_s + 2.0 * ramp_s
    record_s = fields['sweep_s'] - extra_s  # so that it has ended when the segment ends
    least_s = max(LEAST_S, 1.05 * steady_s)  # it refuses a sweep as short as its steady start
    if record_s < least_s:
        raise ValueError(f'the segment is too short for SYSTEM ID: {extra_s:.1f} s go beside the '
                         f'sweep, and {least_s:.3g} s must be left of {fields["sweep_s"]:g}')
    return {
        'SID_AXIS': FIRST_AXIS[injection] + axis, 'SID_MAGNITUDE': size,
        'SID_F_START_HZ': fields['f0_hz'], 'SID_F_STOP_HZ': fields['f1_hz'],
        'SID_T_FADE_IN': ramp_s, 'SID_T_REC': record_s, 'SID_T_FADE_OUT': ramp_s,
    }


class SystemId:
    """One chirp at a time. Times in s on a steady clock."""

    def __init__(self, flight: FlightState, set_mode: Callable[[int], f.Command],
                 last_setpoint_s: Callable[[], float]) -> None:
        """`last_setpoint_s`: when the schedule's last set-point came, s."""
        self.phase = Phase.IDLE
        self.refusal = ''  # why the last chirp did not begin, or ended early
        self.known: dict[str, float] = {}
        self._kinds: dict[str, int] = {}
        self._flight, self._last_setpoint_s = flight, last_setpoint_s
        self._switch = ModeSwitch(flight, set_mode)
        self._before: dict[str, float] = {}
        self._target: dict[str, float] = {}
        self._queue: list[str] = []
        self._guard: Guard | None = None
        self._tries, self._due_s, self._since_s = 0, -math.inf, 0.0
        self._start_s, self._end_s = -math.inf, math.inf
        self._sure_s = -math.inf  # a heartbeat from then on tells whether the mode was entered

    @property
    def flying(self) -> bool:
        """Whether the mode is on."""
        return self.phase is Phase.FLYING

    def fault(self, version: tuple[int, int]) -> str:
        """Why it cannot begin, beside what the aircraft's own rules say."""
        if self.phase is not Phase.IDLE:
            return f'SYSTEM ID is busy: {self.phase.value}'
        if not all(name in self.known for name in NAMES):
            return ('SID_AXIS is not answered: boards of 1 MB have no SYSTEM ID from 4.5 on; '
                    'other signals than chirp are flown in GUIDED_NOGPS')
        if self.known['SID_AXIS']:
            return f'SID_AXIS is {self.known["SID_AXIS"]:g}: {LEFT_ON}'
        if version >= (4, 6) and self._flight.mode not in MODES_BEFORE:
            return f'SYSTEM ID is entered from {" or ".join(MODES_BEFORE.values())} only'
        return ''

    def begin(self, parameters: Mapping[str, float], now_s: float) -> None:
        """Write the parameters, then enter the mode."""
        self.refusal, self._target = '', dict(parameters)
        self._before = {name: self.known[name] for name in parameters}
        self._guard, self._start_s = Guard.of(self._flight), now_s
        self._queue = [n for n in parameters if n != 'SID_AXIS'] + ['SID_AXIS']
        length_s = sum(parameters[n] for n in NAMES[-3:]) + 2.0 / parameters['SID_F_START_HZ']
        self._end_s = DELAY_S + length_s + 0.5
        self._go(Phase.WRITING, now_s)

    def end(self, reason: str, now_s: float, *, abort: bool = False) -> None:
        """Leave the mode and put the parameters back."""
        if self.phase in {Phase.IDLE, Phase.LEAVING, Phase.RESTORING}:
            return
        if abort:
            self.refusal = self.refusal or reason
        if self.phase is Phase.WRITING:
            self._restore(now_s)
            return
        asked = self.phase is Phase.ENTERING  # it may be in it, and the next heartbeat says so
        self._sure_s = now_s + BEAT_S if asked else -math.inf
        self._go(Phase.LEAVING, now_s)

    def take(self, frame: f.ParamValue) -> None:
        """Take a parameter's value."""
        if frame.name not in NAMES:
            return
        self.known[frame.name] = number(frame, bytewise=False)
        self._kinds[frame.name] = frame.kind
        if self._queue and frame.name == self._queue[0] and math.isclose(
                self.known[frame.name], self._aims[frame.name], rel_tol=1e-5, abs_tol=1e-9):
            self._queue.pop(0)
            self._tries, self._due_s = 0, -math.inf

    @property
    def _aims(self) -> Mapping[str, float]:
        return self._target if self.phase is Phase.WRITING else self._before

    def poll(self, now_s: float) -> list[f.Frame]:  # noqa: C901
        """Say what to send now."""
        out: list[f.Frame] = []
        if self.phase in {Phase.WRITING, Phase.ENTERING, Phase.FLYING}:
            fault = self._guard.fault(self._flight, now_s) if self._guard else ''
            if self._guard and self.phase is not Phase.FLYING:  # which the mode itself ends
                fault = fault or self._guard.mode_fault(self._flight, MODE)
            if now_s - max(self._last_setpoint_s(), self._start_s) > LATEST_S:
                fault = fault or f'the schedule has been silent for {LATEST_S:g} s'
            if fault:
                self.end(fault, now_s, abort=True)
        if self.phase in {Phase.WRITING, Phase.RESTORING}:
            self._write(now_s, out)
        elif self.phase is Phase.ENTERING:
            self._enter(now_s, out)
        elif self.phase is Phase.FLYING:
            if self._flight.mode != MODE:  # which it does not by itself, once its time is over
                self.refusal = 'SYSTEM ID was left by the pilot or the autopilot'
                self._restore(now_s)
            elif now_s - self._since_s > self._end_s:
                self.end('its time is over', now_s)  # it stays in the mode, and injects no more
        elif self.phase is Phase.LEAVING:
            self._leave(now_s, out)
        return out

    def _leave(self, now_s: float, out: list[f.Frame]) -> None:
        if self._flight.mode != MODE and self._flight.beat_s > self._sure_s:
            self._restore(now_s)
        elif self._guard is not None:
            out += self._switch.poll(MODE, self._guard.mode, now_s)
            if self._flight.line_fault(now_s) and now_s >= self._due_s:
                self._due_s = now_s + REPEAT_S  # it may hear without being heard
                out.append(f.ParamSet('SID_AXIS', 0.0, kind=self._kinds['SID_AXIS']))

    def _write(self, now_s: float, out: list[f.Frame]) -> None:
        if not self._queue:
            done = self.phase is Phase.RESTORING
            self._go(Phase.IDLE if done else Phase.ENTERING, now_s)
        elif now_s >= self._due_s:
            name = self._queue[0]
            if self._tries >= TRIES and self.phase is Phase.WRITING:
                read_back = self.known.get(name, math.nan)
                self.end(f'{name}: {self._target[name]:g} was not taken, it is {read_back:g}',
                         now_s, abort=True)
                return
            self._tries, self._due_s = self._tries + 1, now_s + REPEAT_S
            out.append(f.ParamSet(name, self._aims[name], kind=self._kinds.get(name, f.REAL32)))

    def _enter(self, now_s: float, out: list[f.Frame]) -> None:
        if self._flight.mode == MODE:
            self._go(Phase.FLYING, now_s)
        elif now_s - self._since_s > ENTER_S:
            self.end(f'SYSTEM ID was not entered in {ENTER_S:g} s', now_s, abort=True)
        elif self._guard is not None:
            out += self._switch.poll(self._guard.mode, MODE, now_s)

    def _restore(self, now_s: float) -> None:
        self._queue = list(NAMES)
        self._go(Phase.RESTORING, now_s)

    def _go(self, phase: Phase, now_s: float) -> None:
        self.phase, self._since_s = phase, now_s
        self._tries, self._due_s = 0, -math.inf
        self._switch.restart()
