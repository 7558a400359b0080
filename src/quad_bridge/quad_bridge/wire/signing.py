"""MAVLink 2 signing: who may speak. One `Signing` is shared by the decoder and encoder of an end.

Pure: the key and a clock are handed in. pymavlink signs what is sent; what arrives is judged here,
because its own check notes a frame's time before it has checked the signature, so that anybody
could lock the true sender out with one forged frame from the future.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable
from enum import Enum

KEY_BYTES = 32
SIGNED = 0x01  # bit of the incompatibility flags of a signed frame
_EPOCH_NS = 1_420_070_400_000_000_000
"""2015-01-01 GMT, from which signatures count, in ns since 1970."""
LAST = 1 << 47
"""August 2059. A time has 48 bits; whoever accepted one near the end would soon have none left."""
_YEAR = 365 * 86_400 * 100_000
_SET = 10 * _YEAR  # a clock behind it, in the end of 2024, was never set
MARKER, SIGNATURE, _DIGEST = 0xFD, 13, 6


class Verdict(Enum):
    """The verdict on a frame."""

    GOOD = 'good'
    UNSIGNED = 'unsigned'
    FORGED = 'signed with another key'
    REPLAYED = 'replayed'
    AHEAD = 'of a time that cannot be yet'


def signing_time(unix_ns: int) -> int:
    """Signature time, 10 µs since 2015, of ns since 1970."""
    return max(0, unix_ns - _EPOCH_NS) // 10_000


class Signing:
    """Judges frames and times those that are sent; raises ValueError for a key of wrong length.

    Refused is what is not newer than the last accepted frame of the same link id, system and
    component, and from a new such stream what is older than this end's start. (MAVLink lets a
    minute pass there, in which a recording could be replayed after a restart.) An end whose
    clock is behind follows the frames that it accepts, so two honest ends always meet. It does not
    follow a clock that is broken: refused is what is a year ahead of a clock that was set, and
    whatever is beyond LAST.
    """

    def __init__(self, key: bytes, clock: Callable[[], int], *, link_id: int = 0) -> None:
        """`clock` gives the signature time now; it may jump. Beyond LAST it counts as not set."""
        if len(key) != KEY_BYTES:
            raise ValueError(f'a key has {KEY_BYTES} bytes: found {len(key)}')
        self.key = bytes(key)
        self.link_id = link_id
        self._clock = clock
        self._start = self._latest = self._now()
        self._streams: dict[tuple[int, int, int], int] = {}

    def stamp(self) -> int:
        """Time for the next frame to send: now, but later than all sent and accepted before."""
        self._latest = max(self._latest + 1, self._now())
        return self._latest

    def judge(self, frame: bytes) -> Verdict:
        """The verdict on one whole frame, its checksum already verified."""
        if frame[0] != MARKER or not frame[2] & SIGNED:
            return Verdict.UNSIGNED
        digest = hashlib.sha256(self.key + frame[:-_DIGEST]).digest()[:_DIGEST]
        if not hmac.compare_digest(digest, bytes(frame[-_DIGEST:])):
            return Verdict.FORGED
        block = frame[-SIGNATURE:]
        time = int.from_bytes(block[1:7], 'little')
        stream = (block[0], frame[5], frame[6])
        last = self._streams.get(stream, self._start - 1)
        if time <= last:
            return Verdict.REPLAYED
        if time > self._horizon():
            return Verdict.AHEAD
        self._streams[stream] = time
        self._latest = max(self._latest, time)
        return Verdict.GOOD

    def _now(self) -> int:
        time = self._clock()
        return time if time <= LAST else 0

    def _horizon(self) -> int:
        """The last time that is accepted now."""
        now = max(self._latest, self._now())
        return min(LAST, now + _YEAR) if now > _SET else LAST
