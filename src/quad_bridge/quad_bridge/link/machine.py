"""The link without I/O: `receive` returns events, `to_send` the bytes to send.

Events come in order: what arrived, what was stamped, that the aircraft has restarted. All times
are ns of one steady host clock. Not thread-safe: the node holds a lock around it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from quad_bridge.link.autopilot import (
    BATTERY,
    GENERIC,
    LINE_SHARE,
    MOTORS,
    ROTORS,
    STICKS,
    Autopilot,
    name_of,
)
from quad_bridge.link.parameters import Parameters
from quad_bridge.link.stamping import Arrived, Described, Event, Restarted, Stamping
from quad_bridge.wire import frames as f
from quad_bridge.wire.codec import NO_AUTOPILOT, Decoder, Encoder
from quad_bridge.wire.signing import Signing

BRIDGE_SYSTEM, BRIDGE_COMPONENT = 1, 191
ONBOARD_CONTROLLER = 18  # MAV_TYPE
ADDRESSED = (
    f.Command, f.Excitation, f.GainsCommand, f.ParamRequestList, f.ParamRequestRead, f.ParamSet,
    f.SetAttitudeTarget, f.LogRequestList, f.LogRequestData, f.LogRequestEnd,
)  # fmt: skip
_HANDED_ON = (f.GainsState, f.CommandAck, f.StatusText, f.Version, f.LogEntry, f.LogData)
_STREAMED = {
    f.AttitudeTarget: 'ATTITUDE_TARGET', f.LocalPosition: 'LOCAL_POSITION_NED',
    f.LandedState: 'EXTENDED_SYS_STATE',
}  # fmt: skip
"""Frames that an autopilot streams, handed on as they come, and their messages."""
HEARTBEAT_NS = 1_000_000_000
SYNC_NS, SOON_NS = 200_000_000, 40_000_000
"""Between TIMESYNC questions once the clock has converged, and before."""
URGENT_NS = 20_000_000  # between questions while cycles wait for an answer
NO_CYCLE_NS = 1_000_000_000  # an autopilot without a QUAD_CYCLE for so long sends none
RELEASE_NS = 3_000_000_000  # silent for so long, an aircraft may be followed by another one
CYCLE_OLD_NS, PEER_OLD_NS = 500_000_000, 2_500_000_000
"""Age above which a cycle, or without cycles a heartbeat, no longer counts."""
SAME_START_NS = 2_000_000_000
"""Starts that differ by less are one: the clocks drift, and the last bytes may have come late."""
WRAP_NS = 1000 << 32
RESTART_US = 1_000_000  # an autopilot's time that goes back by more: it has started anew
QUESTIONS = 64  # requests of TIMESYNC whose answers still count


class Link:
    """State of the conversation with the aircraft."""

    def __init__(
        self, signing: Signing | None = None, one_clock_ns: int | None = None,
        baud: int | None = None,
    ) -> None:  # fmt: skip
        """`one_clock_ns`: host minus device time where both are one clock, as in lockstep.

        `baud` of a serial line, where the port is one.
        """
        self._one_clock_ns = one_clock_ns
        self.decoder = Decoder(signing, own=(BRIDGE_SYSTEM, BRIDGE_COMPONENT))
        self.stamping = Stamping(self._restarted_unseen)
        self.clock = self.stamping.clock
        self.peer: f.Heartbeat | None = None
        self.autopilot = Autopilot(math.inf if baud is None else LINE_SHARE * baud / 10.0)
        """The decoder of an aircraft that sends standard messages only."""
        self.parameters: Parameters | None = None  # those of such an autopilot
        self._described: int | None = None  # how many of them were known when it was described
        self._ask_ns = 0
        self.last_cycle: f.Cycle | None = None
        self.last_cycle_ns = 0  # host time at which the last cycle arrived
        self.cycles = 0
        self._encoder = Encoder(BRIDGE_SYSTEM, BRIDGE_COMPONENT, signing)
        self._outbox = bytearray()
        self._restarts = 0
        self._inertial_us = 0  # an autopilot's time when it last sent its rates
        self._received_us = 0  # the same of all that it sends with angles or rates
        self._started_ns: int | None = None
        """When the aircraft had started that was heard before the port was opened anew."""
        self._peer_since_ns = 0
        self.answered_ns = 0  # when TIMESYNC was last answered
        self._received_ns = self._peer_ns = 0
        self._next_heartbeat_ns = 0
        self._next_sync_ns = self._next_urgent_ns = 0
        self._questions: deque[int] = deque(maxlen=QUESTIONS)
        """Times of our own requests: the line may also carry answers to others."""
        self._takes: dict[type, Callable[[Any, int], None]] = {
            **dict.fromkeys(_HANDED_ON, self._arrived),
            **dict.fromkeys(_STREAMED, self._streamed),
            f.Cycle: self._cycle,
            f.RcChannels: self._sticks,
            f.SlowSensors: self._slow_sensors,
            f.Battery: self._battery,
            f.Attitude: self._inertial,
            f.Outputs: self._outputs,
            f.RotorSpeeds: self._rotors,
            f.ParamValue: self._parameter,
            f.TimeSync: self._time_sync,
            f.Heartbeat: self._heartbeat,
            f.Standard: lambda frame, _: self.autopilot.note(frame.name),
        }

    @property
    def received_us(self) -> int | None:
        """The aircraft's time when it was last heard of in a cycle, or in what stands for one."""
        if self.last_cycle is not None:
            return self.last_cycle.time_us
        return self._received_us or None

    @property
    def armed(self) -> bool:
        """Whether the aircraft was armed when it was last heard."""
        if self.last_cycle is not None:
            return bool(self.last_cycle.flags & f.Flag.ARMED)
        return self.peer is not None and self.peer.armed

    @property
    def name(self) -> str:
        """The aircraft's name in messages: by its heartbeat, where it sends no control cycles."""
        if self.last_cycle is not None:
            return 'the STM32'
        if self.peer is None:
            return 'the aircraft'
        if self.autopilot.betaflight:
            return 'Betaflight'
        return name_of(self.peer) or 'the autopilot'

    def armed_lately(self, now_ns: int) -> bool | None:
        """Whether it is armed by a cycle, else a heartbeat, of just now; None without any."""
        if self.last_cycle is not None:
            is_recent = now_ns - self.last_cycle_ns < CYCLE_OLD_NS
        else:
            is_recent = self.peer is not None and now_ns - self._peer_ns < PEER_OLD_NS
        return self.armed if is_recent else None

    def opened(self) -> None:
        """Reset after opening the port; the aircraft may be another one."""
        if self.last_cycle is not None:
            self._started_ns = self.last_cycle_ns - 1000 * self.last_cycle.time_us
        self.decoder.resync()
        self.stamping.restart()
        self._forget_autopilot()
        self.last_cycle = None
        self._outbox.clear()

    def receive(self, data: bytes, now_ns: int) -> list[Event]:
        """Events of `data`, which arrived at `now_ns`, and of frames that can now be stamped."""
        events: list[Event] = []
        self.stamping.out = events
        frames = self.decoder.feed(data)
        if frames:
            self._received_ns = now_ns
        for frame in frames:
            take = self._takes.get(type(frame))
            if take is not None:
                take(frame, now_ns)
        self.tick(now_ns)
        if self.parameters is None or self.peer is None:
            return events
        count = len(self.parameters.values)
        if count != self._described and self.parameters.complete:
            self._described = count
            events.append(Described(self.peer, dict(self.parameters.values)))
        return events

    def tick(self, now_ns: int) -> None:
        """Put into the outbox what is due: heartbeat, TIMESYNC, requests to an autopilot.

        `receive` does it too; where nothing arrives it is to be called some times a second.
        """
        if self.decoder.peer is not None and now_ns - self._received_ns > RELEASE_NS:
            self.decoder.release()
        if now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + HEARTBEAT_NS
            self.send(f.Heartbeat(ONBOARD_CONTROLLER, NO_AUTOPILOT))
        if now_ns >= self._next_sync_ns:
            calm = self.clock.converged and not self.clock.doubtful
            self._next_sync_ns = now_ns + (SYNC_NS if calm else SOON_NS)
            self._ask_time(now_ns)
        if self.standard_only(now_ns):
            for command in self.autopilot.due(now_ns):
                self.send(command)
            self._ask_parameters(now_ns)

    def standard_only(self, now_ns: int) -> bool:
        """Whether an autopilot is there that has sent no control cycle, or is known for that."""
        if self.peer is None or self.last_cycle is not None:
            return False
        return bool(name_of(self.peer)) or now_ns - self._peer_since_ns > NO_CYCLE_NS

    def send(self, frame: f.Frame) -> None:
        """Queue a frame, addressed to the peer where the message has an address."""
        peer = self.peer
        if peer is not None and isinstance(frame, ADDRESSED):
            frame = replace(frame, target_system=peer.system, target_component=peer.component)
        self._outbox += self._encoder.encode(frame)

    def to_send(self) -> bytes:
        """Bytes to send now, each asked for once."""
        data = bytes(self._outbox)
        self._outbox.clear()
        return data

    def _cycle(self, frame: f.Cycle, now_ns: int) -> None:
        restarts = self.decoder.counts.restarts
        if self.peer is not None and self.decoder.peer != (self.peer.system, self.peer.component):
            self._restarted()  # what was known was of one that had sent no cycle
            self._forget_autopilot()
        if restarts != self._restarts:
            self._restarts = restarts
            self._restarted()
        elif self._started_ns is not None and self._moved(frame, now_ns, self._started_ns):
            self._restarted_unseen()
        self._started_ns = None
        self.cycles += 1
        self.last_cycle = frame
        self.last_cycle_ns = now_ns
        self.stamping.out.append(Arrived(frame))
        self.stamping.cycle(frame, now_ns)
        self._ask_urgently(now_ns)

    @staticmethod
    def _moved(frame: f.Cycle, now_ns: int, started_ns: int) -> bool:
        """Whether the aircraft has started at another time; its µs may wrap at 32 bits."""
        offset_ns = now_ns - 1000 * frame.time_us - started_ns
        return abs((offset_ns + WRAP_NS // 2) % WRAP_NS - WRAP_NS // 2) > SAME_START_NS

    def _ask_urgently(self, now_ns: int) -> None:
        if self.stamping.asks and now_ns >= self._next_urgent_ns:
            self._next_urgent_ns = now_ns + URGENT_NS
            self._ask_time(now_ns)

    def _ask_time(self, now_ns: int) -> None:
        self._questions.append(now_ns)
        self.send(f.TimeSync(0, now_ns))

    def _ask_parameters(self, now_ns: int) -> None:
        if self.peer is None or now_ns < self._ask_ns:
            return
        if self.parameters is None:
            self.parameters = Parameters(self.peer)
        for request in self.parameters.due(now_ns):
            self.send(request)
        if self.parameters.complete:  # it looks rarely for what has not answered
            self._ask_ns = now_ns + HEARTBEAT_NS

    def describe_again(self) -> None:
        """Learn an autopilot's messages and parameters anew, since it is another one."""
        self.parameters, self._described, self._ask_ns = None, None, 0
        self.autopilot.clear()

    def _forget_autopilot(self) -> None:
        self.peer = None
        self.describe_again()

    def _arrived(self, frame: Any, _now_ns: int) -> None:
        self.stamping.out.append(Arrived(frame))

    def _streamed(self, frame: Any, now_ns: int) -> None:
        self.autopilot.note(_STREAMED[type(frame)])
        self._arrived(frame, now_ns)

    def _sticks(self, frame: f.RcChannels, now_ns: int) -> None:
        channels = self.parameters.channels if self.parameters is not None else ()
        sticks = self.autopilot.sticks(frame, now_ns, channels)
        if sticks is not None:
            self._arrived(sticks, now_ns)
            if frame.time_ms is None:
                self.stamping.untimed(STICKS, sticks)
            else:
                self.stamping.other(STICKS, sticks, frame.time_ms * 1000, 1000, now_ns)

    def _slow_sensors(self, frame: f.SlowSensors, now_ns: int) -> None:
        self._inertial(frame, now_ns)
        grain_us = 1 if frame.name == 'HIGHRES_IMU' else 1000
        for topic, part in self.autopilot.slow(frame, now_ns):
            self.stamping.other(topic, part, frame.time_us, grain_us, now_ns)

    def _battery(self, frame: f.Battery, now_ns: int) -> None:
        if self.autopilot.battery(frame, now_ns):
            self.stamping.untimed(BATTERY, frame)

    def _outputs(self, frame: f.Outputs, now_ns: int) -> None:
        is_known = self._described is not None and self.last_cycle is None
        if self.autopilot.outputs(frame, now_ns) and is_known:
            self.stamping.other(MOTORS, frame, frame.time_us, 1, now_ns, bits=32)

    def _rotors(self, frame: f.RotorSpeeds, now_ns: int) -> None:
        speeds = self.autopilot.rotors(frame, now_ns)
        if speeds is None or self._described is None:
            return
        if speeds.time_us is None:
            self.stamping.untimed(ROTORS, speeds)
        else:
            self.stamping.other(ROTORS, speeds, speeds.time_us, 1, now_ns)

    def _parameter(self, frame: f.ParamValue, now_ns: int) -> None:
        self._arrived(frame, now_ns)
        if self.standard_only(now_ns) and self.parameters is not None:
            self.parameters.take(frame)

    def _heartbeat(self, frame: f.Heartbeat, now_ns: int) -> None:
        if frame.autopilot != NO_AUTOPILOT:
            if self.peer is None:
                self._peer_since_ns = now_ns
            self.peer, self._peer_ns = frame, now_ns
            self.autopilot.generic = frame.autopilot == GENERIC
            self._arrived(frame, now_ns)

    def _inertial(self, frame: f.Attitude | f.SlowSensors, now_ns: int) -> None:
        """Events of another autopilot's messages; none once a control cycle was received."""
        self._received_us = (1000 * frame.time_ms if isinstance(frame, f.Attitude)
                             else frame.time_us)
        if self.last_cycle is not None:
            return
        inertial = self.autopilot.inertial(frame, now_ns)
        if inertial is None:
            return
        before_us, self._inertial_us = self._inertial_us, inertial.time_us
        if inertial.time_us < before_us - RESTART_US:
            self.autopilot.restarted()
        self.stamping.inertial(inertial, now_ns)
        self._ask_urgently(now_ns)

    def _time_sync(self, frame: f.TimeSync, now_ns: int) -> None:
        if frame.tc1_ns == 0:
            self.send(f.TimeSync(now_ns, frame.ts1_ns))
        elif frame.ts1_ns in self._questions:
            self.answered_ns = now_ns
            sent_ns, received_ns = frame.ts1_ns, now_ns
            if self._one_clock_ns is not None:
                sent_ns = received_ns = frame.tc1_ns + self._one_clock_ns
            self.stamping.trip(sent_ns, frame.tc1_ns, received_ns)

    def _restarted_unseen(self) -> None:
        self.decoder.counts.restarts += 1  # which the cycle counter has not shown
        self._restarts = self.decoder.counts.restarts
        self.stamping.out.append(Restarted())

    def _restarted(self) -> None:
        self.stamping.restart()
        self.stamping.out.append(Restarted())
