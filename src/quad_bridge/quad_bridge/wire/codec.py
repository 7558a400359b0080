"""Packets to frames and frames to bytes. The rule: bytes go in, frames come out, nothing reads.

`Decoder.feed` never raises, whatever the bytes; what could not be used is counted in `Counts`.
Finding packets is framing.py's; what fields mean is messages.py's. Encoder and Decoder serve both
ends of the link.
"""

from __future__ import annotations

import struct

from quad_bridge.errors import EncodeError
from quad_bridge.wire import dialect
from quad_bridge.wire import frames as f
from quad_bridge.wire.framing import Counts, Framer, Packet
from quad_bridge.wire.messages import FROM_AUTOPILOT, FROM_MESSAGE, OFTEN, message_of, unpacked
from quad_bridge.wire.plausible import plausible
from quad_bridge.wire.signing import SIGNED, Signing, Verdict

_OURS = {number: kind for number, kind in dialect.mavlink_map.items() if number >= 0}
_NAMES = {number: kind.msgname for number, kind in _OURS.items()} | {
    number: name for number, (name, _) in dialect.OTHER_MESSAGES.items()
}
_EXTRAS = {number: kind.crc_extra for number, kind in _OURS.items()} | {
    number: extra for number, (_, extra) in dialect.OTHER_MESSAGES.items()
}
_BUILD = {**FROM_MESSAGE, **FROM_AUTOPILOT}
_CYCLE = dialect.MAVLINK_MSG_ID_QUAD_CYCLE
_ANSWERS = (f.TimeSync, f.ParamValue, f.GainsState, f.CommandAck)
"""They mean something only from who was asked: the peer, once it is known."""
_WRAP = 1 << 32
_MAX_GAP = 1_000_000  # cycles (over an hour at 250 Hz): a larger step is a restart, not a loss
_OVERTAKEN, _LONGEST_US = 8, 100_000  # a cycle so many behind, each so long at most, came late
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: the heartbeat of something that flies nothing


class Decoder:
    """Bytes in, frames out; keeps what is incomplete for the next call."""

    def __init__(
        self, signing: Signing | None = None, *, own: tuple[int, int] | None = None
    ) -> None:
        """With `signing` only well signed frames are handed out.

        With `own`, the system and component of this end, only one sender counts, and only
        plausible values: the first that sends control cycles, and until then the first that
        flies something. Without, all pass.
        """
        self._signing = signing
        self._own = own
        self.peer: tuple[int, int] | None = None
        """System and component of the peer; None before its first message, or without `own`."""
        self._cycles = False  # whether the peer has sent control cycles
        self._last: f.Cycle | None = None  # with a counter of 32 bits
        self.counts = Counts()
        self._framer = Framer(_EXTRAS, self.counts)

    def resync(self) -> None:
        """Forget an incomplete frame and the peer: the port was opened anew. Counts stay."""
        self._framer.clear()
        self.release()

    def release(self) -> None:
        """Let another sender be the peer: the one before has fallen silent."""
        self.peer, self._cycles = None, False

    def feed(self, data: bytes) -> list[f.Frame]:
        """Frames completed by `data`, in order of arrival. Never raises."""
        self.counts.bytes += len(data)
        frames: list[f.Frame] = []
        for packet in self._framer.feed(data):
            if self._may_speak(packet):
                self._use(packet, frames)
        self.counts.frames += len(frames)
        return frames

    def _may_speak(self, packet: Packet) -> bool:
        if self._signing is not None:
            verdict = self._signing.judge(packet.whole)
            if verdict is not Verdict.GOOD:
                self.counts.refused(verdict)
                return False
        elif packet.whole[2] & SIGNED:
            self.counts.unverified += 1
        sender = (packet.system, packet.component)
        if self._own is None or sender == self.peer:
            return True
        # who sends control cycles is the peer; a heartbeat alone is a guess
        free = self.peer is None or (packet.message == _CYCLE and not self._cycles)
        if sender == self._own or not free:
            self.counts.foreign += 1
            return False
        return True

    def _use(self, packet: Packet, frames: list[f.Frame]) -> None:
        frame: f.Frame
        if (often := OFTEN.get(packet.message)) is not None:
            frame = often(packet.payload)
        elif (build := _BUILD.get(packet.message)) is not None:
            frame = build(unpacked(packet))
        else:
            self.counts.standard += 1
            frame = f.Standard(_NAMES[packet.message])
        if self._own is not None:
            checked = plausible(frame)
            self.counts.implausible += checked is not frame
            if checked is None:
                return
            frame = checked
        if isinstance(frame, f.Cycle) and not self._count(frame):
            return
        if self._own is not None and not self._known(frame, packet):
            self.counts.foreign += 1
            return
        frames.append(frame)

    def _count(self, frame: f.Cycle) -> bool:
        """Count what is missing before this cycle, or a restart of the peer.

        False for one that a later one has overtaken, as on a network: it counts as lost.
        """
        last = self._last
        if last is not None and 0 < (late := (last.cycle - frame.cycle) % _WRAP) <= _OVERTAKEN \
                and 0 < last.time_us - frame.time_us <= late * _LONGEST_US:
            return False
        self._last = frame
        gap = (frame.cycle - last.cycle) % _WRAP - 1 if last is not None else 0
        if gap > _MAX_GAP:
            self.counts.restarts += 1
        else:
            self.counts.lost_cycles += max(gap, 0)
        return True

    def _known(self, frame: f.Frame, packet: Packet) -> bool:
        """Take who flies for the peer; False for an answer of somebody else."""
        if isinstance(frame, f.Cycle):
            self.peer, self._cycles = (packet.system, packet.component), True
        elif self.peer is None:
            if not isinstance(frame, f.Heartbeat) or frame.autopilot == NO_AUTOPILOT:
                return not isinstance(frame, _ANSWERS)
            self.peer = (packet.system, packet.component)
        return True


class Encoder:
    """Frames to bytes, with the sender's ids and running sequence number."""

    def __init__(
        self, system: int = 1, component: int = 1, signing: Signing | None = None
    ) -> None:
        """Ids of the sender: the STM32 is 1, 1; the bridge 1, 191 (onboard computer)."""
        self._mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self._signing = signing
        if signing is not None:
            state = self._mav.signing
            state.secret_key, state.link_id = signing.key, signing.link_id
            state.sign_outgoing = True

    def encode(self, frame: f.Frame) -> bytes:
        """The bytes of one frame. Raises EncodeError where a value does not fit its field."""
        if self._signing is not None:
            self._mav.signing.timestamp = self._signing.stamp()
        try:
            data = bytes(message_of(frame).pack(self._mav))
        except (struct.error, ValueError, TypeError, LookupError, OverflowError) as error:
            raise EncodeError(f'{frame}: does not fit its message: {error}') from error
        self._mav.seq = (self._mav.seq + 1) % 256
        return data
