"""The decoder under coverage guidance, for a Python that has atheris (not among the suite's own).

    python bench/link_atheris.py -max_total_time=120 -seed=1 -max_len=4096

Fails on any exception, and where whole and split bytes disagree. Run it where `atheris` and
`fastcrc` are installed, with `src/quad_bridge` on PYTHONPATH.
"""

from __future__ import annotations

import struct
import sys

import atheris

with atheris.instrument_imports(include=['quad_bridge']):
    from quad_bridge.wire.codec import Decoder
    from quad_bridge.wire.framing import CHECKSUM, HEADER
    from quad_bridge.wire.signing import MARKER, SIGNATURE
from fastcrc.crc16 import mcrf4xx

from quad_bridge.wire.codec import _EXTRAS

OWN = (1, 191)


def mended(data: bytes) -> bytes:
    """The bytes with a valid checksum in everything that looks like a packet; few pass without."""
    out, at = bytearray(data), data.find(MARKER)
    while 0 <= at <= len(out) - HEADER:
        size = HEADER + out[at + 1] + CHECKSUM
        out[at + 2] &= 1
        extra = _EXTRAS.get(int.from_bytes(out[at + 7 : at + 10], 'little'))
        end = at + size + SIGNATURE * (out[at + 2] & 1)
        if extra is not None and end <= len(out):
            crc = mcrf4xx(bytes(out[at + 1 : at + size - 2]) + bytes([extra]))
            out[at + size - 2 : at + size] = struct.pack('<H', crc)
            at = end - 1
        at = out.find(MARKER, at + 1)
    return bytes(out)


def one_input(data: bytes) -> None:
    step, data = (data[0] % 97 + 1, data[1:]) if data else (1, data)
    for stream in (data, mended(data)):
        whole, parts = Decoder(own=OWN), Decoder(own=OWN)
        at_once = [repr(frame) for frame in whole.feed(stream)]
        in_parts: list[str] = []
        for begin in range(0, len(stream), step):
            in_parts += [repr(frame) for frame in parts.feed(stream[begin : begin + step])]
        if at_once != in_parts or whole.counts != parts.counts:
            raise RuntimeError('whole and split bytes disagree')


if __name__ == '__main__':
    atheris.Setup(sys.argv, one_input)
    atheris.Fuzz()
