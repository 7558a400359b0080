"""An aircraft with PX4 or ArduPilot as the bridge asks it. No I/O; what differs is in kinds.py.

Whoever answers on the line is known by its heartbeat: `Connected` has the aircraft that it is now.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from quad_bridge.aircraft import INJECTIONS, STILL, Ability, Aircraft, Quad
from quad_bridge.autopilots.flight import FlightState
from quad_bridge.autopilots.gains import ASKED, ParameterGains
from quad_bridge.autopilots.guard import REQUEST_MESSAGE
from quad_bridge.autopilots.kinds import BY_NUMBER, Kind
from quad_bridge.autopilots.system_id import NAMES as SID_NAMES
from quad_bridge.autopilots.system_id import SystemId, sid_parameters
from quad_bridge.autopilots.takeover import Takeover
from quad_bridge.craft import AXES, Craft
from quad_bridge.link.autopilot import Inertial
from quad_bridge.wire import frames as f
from quad_bridge.wire.axes import flip_body
from quad_bridge.wire.frames import Injection, Vector3

VERSION = 148
AGAIN_S, REQUESTS = 1.0, 3
"""Between two questions for the version, and how many there are before it does without."""
SWAP_S = 10.0  # silent for so long, it may be another one that is heard then
RATE_CHANGE = 1.1  # by which the rate of the attitudes must change to count as another
OFF = 'the parameter {0} is off: read docs/{1}.md, then start the bridge with {0}:=allow'


class AutopilotAircraft(Aircraft):
    """One autopilot on the line. Times in s on a steady clock."""

    gains: ParameterGains

    def __init__(self, kind: Kind, system: int, *, allow_gains: bool, allow_excitation: bool,
                 now_s: Callable[[], float]) -> None:
        self.kind, self.flight = kind, FlightState()
        self.gains = ParameterGains(kind.table, bytewise=kind.bytewise)
        self.gains.units = self._units
        self.gains.want(*kind.reads, *(SID_NAMES if kind.system_id else ()))
        self.takeover = Takeover(kind.means, self.flight, lambda: self.gains.values)
        self.system_id = SystemId(
            self.flight, kind.means.set_mode, lambda: self.takeover.last_setpoint_s
        ) if kind.system_id else None
        self._modes = (self.takeover, *((self.system_id,) if self.system_id is not None else ()))
        self.craft: Craft | None = None
        self.version: f.Version | None = None
        self.is_another = False
        """Whether another aircraft has answered in its place."""
        if not allow_gains:
            self.gains.refused = OFF.format('gains', kind.name.lower())
        self._off = '' if allow_excitation else OFF.format('excitation', kind.name.lower())
        self.system, self._now_s = system, now_s
        self._axis, self._injection = 0, Injection.NONE
        self._refusal = ''  # why the running segment is not flown
        self._requests, self._ask_s, self._recheck_s = 0, -math.inf, -math.inf
        self.last_cycle: f.Cycle | None = None

    def describe(self, craft: Craft | None) -> None:
        """Take its craft, from which the unit of its gains follows; None says nothing of it."""
        known, self.craft = self.craft, craft or self.craft
        if craft is not None and known is not None and known.motors != craft.motors:
            self.gains.convert()

    @property
    def number(self) -> tuple[int, int]:
        """Major and minor number of the firmware; 0, 0 while it is not known."""
        word = self.version.firmware if self.version is not None else 0
        return word >> 24 & 0xFF, word >> 16 & 0xFF

    def cannot(self, ability: Ability) -> str:
        """Why it does not take such now; empty where it does."""
        name = self.kind.name
        if ability is Ability.PULSES:
            return f'{name} takes no test pulses: that it flies shows its signs'
        if ability is Ability.MOTORS:
            return f'{name} has a motor test of its own, in its ground station'
        if ability is Ability.EXCITE:
            words = self._off or self._not_flown
        else:
            words = self.gains.refused or self._pilot_fault()
        return f'{name}: {words}' if words else ''

    @property
    def _not_flown(self) -> str:
        """Why the last segment is not flown, or ended early; empty where it did not."""
        return next(filter(None, (self._refusal, *(mode.refusal for mode in self._modes))), '')

    def _pilot_fault(self) -> str:
        """Why nothing may begin now: a fresh line, a pilot's mode, hover."""
        now_s, flight = self._now_s(), self.flight
        if not self.gains.sure:
            return ASKED
        fault = flight.line_fault(now_s) or flight.sticks_fault(now_s)
        if fault:
            return fault
        if flight.mode not in self.kind.pilot_modes:
            modes = ', '.join(self.kind.pilot_modes.values())
            return f'it flies in {self.kind.mode_name(flight.mode)}: the pilot must fly ({modes})'
        return flight.hover_fault(now_s)

    def segment(self, parameters: Mapping[str, Any] | None) -> None:
        """A segment begins; None: it has ended."""
        now_s, fields = self._now_s(), parameters or {}
        axis = str(fields.get('axis', ''))
        injection = INJECTIONS.get(str(fields.get('injection', '')), Injection.NONE)
        chirp = self.system_id if fields.get('signal') == 'chirp' else None
        goes_on = self.takeover.flying and injection is self._injection and chirp is None
        if not goes_on:
            self._end('the segment has ended')
            self._injection = Injection.NONE
        if parameters is None:
            return  # why the last one was not flown stays to be read
        self._refusal = ''
        for mode in self._modes:
            mode.refusal = ''
        fault = self.cannot(Ability.EXCITE) or ('' if goes_on else self._pilot_fault())
        if axis not in AXES:
            fault = fault or f'axis {axis[:20]!r}: known are {", ".join(AXES)}'
        if not fault and chirp is not None:
            fault = chirp.fault(self.number)
            try:
                sid = sid_parameters(AXES.index(axis), injection, parameters)
            except ValueError as error:
                fault = fault or str(error)
        elif not fault:
            fault = self.takeover.fault(injection, now_s)
        if fault:
            self._refusal = fault.removeprefix(f'{self.kind.name}: ')
            return
        self._axis, self._injection = AXES.index(axis), injection
        if chirp is not None:
            chirp.begin(sid, now_s)
        else:
            self.takeover.begin(self._axis, injection, now_s)

    @property
    def at_rest(self) -> bool:
        """Whether it has its pilot's mode and its own parameters back, of trial and SYSTEM ID."""
        is_idle = all(mode.phase is type(mode.phase).IDLE for mode in self._modes)
        return is_idle and self.gains.at_rest

    def _end(self, reason: str) -> None:
        for mode in self._modes:
            mode.end(reason, self._now_s())

    def excite(self, value: Vector3, injection: Injection, valid_ms: int) -> None:
        """Take what the schedule wants now; SYSTEM ID plays its own signal."""
        del valid_ms
        if injection is self._injection:
            self.takeover.excite(flip_body(value)[self._axis], self._now_s())

    def abort(self) -> None:
        """End the excitation at once."""
        self._end('it was ended')

    # The line.

    def take(self, frame: Any, now_s: float) -> None:
        """Take a frame, arrived or stamped."""
        self.flight.take(frame, now_s)
        if isinstance(frame, f.AttitudeTarget):
            self.takeover.target(frame)
        elif isinstance(frame, f.ParamValue) and self.system_id is not None:
            self.system_id.take(frame)
        elif isinstance(frame, f.Version):
            self._hear(frame)
        elif isinstance(frame, f.Heartbeat):
            self._ask_s = min(self._ask_s, now_s)

    def _hear(self, version: f.Version) -> None:
        """Take who it says it is; where a name is sure already, the version alone."""
        if not self.gains.sure:
            uid = bytes(version.uid2).hex() if any(version.uid2) else f'{version.uid:016x}'
            name = self._name(uid if int(uid, 16) else '')
            self.is_another = self.gains.aircraft not in {'', name}
            self.gains.identify(name)
        self.version = version

    def _name(self, uid: str) -> str:
        return f'{self.kind.name.lower()}_{uid or self.system}'

    def doubt(self) -> None:
        """Ask again which aircraft it is: on the same line another may have taken its place."""
        self.gains.sure, self._requests, self._ask_s = False, 0, -math.inf
        self._recheck_s = self._now_s()

    def poll(self, now_s: float) -> list[f.Frame]:
        """Say what to send now, beside parameters."""
        out = [frame for mode in self._modes for frame in mode.poll(now_s)
               if self.gains.sure or not isinstance(frame, f.ParamSet)]
        is_alive = self.flight.beat_s >= self._recheck_s
        if not self.gains.sure and is_alive and now_s - self._ask_s > AGAIN_S:
            self._ask_s, self._requests = now_s, self._requests + 1
            if self._requests > REQUESTS and self.gains.aircraft in {'', self._name('')}:
                self.gains.identify(self._name(''))  # it never says
            else:
                out.append(f.Command(REQUEST_MESSAGE, (float(VERSION),)))
        return out

    def cycle(self, frame: Inertial, now_s: float) -> f.Cycle | None:
        """A control cycle from one of its attitudes and the latest other messages."""
        self.flight.inertial(frame, now_s)
        flying = any(mode.flying for mode in self._modes)
        flags = f.Flag.EXCITATION if flying else f.Flag.NONE
        if self._not_flown:
            flags |= f.Flag.EXCITATION_REFUSED
        rate_hz, known_hz = self.flight.rate_hz, self.gains.cycles_hz
        if rate_hz and not 1.0 / RATE_CHANGE < (known_hz or rate_hz * 2.0) / rate_hz < RATE_CHANGE:
            self.gains.cycles_hz = rate_hz
        injection = self._injection if self.takeover.flying else Injection.NONE
        added = self.takeover.applied if self.takeover.flying else STILL
        cycle = self.flight.cycle(frame, now_s, added, injection, flags)
        self.last_cycle = cycle or self.last_cycle
        return cycle

    def _units(self, known: Mapping[str, float]) -> tuple[float, float, float] | None:
        return None if self.craft is None else self.kind.units(self.craft, known)


