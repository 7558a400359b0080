"""Excitation by attitude set-points: PX4's OFFBOARD, ArduPilot's GUIDED_NOGPS. Pure, no I/O.

The bridge flies the aircraft meanwhile: at the heading and about the height and place that it had,
with the schedule on one axis. It begins only where `fault` says nothing, streams before it asks
for the mode, and gives the mode from before back at the end, or as soon as anything is not as it
was (guard.py). Where the mode is not given back, it falls silent after LEAVE_S, since the
autopilot's own loss of set-points acts only then:

PX4 leaves OFFBOARD after COM_OF_LOSS_T for the first of Position, Altitude and Stabilized that it
can fly. While it is streamed to, it stays in OFFBOARD, with a throttle that nobody corrects.
ArduPilot stays in GUIDED_NOGPS, and levels and holds its height after GUID_TIMEOUT, 3 s.
Until then both follow the last set-point, so the last ones are level, at the hover throttle.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

from quad_bridge.autopilots.flight import HEIGHT_S, FlightState, wrapped
from quad_bridge.autopilots.guard import Guard, ModeSwitch
from quad_bridge.wire import frames as f
from quad_bridge.wire.axes import angles_of, quaternion
from quad_bridge.wire.frames import Injection, Vector3

PERIOD_S = 0.01  # between two set-points; the autopilots want them at 50 Hz or faster
STREAM_S = 1.2  # of set-points before the mode is asked for
ENTER_S = 3.0  # until the mode must be there
LEAVE_S, LEVEL_S = 3.0, 0.5  # of set-points without the mode back; the last of them are level
BEAT_S = 1.5  # heartbeats, which tell the mode, come once a second
HEIGHT_GAIN, CLIMB_GAIN, MOST_THRUST = 0.05, 0.06, 0.12
PLACE_GAIN, SPEED_GAIN, MOST_LEAN = 0.06, 0.11, math.radians(8.0)
"""rad per m and per m/s: slower than what is excited; without it PX4 had drifted 5 m in 20 s."""
PLACE_S = 0.5  # a place that is older is not known
ANGLE_GAIN = 5.0  # 1/s, of the angle loop where rates are sent
LATEST_S = 0.25  # the schedule has fallen silent
ATTITUDE_MASK, RATE_MASK = 7, 128
ZERO: Vector3 = (0.0, 0.0, 0.0)
# from a hover the guard's tilt is not reached by the excitation alone
MOST = {Injection.ATTITUDE: math.radians(20.0), Injection.RATE: math.radians(200.0)}


class Phase(Enum):
    """State of the takeover."""

    IDLE = 'idle'
    STREAMING = 'streaming before the switch'
    ENTERING = 'asking for the mode'
    FLYING = 'flying the schedule'
    LEAVING = 'giving the mode back'


@dataclass(frozen=True)
class Means:
    """Mode and messages with which an autopilot flies set-points."""

    mode: int
    name: str
    set_mode: Callable[[int], f.Command]
    climb: bool = False
    """Whether the thrust is a climb rate, 0.5 for none."""
    throttle_bit: tuple[str, int] | None = None
    """Parameter and bit that make a throttle of this climb rate: 0.5 would be half of it."""


class Takeover:
    """One segment at a time. Times in s on a steady clock; vectors FRD."""

    def __init__(self, means: Means, flight: FlightState,
                 known: Callable[[], Mapping[str, float]]) -> None:
        """`known`: the autopilot's parameters, as far as they are read."""
        self.phase = Phase.IDLE
        self.refusal = ''
        """Why the last segment did not begin, or ended early; empty until then."""
        self.applied: Vector3 = ZERO
        """What the autopilot's own words say was added, FRD."""
        self.injection = Injection.NONE
        self._means, self._flight, self._known = means, flight, known
        self._start: Guard | None = None
        self._throttle = 0.0
        self._switch = ModeSwitch(flight, means.set_mode)
        self._axis = 0
        self._excitation, self.last_setpoint_s = 0.0, -math.inf
        """The last set-point, and when the schedule was heard last, also beside SYSTEM ID."""
        self._since_s = self._sent_s = -math.inf
        self._sent: deque[tuple[float, Vector3, Vector3]] = deque(maxlen=64)
        """When, the set-point in the unit of the injection, and its part without excitation."""

    @property
    def flying(self) -> bool:
        """Whether the schedule is flown now."""
        return self.phase is Phase.FLYING

    def begin(self, axis: int, injection: Injection, now_s: float) -> None:
        """Begin a segment on one axis that `fault` lets begin; in flight the next one follows."""
        flight = self._flight
        if self.phase is Phase.FLYING:
            self._axis, self._excitation, self.last_setpoint_s = axis, 0.0, now_s
            return
        throttle = 0.5 if self._means.climb else flight.hover_throttle(now_s)
        if throttle is None or flight.mode is None or flight.angles is None:
            self.refusal = 'the throttle with which it hovers is not known'
            return
        self.refusal, self._axis, self.injection = '', axis, injection
        self._start, self._throttle = Guard.of(flight), throttle
        self._excitation, self.last_setpoint_s = 0.0, now_s
        self._sent.clear()
        self._go(Phase.STREAMING, now_s)

    def fault(self, injection: Injection, now_s: float) -> str:
        """Why no segment may begin beside what the aircraft's own rules say."""
        if injection not in MOST:
            injections = ' or '.join(i.name.lower() for i in MOST)
            return f'{self._means.name} takes an injection of {injections}'
        if self._means.throttle_bit is not None:
            name, bit = self._means.throttle_bit
            value = self._known().get(name)
            if value is None:
                return f'{name} is not read: with its bit {bit} no climb would be half throttle'
            if int(value) & 1 << bit:
                return (f'{name} is {value:g}: with its bit {bit} no climb is half throttle; set '
                        f'it to {int(value) & ~(1 << bit)}')
        if not self._means.climb:
            if now_s - self._flight.height_s > HEIGHT_S:
                return 'its height is not known: neither LOCAL_POSITION_NED nor a barometer comes'
            if self._flight.hover_throttle(now_s) is None:
                return ('the throttle with which it hovers is not known: ATTITUDE_TARGET must '
                        'come, and 2 s of hover')
        return ''

    def excite(self, value: float, now_s: float) -> None:
        """Set what is to be added to the axis now."""
        most = MOST.get(self.injection, 0.0)
        self._excitation, self.last_setpoint_s = min(max(value, -most), most), now_s

    def end(self, reason: str, now_s: float, *, abort: bool = False) -> None:
        """Give the mode back."""
        if self.phase is Phase.IDLE:
            return
        if abort:
            self.refusal = self.refusal or reason
        self._excitation = 0.0
        entered = self.phase in {Phase.FLYING, Phase.ENTERING}
        is_our_mode = self._flight.mode == self._means.mode
        switched = self.phase is Phase.FLYING and not is_our_mode  # to another's mode
        if self.phase is not Phase.LEAVING:
            self._go(Phase.LEAVING if entered and not switched else Phase.IDLE, now_s)

    def target(self, reported: f.AttitudeTarget) -> None:
        """Take what the autopilot follows: what it is beyond our own reference was added."""
        self.applied = ZERO
        if self.phase is not Phase.FLYING or not self._sent:
            return
        rate = self.injection is Injection.RATE  # beside rates, attitude and time are stale
        reported_motion = reported.rates if rate else angles_of(reported.q)
        _, _, reference = min(
            self._sent,
            key=lambda sent: sum(abs(d) for d in self._differ(reported_motion, sent[1], rate=rate))
        )
        added = self._differ(reported_motion, reference, rate=rate)
        self.applied = tuple(added[i] if i == self._axis else 0.0 for i in range(3))  # type: ignore[assignment]

    def poll(self, now_s: float) -> list[f.Frame]:
        """Say what to send now."""
        start = self._start
        if self.phase is Phase.IDLE or start is None:
            return []
        out: list[f.Frame] = []
        self._step(start, now_s, out)
        leaves = self.phase is Phase.LEAVING and now_s - self._since_s > LEAVE_S
        if now_s - self._sent_s >= PERIOD_S and self._start is not None and not leaves:
            self._sent_s = now_s
            out.append(self._set_point(start, now_s))
        return out

    def _step(self, start: Guard, now_s: float, out: list[f.Frame]) -> None:
        mode, since_s = self._flight.mode, now_s - self._since_s
        if self.phase is Phase.LEAVING:
            self._leave(start, now_s, out)
            return
        fault = self._abort_fault(start, now_s)
        if fault:
            self.end(fault, now_s, abort=True)
            self._leave(start, now_s, out)
        elif self.phase is Phase.STREAMING:
            if mode == self._means.mode:  # by the pilot's switch
                self._go(Phase.FLYING, now_s)
            elif since_s >= STREAM_S:
                self._go(Phase.ENTERING, now_s)
        elif self.phase is Phase.ENTERING:
            if mode == self._means.mode:
                self._go(Phase.FLYING, now_s)
            elif since_s > ENTER_S:
                self.end(f'{self._means.name} was not entered in {ENTER_S:g} s', now_s, abort=True)
            else:
                out += self._switch.poll(start.mode, self._means.mode, now_s)

    def _leave(self, start: Guard, now_s: float, out: list[f.Frame]) -> None:
        """Ask for the mode from before, until it is no longer ours or somebody's."""
        if self.phase is not Phase.LEAVING:
            return
        if self._flight.mode != self._means.mode and self._flight.beat_s > self._since_s + BEAT_S:
            self._go(Phase.IDLE, now_s)
        else:
            out += self._switch.poll(self._means.mode, start.mode, now_s)

    def _abort_fault(self, start: Guard, now_s: float) -> str:
        """Why the segment must end now."""
        flight = self._flight
        fault = start.fault(flight, now_s)
        if fault:
            return fault
        if self.phase is Phase.FLYING and flight.mode != self._means.mode:
            return f'{self._means.name} was left by the pilot or the autopilot'
        if self.phase is Phase.FLYING and now_s - self.last_setpoint_s > LATEST_S:
            return f'the schedule has been silent for {LATEST_S:g} s'
        return start.mode_fault(flight, self._means.mode)

    def _set_point(self, start: Guard, now_s: float) -> f.SetAttitudeTarget:
        flight = self._flight
        excitation = self._excitation if self.phase is Phase.FLYING else 0.0
        added = [excitation if i == self._axis else 0.0 for i in range(3)]
        ends = self.phase is Phase.LEAVING and now_s - self._since_s > LEAVE_S - LEVEL_S
        lean = (0.0, 0.0) if ends else self._lean(start, now_s)
        level = (*lean, start.yaw)
        rate = self.injection is Injection.RATE and not ends
        reference: Vector3 = level
        if rate and flight.angles is not None:
            turn = self._differ(level, flight.angles, rate=False)
            reference = (ANGLE_GAIN * turn[0], ANGLE_GAIN * turn[1], 0.5 * ANGLE_GAIN * turn[2])
        total = (reference[0] + added[0], reference[1] + added[1], reference[2] + added[2])
        self._sent.append((now_s, total, reference))
        x, y, z, w = quaternion(level if rate else total)
        rates = total if rate else ZERO
        mask = RATE_MASK if rate else ATTITUDE_MASK
        return f.SetAttitudeTarget(int(1000 * now_s) % 2**32, mask, (w, x, y, z), rates,
                                   self._throttle if ends else self._thrust(start, now_s))

    def _lean(self, start: Guard, now_s: float) -> tuple[float, float]:
        """Roll and pitch, back to where it began; 0 where no place is known."""
        flight = self._flight
        place, speed, angles = flight.place, flight.speed, flight.angles
        if start.place is None or place is None or speed is None or angles is None or (
            now_s - flight.place_s > PLACE_S
        ):
            return 0.0, 0.0
        north, east = (PLACE_GAIN * (start.place[i] - place[i]) - SPEED_GAIN * speed[i]
                       for i in (0, 1))
        c, s = math.cos(angles[2]), math.sin(angles[2])
        roll, pitch = c * east - s * north, -(c * north + s * east)
        return (min(max(roll, -MOST_LEAN), MOST_LEAN), min(max(pitch, -MOST_LEAN), MOST_LEAN))

    def _thrust(self, start: Guard, now_s: float) -> float:
        flight, off = self._flight, 0.0
        if self._means.climb:
            return self._throttle
        if (start.height_m is not None and flight.height_m is not None
                and start.has_height(flight, now_s)):
            off = HEIGHT_GAIN * (start.height_m - flight.height_m) - CLIMB_GAIN * flight.climb_m_s
        if flight.angles is not None:  # what leans lifts less
            upright = math.cos(flight.angles[0]) * math.cos(flight.angles[1])
            off += self._throttle * (1.0 / max(upright, 0.8) - 1.0)
        return self._throttle + min(max(off, -MOST_THRUST), MOST_THRUST)

    @staticmethod
    def _differ(a: Vector3, b: Vector3, *, rate: bool) -> Vector3:
        by = (a[0] - b[0], a[1] - b[1], a[2] - b[2])
        return by if rate else wrapped(by)

    def _go(self, phase: Phase, now_s: float) -> None:
        self.phase, self._since_s = phase, now_s
        self._switch.restart()
        if phase is Phase.IDLE:
            self.applied, self._start = ZERO, None
