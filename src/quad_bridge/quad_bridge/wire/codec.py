"""Packets to frames and frames to bytes. The rule: bytes go in, frames come out, nothing reads.

`Decoder.feed` never raises, whatever the bytes; what could not be used is counted in `Counts`.
Finding packets is framing.py's; what fields mean is messages.py's. Encoder and Decoder serve both
ends of the link.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from quad_bridge.errors import EncodeError
from quad_bridge.wire import dialect
from quad_bridge.wire.frames import (
    CommandAck,
    Cycle,
    Frame,
    GainsState,
    Heartbeat,
    ParamValue,
    Standard,
    TimeSync,
)
from quad_bridge.wire.framing import Framer, Packet
from quad_bridge.wire.messages import FROM_AUTOPILOT, FROM_MESSAGE, TO_MESSAGE, cycle, unpacked
from quad_bridge.wire.other_messages import OTHER_MESSAGES
from quad_bridge.wire.plausible import plausible
from quad_bridge.wire.signing import SIGNED_FLAG, Signing, Verdict

_OURS = {number: kind for number, kind in dialect.mavlink_map.items() if number >= 0}
_NAMES = {number: kind.msgname for number, kind in _OURS.items()} | {
    number: name for number, (name, _) in OTHER_MESSAGES.items()
}
_EXTRAS = {number: kind.crc_extra for number, kind in _OURS.items()} | {
    number: extra for number, (_, extra) in OTHER_MESSAGES.items()
}
_BUILD = {**FROM_MESSAGE, **FROM_AUTOPILOT}
_CYCLE = dialect.MAVLINK_MSG_ID_QUAD_CYCLE
_ANSWERS = (TimeSync, ParamValue, GainsState, CommandAck)
"""They mean something only from who was asked: the far end, once it is known."""
_WRAP = 1 << 32
_LARGEST_GAP = 1_000_000
"""Cycles (over an hour at 250 Hz): a larger step is a restart, not a loss."""
NO_AUTOPILOT = 8
"""MAV_AUTOPILOT_INVALID: the heartbeat of something that flies nothing."""


@dataclass(frozen=True)
class Counts:
    """What a decoder has seen so far."""

    bytes: int = 0
    frames: int = 0
    """Frames handed out, `standard` included."""
    bad_crc: int = 0
    """Messages with a wrong checksum, length or flags."""
    garbage_bytes: int = 0
    """Bytes that belong to no usable message."""
    unknown: int = 0
    """Messages of an id that nobody knows (their checksum cannot be verified)."""
    standard: int = 0
    """Known standard messages that the suite does not use."""
    lost_cycles: int = 0
    """Gaps in the 32-bit cycle counter."""
    restarts: int = 0
    """The cycle counter went back: the far end has restarted."""
    unsigned: int = 0
    """Ignored: a key is set, and these frames bear no signature."""
    forged: int = 0
    """Ignored: signed with another key, or changed on the way."""
    replayed: int = 0
    """Ignored: signed well, but not newer than what came before."""
    ahead: int = 0
    """Ignored: signed well, but of a time that cannot be yet: a clock is broken, or not set."""
    foreign: int = 0
    """Ignored: from another sender than the far end (own echo, ground station, other aircraft)."""
    implausible: int = 0
    """Ignored: a good checksum, but values that cannot be (plausible.py)."""
    old_version: int = 0
    """MAVLink 1 messages; they are ignored, and part of the garbage."""
    unverified: int = 0
    """Signed frames that were taken as they are, because no key is set."""


class CycleWatch:
    """Watches the 32-bit cycle counter: what is missing, whether the far end has restarted."""

    def __init__(self) -> None:
        self.lost = 0
        self.restarts = 0
        self._last: int | None = None

    def step(self, cycle: int) -> int:
        """Cycles lost just before this one; 0 after a restart, which is counted apart."""
        last, self._last = self._last, cycle
        if last is None:
            return 0
        gap = (cycle - last) % _WRAP - 1
        if gap > _LARGEST_GAP:
            self.restarts += 1
            return 0
        missing = max(gap, 0)
        self.lost += missing
        return missing


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
        self._peer: tuple[int, int] | None = None
        self._cycles = False
        """Whether the peer has sent control cycles."""
        self._refused = dict.fromkeys(Verdict, 0)
        self._framer = Framer(_EXTRAS)
        self._watch = CycleWatch()
        self._bytes = 0
        self._frames = 0
        self._standard = 0
        self._foreign = 0
        self._implausible = 0
        self._unverified = 0

    @property
    def counts(self) -> Counts:
        """Totals since the start."""
        return Counts(
            bytes=self._bytes,
            frames=self._frames,
            bad_crc=self._framer.bad_crc,
            garbage_bytes=self._framer.garbage,
            unknown=self._framer.unknown,
            standard=self._standard,
            lost_cycles=self._watch.lost,
            restarts=self._watch.restarts,
            unsigned=self._refused[Verdict.UNSIGNED],
            forged=self._refused[Verdict.FORGED],
            replayed=self._refused[Verdict.REPLAYED],
            ahead=self._refused[Verdict.AHEAD],
            foreign=self._foreign,
            implausible=self._implausible,
            old_version=self._framer.old_version,
            unverified=self._unverified,
        )

    @property
    def restarts(self) -> int:
        """`counts.restarts`, cheap enough to be asked for every cycle."""
        return self._watch.restarts

    def restarted(self) -> int:
        """Count a restart that the cycle counter has not shown; restarts so far."""
        self._watch.restarts += 1
        return self._watch.restarts

    @property
    def peer(self) -> tuple[int, int] | None:
        """System and component of the far end, where `own` was given and it has spoken."""
        return self._peer

    def resync(self) -> None:
        """Forget an incomplete frame and the far end: the port was opened anew. Counts stay."""
        self._framer.clear()
        self.release()

    def release(self) -> None:
        """Let another sender be the far end: the one before has fallen silent."""
        self._peer, self._cycles = None, False

    def feed(self, data: bytes) -> list[Frame]:
        """Frames completed by `data`, in order of arrival. Never raises."""
        self._bytes += len(data)
        frames: list[Frame] = []
        for packet in self._framer.feed(data):
            if self._may_speak(packet):
                self._use(packet, frames)
        self._frames += len(frames)
        return frames

    def _may_speak(self, packet: Packet) -> bool:
        if self._signing is not None:
            verdict = self._signing.judge(packet.whole)
            self._refused[verdict] += 1
            if verdict is not Verdict.GOOD:
                return False
        elif packet.whole[2] & SIGNED_FLAG:
            self._unverified += 1
        sender = (packet.system, packet.component)
        if self._own is None or sender == self._peer:
            return True
        # who sends control cycles is the far end; a heartbeat alone is a guess
        free = self._peer is None or (packet.message == _CYCLE and not self._cycles)
        if sender == self._own or not free:
            self._foreign += 1
            return False
        return True

    def _use(self, packet: Packet, frames: list[Frame]) -> None:
        frame: Frame
        if packet.message == _CYCLE:
            frame = cycle(packet.payload)
        elif (build := _BUILD.get(packet.message)) is not None:
            frame = build(unpacked(packet))
        else:
            self._standard += 1
            frame = Standard(_NAMES[packet.message], packet.system, packet.component)
        if self._own is not None and not plausible(frame):
            self._implausible += 1
            return
        if isinstance(frame, Cycle):
            self._watch.step(frame.cycle)
        if self._own is not None and not self._known(frame, packet):
            self._foreign += 1
            return
        frames.append(frame)

    def _known(self, frame: Frame, packet: Packet) -> bool:
        """Take who flies for the far end; False for an answer of somebody else."""
        if isinstance(frame, Cycle):
            self._peer, self._cycles = (packet.system, packet.component), True
        elif self._peer is None:
            if not _flies(frame):
                return not isinstance(frame, _ANSWERS)
            self._peer = (packet.system, packet.component)
        return True


def _flies(frame: Frame) -> bool:
    return isinstance(frame, Heartbeat) and frame.autopilot != NO_AUTOPILOT


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

    def encode(self, frame: Frame) -> bytes:
        """The bytes of one frame. Raises EncodeError where a value does not fit its field."""
        build = TO_MESSAGE.get(type(frame))
        if build is None:
            raise EncodeError(f'{type(frame).__name__}: has no message of its own to be sent as')
        if self._signing is not None:
            self._mav.signing.timestamp = self._signing.stamp()
        try:
            data = bytes(build(frame).pack(self._mav))
        except (struct.error, ValueError, TypeError, IndexError, OverflowError) as error:
            raise EncodeError(f'{frame}: does not fit its message: {error}') from error
        self._mav.seq = (self._mav.seq + 1) % 256
        return data