class Connected:
    """The aircraft on the line, whichever it is: ours until a heartbeat says otherwise."""

    def __init__(self, standard: Callable[[], str], now_s: Callable[[], float],
                 *, allow_gains: bool, allow_excitation: bool) -> None:
        self._quad = Quad(standard)
        self.aircraft: Aircraft = self._quad
        self.autopilot: AutopilotAircraft | None = None
        """It, where it is no aircraft of ours."""
        self.on_change: Callable[[Aircraft], None] = lambda _: None
        self._allow = {'allow_gains': allow_gains, 'allow_excitation': allow_excitation}
        self._now_s, self._last_s = now_s, -math.inf

    @property
    def last_cycle(self) -> f.Cycle | None:
        """Substitute for its last control cycle; None where it sends cycles of the contract."""
        return self.autopilot.last_cycle if self.autopilot is not None else None

    @property
    def has_gains(self) -> bool:
        """Whether its parameters are gains that the bridge keeps."""
        return self.autopilot is not None or not self._quad.cannot(Ability.GAINS)

    def take(self, frame: Any, now_s: float) -> None:
        """Take a frame; a heartbeat says who it is."""
        if self.autopilot is not None and now_s - self._last_s > SWAP_S:
            self.autopilot.doubt()
            self.autopilot.gains.restart()  # what is known of its parameters may be another's
        self._last_s = now_s
        if isinstance(frame, f.Heartbeat):
            self._meet(BY_NUMBER.get(frame.autopilot), frame.system)
        if self.autopilot is None:
            return
        self.autopilot.take(frame, now_s)
        if self.autopilot.is_another:
            self._use(self.autopilot.kind, self.autopilot.system)
            self.autopilot.take(frame, now_s)

    def doubt(self) -> None:
        """Write nothing more until the aircraft has said again which one it is.

        What it flies goes on, and the way back of a trial waits for the answer; of another
        aircraft's trial the disk knows.
        """
        if self.autopilot is not None:
            self.autopilot.doubt()

    def _meet(self, kind: Kind | None, system: int) -> None:
        known = self.autopilot
        if (known.kind, known.system) != (kind, system) if known is not None else kind is not None:
            self._use(kind, system)

    def _use(self, kind: Kind | None, system: int) -> None:
        if self.autopilot is not None:
            self.autopilot.abort()
        self.autopilot = None if kind is None else AutopilotAircraft(
            kind, system, now_s=self._now_s, **self._allow
        )
        self.aircraft = self.autopilot or self._quad
        self.on_change(self.aircraft)

    def poll(self, now_s: float) -> list[f.Frame]:
        """Say what to send now, beside parameters."""
        return self.autopilot.poll(now_s) if self.autopilot is not None else []
