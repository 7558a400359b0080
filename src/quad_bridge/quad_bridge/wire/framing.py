"""Bytes to checked MAVLink 2 packets: marker, length, flags, checksum. No payload is read here.

Rule: what is handed out depends on the bytes alone, never on how they were split. A packet whose
checksum cannot be verified or is wrong loses its marker only; good ones may lie inside it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from fastcrc.crc16 import mcrf4xx

from quad_bridge.wire.signing import MARKER, SIGNATURE, SIGNED, Verdict

OLD_MARKER = 0xFE
HEADER, CHECKSUM = 10, 2
_OLD_HEADER = 6
_SENDERS = 16  # senders whose sequence numbers are remembered


class Packet(NamedTuple):
    """One packet with a good checksum."""

    message: int  # its 24-bit id
    system: int
    component: int
    payload: bytes  # as sent: zeros at the end may be missing
    whole: bytes  # marker to checksum or signature


@dataclass
class Counts:
    """Counts of a decoder since its start; `replace` makes a copy that stays."""

    bytes: int = 0
    frames: int = 0  # frames handed out, `standard` included
    bad_crc: int = 0
    """False starts: wrong checksum or incompatible flags, those inside another left out."""
    garbage_bytes: int = 0  # bytes that belong to no usable message
    unknown: int = 0  # packets of unknown ids: no checksum can be verified
    standard: int = 0  # known standard messages that the suite does not use
    lost_cycles: int = 0  # gaps in the 32-bit cycle counter
    restarts: int = 0  # the cycle counter went back: the peer has restarted
    unsigned: int = 0  # ignored: a key is set, and these frames bear no signature
    forged: int = 0  # ignored: signed with another key, or changed on the way
    replayed: int = 0  # ignored: signed well, but not newer than what came before
    ahead: int = 0
    """Ignored: signed well, but of a time that cannot be yet: a clock is broken, or not set."""
    foreign: int = 0
    """Ignored: from another sender than the peer (own echo, ground station, other aircraft)."""
    implausible: int = 0  # ignored: a good checksum, but values that cannot be (plausible.py)
    old_version: int = 0  # MAVLink 1 packets with a good checksum; they are part of the garbage
    unverified: int = 0  # signed frames that were accepted without a check, because no key is set

    def refused(self, verdict: Verdict) -> None:
        """Count a frame that the signature does not let pass."""
        name = verdict.name.lower()
        setattr(self, name, getattr(self, name) + 1)


class Framer:
    """Finds packets; keeps what is incomplete. `extras` has the CRC_EXTRA of all known ids."""

    def __init__(self, extras: Mapping[int, int], counts: Counts) -> None:
        self._extras, self._counts = extras, counts
        self._pending = bytearray()
        self._suspect = 0  # up to here in `_pending` a false start has been counted already
        self._expected: dict[tuple[int, int], int] = {}

    def clear(self) -> None:
        """Forget what is incomplete; counts stay."""
        self._pending.clear()
        self._expected.clear()
        self._suspect = 0

    def feed(self, data: bytes) -> list[Packet]:
        """Packets completed by `data`. Never raises."""
        pending = self._pending
        pending += data
        packets: list[Packet] = []
        position, end = 0, len(pending)
        while True:
            start = pending.find(MARKER, position)
            if start != position:
                stop = end if start < 0 else start
                self._waste(position, stop)
                position = stop
            if end - position < 3:
                break
            flags = pending[position + 2]
            size = HEADER + pending[position + 1] + CHECKSUM + (SIGNATURE if flags & SIGNED else 0)
            if flags & ~SIGNED:
                position = self._false_start(position, size, known=True)
            elif end - position < size:
                break
            else:
                position = self._packet(position, size, flags, packets)
        del pending[:position]
        self._suspect = max(0, self._suspect - position)
        return packets

    def _packet(self, start: int, size: int, flags: int, packets: list[Packet]) -> int:
        """Take the candidate at `at`; where to look on."""
        whole = bytes(self._pending[start : start + size])
        message = whole[7] | whole[8] << 8 | whole[9] << 16
        sender = (whole[5], whole[6])
        extra = self._extras.get(message)
        if extra is None:
            if self._expected.get(sender) != whole[4]:
                return self._false_start(start, size, known=False)
            self._counts.unknown += 1  # in sequence: a true message of which only the sender knows
        else:
            last = size - (CHECKSUM + SIGNATURE if flags else CHECKSUM)
            crc = mcrf4xx(whole[1:last] + bytes((extra,)))
            if crc != whole[last] | whole[last + 1] << 8:
                return self._false_start(start, size, known=True)
            packets.append(Packet(message, *sender, whole[HEADER:last], whole))
        if sender in self._expected or len(self._expected) < _SENDERS:
            self._expected[sender] = (whole[4] + 1) % 256
        return start + size

    def _false_start(self, start: int, size: int, *, known: bool) -> int:
        if start >= self._suspect:
            self._counts.bad_crc += known
            self._counts.unknown += not known
        self._suspect = max(self._suspect, start + size)
        self._counts.garbage_bytes += 1
        return start + 1

    def _waste(self, begin: int, end: int) -> None:
        """Count garbage; say how much of it is the protocol's first version."""
        self._counts.garbage_bytes += end - begin
        pending, extras = self._pending, self._extras
        start = pending.find(OLD_MARKER, begin, end)
        while start >= 0 and start + _OLD_HEADER + CHECKSUM <= end:
            last = start + _OLD_HEADER + pending[start + 1]
            extra = extras.get(pending[start + 5])
            if (
                extra is not None
                and last + CHECKSUM <= end
                and mcrf4xx(bytes(pending[start + 1 : last]) + bytes((extra,)))
                == pending[last] | pending[last + 1] << 8
            ):
                self._counts.old_version += 1
                start = last + CHECKSUM - 1
            start = pending.find(OLD_MARKER, start + 1, end)
