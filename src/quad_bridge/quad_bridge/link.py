"""What the bridge knows of the far end: decoder, clock and parameters put together. No I/O.

Bytes and ticks go in, frames with stamps come out, and what is to be sent waits in `drain`. All
times are ns of one steady host clock. Not thread-safe: the node holds a lock around it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from quad_bridge.gain_line import GainLine
from quad_bridge.wire.clock import ClockEstimator
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.frames import (
    Attitude,
    Battery,
    Command,
    CommandAck,
    Cycle,
    Excitation,
    Frame,
    GainsCommand,
    GainsState,
    Heartbeat,
    ParamRequestList,
    ParamRequestRead,
    ParamSet,
    ParamValue,
    RcChannels,
    SlowSensors,
    Standard,
    StatusText,
    TimeSync,
)
from quad_bridge.wire.signing import Signing

BRIDGE_SYSTEM, BRIDGE_COMPONENT = 1, 191
ONBOARD_CONTROLLER, NO_AUTOPILOT = 18, 8
ADDRESSED = (Command, Excitation, GainsCommand, ParamRequestList, ParamRequestRead, ParamSet)
HEARTBEAT_NS = 1_000_000_000
SYNC_NS = 200_000_000
"""Between TIMESYNC questions once the clock has converged; before, every tick asks."""


@dataclass(frozen=True)
class Stamped:
    """A frame for a topic with its host time; `stamp_ns` is None where it has no time."""

    frame: Cycle | RcChannels | Battery | SlowSensors | StatusText
    stamp_ns: int | None


class Link:
    """State of the conversation with the STM32."""

    def __init__(self, signing: Signing | None = None) -> None:
        self.on_ack: Callable[[CommandAck], None] = lambda _frame: None
        """Called for the answer to a command."""
        self.on_cycle: Callable[[Cycle, int], None] = lambda _frame, _now_ns: None
        """Called for every cycle, also those that are held back for want of a clock."""
        self.decoder = Decoder(signing, own=(BRIDGE_SYSTEM, BRIDGE_COMPONENT))
        self.clock = ClockEstimator()
        self.gains = GainLine()
        self.peer: Heartbeat | None = None
        self.standard_names: set[str] = set()
        """Standard messages seen that the bridge does not use."""
        self.last_cycle: Cycle | None = None
        self.last_cycle_ns = 0
        """Host time at which the last cycle arrived."""
        self.cycles = 0
        self.held = 0
        """Cycles not published because the clock had not converged."""
        self._encoder = Encoder(BRIDGE_SYSTEM, BRIDGE_COMPONENT, signing)
        self._outbox = bytearray()
        self._stamp_ns = 0
        self._restarts = 0
        self._next_heartbeat_ns = 0
        self._next_sync_ns = 0

    def opened(self) -> None:
        """Start afresh: the port was opened, the far end may be another one."""
        self.decoder.resync()
        self._far_end_restarted()
        self.peer = None
        self.standard_names.clear()
        self.last_cycle = None
        self._outbox.clear()

    def receive(self, data: bytes, now_ns: int) -> list[Stamped]:
        """Frames for topics out of `data`, which arrived at `now_ns`."""
        out: list[Stamped] = []
        for frame in self.decoder.feed(data):
            if isinstance(frame, Cycle):
                self._cycle(frame, now_ns, out)
            else:
                self._other(frame, now_ns, out)
        return out

    def tick(self, now_ns: int) -> None:
        """Put into the outbox what is due: heartbeat, TIMESYNC, parameter requests, repeats."""
        if now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + HEARTBEAT_NS
            self.send(Heartbeat(ONBOARD_CONTROLLER, NO_AUTOPILOT))
        if now_ns >= self._next_sync_ns:
            self._next_sync_ns = now_ns + SYNC_NS if self.clock.converged else now_ns
            self.send(TimeSync(0, now_ns))
        self.poll_gains(now_ns)

    def poll_gains(self, now_ns: int) -> None:
        """Put into the outbox what the parameters' state machine wants to send."""
        for request in self.gains.poll(1e-9 * now_ns):
            self.send(request)

    def send(self, frame: Frame) -> None:
        """Queue a frame, addressed to the peer where the message has an address."""
        peer = self.peer
        if peer is not None and isinstance(frame, ADDRESSED):
            frame = replace(frame, target_system=peer.system, target_component=peer.component)
        self._outbox += self._encoder.encode(frame)

    def drain(self) -> bytes:
        """Bytes to send now; the outbox is empty afterwards."""
        data = bytes(self._outbox)
        self._outbox.clear()
        return data

    def _cycle(self, frame: Cycle, now_ns: int, out: list[Stamped]) -> None:
        restarts = self.decoder.restarts
        if restarts != self._restarts:
            self._restarts = restarts
            self._far_end_restarted()
        self.cycles += 1
        self.last_cycle = frame
        self.last_cycle_ns = now_ns
        self.on_cycle(frame, now_ns)
        if not self.clock.converged:
            self.held += 1
            return
        self._stamp_ns = self.clock.host_ns(1000 * frame.time_us)
        out.append(Stamped(frame, self._stamp_ns))

    def _other(self, frame: Frame, now_ns: int, out: list[Stamped]) -> None:
        if isinstance(frame, (RcChannels, SlowSensors, Battery, StatusText)):
            self._for_topic(frame, out)
        elif isinstance(frame, TimeSync):
            self._time_sync(frame, now_ns)
        elif isinstance(frame, (ParamValue, GainsState)):
            self.gains.take(frame, 1e-9 * now_ns)
            self.poll_gains(now_ns)
        elif isinstance(frame, CommandAck):
            self.on_ack(frame)
        elif isinstance(frame, Heartbeat):
            if frame.autopilot != NO_AUTOPILOT:
                self.peer = frame
        elif isinstance(frame, Standard):
            self.standard_names.add(frame.name)
        elif isinstance(frame, Attitude):
            self.standard_names.add('ATTITUDE')

    def _for_topic(
        self, frame: RcChannels | SlowSensors | Battery | StatusText, out: list[Stamped]
    ) -> None:
        if isinstance(frame, SlowSensors) and frame.gyro is not None:
            self.standard_names.add('HIGHRES_IMU')
        if isinstance(frame, StatusText):
            out.append(Stamped(frame, None))
        elif isinstance(frame, RcChannels):
            self._stamped(frame, frame.time_ms * 1000, 1000, out)
        elif isinstance(frame, SlowSensors):
            self._stamped(frame, frame.time_us, 1, out)
        elif self.clock.converged and self.last_cycle is not None:
            out.append(Stamped(frame, self._stamp_ns))

    def _stamped(
        self, frame: RcChannels | SlowSensors, time_us: int, grain_us: int, out: list[Stamped]
    ) -> None:
        """Stamp a frame: the cycle's own stamp where it was sent in that cycle."""
        if not self.clock.converged:
            return
        last = self.last_cycle
        if last is not None and last.time_us // grain_us == time_us // grain_us:
            out.append(Stamped(frame, self._stamp_ns))
        else:
            out.append(Stamped(frame, self.clock.host_ns(1000 * time_us)))

    def _time_sync(self, frame: TimeSync, now_ns: int) -> None:
        if frame.tc1_ns == 0:
            self.send(TimeSync(now_ns, frame.ts1_ns))
        elif frame.ts1_ns <= now_ns:
            self.clock.add(frame.ts1_ns, frame.tc1_ns, now_ns)

    def _far_end_restarted(self) -> None:
        self.clock.reset()
        self.gains.restart()
