"""At least 10^8 bytes into the decoder: noise, damaged streams, splices; no exception, no lie.

    python bench/link_fuzz.py --bytes 100000000 --seed 1

Every piece goes in at once and in parts: both must agree. A frame that was not sent can only
pass where 16 bits of checksum agree by chance; how often that may be is printed beside it.
The last line is one JSON object. `link_atheris.py` is the same decoder under coverage guidance.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, field

import numpy as np

from quad_bridge.wire import frames as f
from quad_bridge.wire import framing
from quad_bridge.wire.codec import Decoder, Encoder

OWN = (1, 191)
CHECKED = [0]
"""Checksums compared so far, those of good packets included."""
PIECE = 200_000
CYCLES = 400


def counting(data: bytes, checksum=framing.mcrf4xx) -> int:
    CHECKED[0] += 1
    return checksum(data)


def vectors(rng: np.random.Generator, count: int) -> tuple[float, ...]:
    return tuple(float(np.float32(v)) for v in rng.normal(0.0, 0.3, count))


def cycle(rng: np.random.Generator, number: int) -> f.Cycle:
    v = vectors(rng, 22)
    motors = tuple(float(np.float32(m)) for m in rng.uniform(0.0, 1.0, 4))
    return f.Cycle(
        4000 * number, number, v[:3], v[3:6], v[6:9], v[9:12], v[12:15], v[15:19], v[19:22],
        motors, int(rng.integers(512)), number % 256, number % 4,
    )  # fmt: skip


def stream(rng: np.random.Generator) -> tuple[bytes, set[str]]:
    """Bytes that a second and a half of flight sends, and the printed form of each frame."""
    encoder, data, sent = Encoder(1, 1), bytearray(), set()
    begin = int(rng.integers(1 << 31))
    for k in range(CYCLES):
        frames: list[f.Frame] = [cycle(rng, begin + k)]
        if k % 5 == 0:
            frames.append(f.RcChannels(4 * k, tuple(rng.integers(1000, 2000, 9).tolist())))
            frames.append(f.SlowSensors(4000 * k, (0.25, -0.5, float(k)), 1000.0, 20.0))
        if k % 25 == 0:
            frames += [f.Battery(11.5), f.TimeSync(k + 1, 2), f.Heartbeat(system=1, component=1)]
            frames.append(f.ParamValue('ROLL_RATE_KP', 0.5, 27, k % 27))
            frames.append(f.GainsState(7, 8, 9, 1, 0, 2))
        for frame in frames:
            data += encoder.encode(frame)
            sent.add(repr(frame))
    return bytes(data), sent


def noise(rng: np.random.Generator, _: bytes) -> bytes:
    return rng.bytes(PIECE)


def markers(rng: np.random.Generator, _: bytes) -> bytes:
    """Noise dense in markers and in ids that are known."""
    data = np.frombuffer(rng.bytes(PIECE), np.uint8).copy()
    at = rng.integers(0, PIECE - 12, PIECE // 40)
    data[at] = 0xFD
    data[at + 2] = rng.integers(0, 2, len(at))
    ids = np.array([0, 22, 65, 105, 111, 147, 24100, 24103])[rng.integers(0, 8, len(at))]
    for k in range(3):
        data[at + 7 + k] = ids >> (8 * k) & 255
    return data.tobytes()


def flipped(rng: np.random.Generator, clean: bytes) -> bytes:
    data = np.frombuffer(clean, np.uint8).copy()
    at = rng.integers(0, len(data), len(data) // int(rng.integers(100, 2000)))
    np.bitwise_xor.at(data, at, (1 << rng.integers(0, 8, len(at))).astype(np.uint8))
    return data.tobytes()


def dropped(rng: np.random.Generator, clean: bytes) -> bytes:
    keep = rng.random(len(clean)) > 1.0 / rng.integers(100, 2000)
    return np.frombuffer(clean, np.uint8)[keep].tobytes()


def bursts(rng: np.random.Generator, clean: bytes) -> bytes:
    data = bytearray(clean)
    for _ in range(len(clean) // 1000):
        at, size = int(rng.integers(len(data))), int(rng.integers(1, 200))
        data[at : at + size] = rng.bytes(int(rng.integers(0, size + 1)))
    return bytes(data)


def spliced(rng: np.random.Generator, clean: bytes) -> bytes:
    out = bytearray()
    while len(out) < len(clean):
        begin = int(rng.integers(len(clean)))
        out += clean[begin : begin + int(rng.integers(1, 600))]
    return bytes(out)


KINDS = {
    'noise': noise, 'markers': markers, 'bit flips': flipped, 'dropped bytes': dropped,
    'bursts': bursts, 'splices': spliced,
}  # fmt: skip


@dataclass
class Tally:
    bytes: int = 0
    frames: int = 0
    false: int = 0
    candidates: int = 0
    implausible: int = 0
    disagreements: int = 0
    examples: list[str] = field(default_factory=list)


def run(kind: str, total: int, rng: np.random.Generator) -> Tally:
    tally = Tally()
    while tally.bytes < total:
        clean, sent = stream(rng)
        for _ in range(8):
            data = KINDS[kind](rng, clean)
            whole, before = Decoder(own=OWN), CHECKED[0]
            frames = [repr(frame) for frame in whole.feed(data)]
            tally.bytes += len(data)
            tally.frames += len(frames)
            wrong = [text for text in frames if text not in sent]
            tally.false += len(wrong)
            tally.examples += wrong[: 3 - len(tally.examples)]
            counts = whole.counts
            tally.candidates += CHECKED[0] - before - counts.frames - counts.implausible
            tally.implausible += counts.implausible
            if rng.random() < 0.25:
                parts, begin = Decoder(own=OWN), 0
                again = []
                while begin < len(data):
                    end = begin + int(rng.integers(1, 3000))
                    again += [repr(frame) for frame in parts.feed(data[begin:end])]
                    begin = end
                tally.disagreements += again != frames or parts.counts != counts
                tally.bytes += len(data)
    return tally


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--bytes', type=int, default=102_000_000)
    parser.add_argument('--seed', type=int, default=1)
    given = parser.parse_args()
    framing.mcrf4xx = counting
    rng, began_s = np.random.default_rng(given.seed), time.monotonic()
    told = {}
    print('kind                bytes    frames   bad CRC  by chance implausible not sent splits')
    for kind in KINDS:
        tally = run(kind, given.bytes // len(KINDS), rng)
        chance = tally.candidates / 65_536
        told[kind] = {**vars(tally), 'expected_by_chance': round(chance, 1)}
        print(
            f'{kind:14} {tally.bytes:10d} {tally.frames:9d} {tally.candidates:9d} {chance:10.1f}'
            f' {tally.implausible:11d} {tally.false:8d} {tally.disagreements:6d}'
        )
    total = sum(int(t['bytes']) for t in told.values())
    seconds = round(time.monotonic() - began_s, 1)
    print(
        json.dumps({
            'schema': 'quad_bridge/link_fuzz/1', 'bytes': total, 'exceptions': 0,
            'seconds': seconds, 'kinds': told,
        })
    )  # fmt: skip


if __name__ == '__main__':
    main()
