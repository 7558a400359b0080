"""Bytes to frames and frames to bytes. The rule here: bytes go in, frames come out, nothing reads.

`Decoder.feed` never raises, whatever the bytes; what could not be used is counted in `Counts`.
Encoder and Decoder serve both ends of the link. The framing is pymavlink's generated `dialect`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

from quad_bridge.errors import EncodeError
from quad_bridge.wire import dialect
from quad_bridge.wire.frames import Cycle, Frame
from quad_bridge.wire.messages import FROM_MESSAGE, TO_MESSAGE, standard
from quad_bridge.wire.sequence import CycleWatch
from quad_bridge.wire.signing import Signing, Verdict

dialect.MAVLINK_IGNORE_CRC = 0  # an environment variable must not let corrupted frames in

_CHUNK = 4096
"""Bytes given to the parser at a time: bounds what a damaged stretch has copied."""


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
    """Messages of an id that the dialect lacks (their checksum cannot be verified)."""
    standard: int = 0
    """Known standard messages that the suite does not use yet."""
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


class Decoder:
    """Bytes in, frames out; keeps what is incomplete for the next call."""

    def __init__(self, signing: Signing | None = None) -> None:
        """With `signing` only well signed frames are handed out."""
        self._signing = signing
        self._refused = dict.fromkeys(Verdict, 0)
        self._mav = dialect.MAVLink(None)
        self._mav.robust_parsing = True
        self._watch = CycleWatch()
        self._bytes = 0
        self._frames = 0
        self._bad_crc = 0
        self._garbage = 0
        self._unknown = 0
        self._standard = 0
        self._suspect = 0

    @property
    def counts(self) -> Counts:
        """Totals since the start."""
        return Counts(
            bytes=self._bytes,
            frames=self._frames,
            bad_crc=self._bad_crc,
            garbage_bytes=self._garbage,
            unknown=self._unknown,
            standard=self._standard,
            lost_cycles=self._watch.lost,
            restarts=self._watch.restarts,
            unsigned=self._refused[Verdict.UNSIGNED],
            forged=self._refused[Verdict.FORGED],
            replayed=self._refused[Verdict.REPLAYED],
        )

    @property
    def restarts(self) -> int:
        """`counts.restarts`, cheap enough to be asked for every cycle."""
        return self._watch.restarts

    def resync(self) -> None:
        """Forget an incomplete frame: the port was opened anew. Counts stay."""
        self._mav.buf = bytearray()
        self._mav.buf_index = 0
        self._suspect = 0

    def feed(self, data: bytes) -> list[Frame]:
        """Frames completed by `data`, in order of arrival. Never raises."""
        self._bytes += len(data)
        frames: list[Frame] = []
        parse = self._mav.parse_char
        for start in range(0, len(data), _CHUNK):
            message = parse(data[start : start + _CHUNK])
            while message is not None:
                self._take(message, frames)
                message = parse(b'')
        self._frames += len(frames)
        return frames

    def _take(self, message: Any, frames: list[Frame]) -> None:
        size = len(message.get_msgbuf()) or len(getattr(message, 'data', b''))
        suspect, self._suspect = self._suspect > 0, max(0, self._suspect - size)
        kind = message.get_type()
        if kind == 'BAD_DATA' and message.reason == 'Bad prefix':
            self._garbage += size
        elif kind == 'BAD_DATA' or kind.startswith('UNKNOWN_'):
            if not suspect and kind != 'BAD_DATA':
                self._unknown += 1
            elif not suspect:
                self._bad_crc += 1
            self._hand_back(message.data)
        elif self._may_speak(message):
            self._use(message, frames)

    def _may_speak(self, message: Any) -> bool:
        if self._signing is None:
            return True
        verdict = self._signing.judge(bytes(message.get_msgbuf()))
        self._refused[verdict] += 1
        return verdict is Verdict.GOOD

    def _hand_back(self, data: bytes) -> None:
        """Drop the marker and have the rest parsed again: good frames may lie inside."""
        self._garbage += 1
        rest = self._mav.buf[self._mav.buf_index :]
        self._mav.buf = bytearray(data[1:]) + rest
        self._mav.buf_index = 0
        self._suspect = max(self._suspect, len(data) - 1)

    def _use(self, message: Any, frames: list[Frame]) -> None:
        build = FROM_MESSAGE.get(message.get_msgId())
        if build is None:
            self._standard += 1
            frames.append(standard(message))
            return
        frame = build(message)
        if isinstance(frame, Cycle):
            self._watch.step(frame.cycle)
        frames.append(frame)


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
