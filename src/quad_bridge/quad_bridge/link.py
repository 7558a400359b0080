"""What the bridge knows of the far end: decoder, clock and parameters put together. No I/O.

Bytes and ticks go in, frames with stamps come out, and what is to be sent waits in `drain`. All
times are ns of one steady host clock. Not thread-safe: the node holds a lock around it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from quad_bridge.wire.clock import ClockEstimator
from quad_bridge.wire.codec import Decoder, Encoder
from quad_bridge.wire.frames import (
    Battery,
    Cycle,
    Excitation,
    Frame,
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
from quad_bridge.wire.gain_names import CONTRACT_NAMES
from quad_bridge.wire.params import ParamReader, ParamTransaction, Phase

BRIDGE_SYSTEM, BRIDGE_COMPONENT = 1, 191
ONBOARD_CONTROLLER, NO_AUTOPILOT = 18, 8
ADDRESSED = (Excitation, ParamRequestList, ParamRequestRead, ParamSet)
HEARTBEAT_NS = 1_000_000_000
SYNC_NS = 200_000_000
"""Between TIMESYNC questions once the clock has converged; before, every tick asks."""


@dataclass(frozen=True)
class Stamped:
    """A frame for a topic with its host time; `stamp_ns` is None where it has no time."""

    frame: Cycle | RcChannels | Battery | SlowSensors | StatusText
    stamp_ns: int | None


@dataclass(frozen=True)
class GainOutcome:
    """What became of the gains: `active` (contract names, SI) or why a write failed."""

    active: Mapping[str, float] | None
    reason: str = ''


class Link:
    """State of the conversation with the STM32."""

    def __init__(self) -> None:
        self.decoder = Decoder()
        self.clock = ClockEstimator()
        self.reader = ParamReader()
        self.transaction: ParamTransaction | None = None
        self.outcomes: list[GainOutcome] = []
        """Gain events not yet taken by the node."""
        self.peer: Heartbeat | None = None
        self.standard_names: set[str] = set()
        """Standard messages seen that the bridge does not use."""
        self.last_cycle: Cycle | None = None
        self.last_cycle_ns = 0
        """Host time at which the last cycle arrived."""
        self.cycles = 0
        self.held = 0
        """Cycles not published because the clock had not converged."""
        self._encoder = Encoder(BRIDGE_SYSTEM, BRIDGE_COMPONENT)
        self._outbox = bytearray()
        self._stamp_ns = 0
        self._restarts = 0
        self._announced = False
        self._next_heartbeat_ns = 0
        self._next_sync_ns = 0

    @property
    def active(self) -> dict[str, float]:
        """Gains and loop constants as last reported, contract names, SI."""
        values = self.reader.values
        return {CONTRACT_NAMES[w]: values[w] for w in sorted(values) if w in CONTRACT_NAMES}

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
        self._parameters(now_ns)

    def write_gains(self, writes: Mapping[str, float], now_ns: int) -> None:
        """Begin a transaction (wire names). Raises RefusedError before anything is sent."""
        self.transaction = ParamTransaction(writes, self.reader.values)
        self._parameters(now_ns)

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
        elif isinstance(frame, ParamValue):
            self._param_value(frame, now_ns)
        elif isinstance(frame, Heartbeat):
            if frame.autopilot != NO_AUTOPILOT:
                self.peer = frame
        elif isinstance(frame, Standard):
            self.standard_names.add(frame.name)

    def _for_topic(
        self, frame: RcChannels | SlowSensors | Battery | StatusText, out: list[Stamped]
    ) -> None:
        if isinstance(frame, SlowSensors) and frame.has_inertial:
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

    def _param_value(self, frame: ParamValue, now_ns: int) -> None:
        self.reader.take(frame, 1e-9 * now_ns)
        if self.transaction is not None:
            self.transaction.take(frame)
        self._parameters(now_ns)

    def _parameters(self, now_ns: int) -> None:
        now_s = 1e-9 * now_ns
        transaction = self.transaction
        if transaction is not None:
            request: ParamSet | ParamRequestList | ParamRequestRead | None
            request = transaction.poll(now_s)
            if request is not None:
                self.send(request)
            if transaction.finished:
                self._finish(transaction)
            return
        request = self.reader.poll(now_s)
        if request is not None:
            self.send(request)
        if self.reader.complete and not self._announced:
            self._announced = True
            self.outcomes.append(GainOutcome(self.active))

    def _finish(self, transaction: ParamTransaction) -> None:
        self.transaction = None
        if transaction.phase is Phase.DONE:
            self.outcomes.append(GainOutcome(self.active))
            return
        self.outcomes.append(GainOutcome(None, transaction.reason))
        self.reader.restart()
        self._announced = False

    def _far_end_restarted(self) -> None:
        if self.transaction is not None:
            self.outcomes.append(GainOutcome(None, 'the link broke during the write'))
        self.transaction = None
        self.clock.reset()
        self.reader.restart()
        self._announced = False
