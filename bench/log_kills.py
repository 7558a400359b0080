"""Recorders killed at random moments, files cut off at random places: what is left of the bag.

    python bench/log_kills.py --points 500

A third of the points is SIGKILL alone (the page cache survives), a third a power cut (killed, and
the newest file cut off somewhere behind what had been synced), a third any cut of the newest file.
Each point says by how much the oldest missing message is older than the moment of the damage. The
last line is JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import struct
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from quad_bridge.errors import BadInputError
from quad_bridge.log.recording import Recording
from quad_bridge.log.recover import recover
from quad_bridge.log.writer import BagWriter, Limits
from quad_sysid.bags.storage import Storage
from quad_sysid.errors import BadInputError as UnreadableError

VECTOR = 'geometry_msgs/msg/Vector3Stamped'
TOPICS = ('/setpoint/attitude', '/setpoint/rates', '/excitation/applied', '/excitation/setpoint')
SPLITS_S = (0.0, 0.7)
"""Seconds per file of the bag; 0 for one file."""
DAMAGES = ('kill', 'power', 'cut')
BURST, TICK_S = 6, 0.004
LIFE_S = (0.7, 2.6)
MOST = 8000
BOUND_S = 1.0
SERIAL = struct.Struct('<d')
MESSAGE = struct.pack('<4siII', b'\0\1\0\0', 1, 0, 10) + b'base_link\0' + bytes(2) + bytes(24)
"""A Vector3Stamped without its first number: that is the message's own."""
PLACE = 28


@dataclass(frozen=True)
class Point:
    """The end of one recorder, and the messages recovered afterwards."""

    split_s: float
    damage: str
    put: int
    recovered: int
    lost_s: float
    """Time from the oldest missing message to the damage, s; 0 where none is missing."""
    strange: int
    """Messages in the bag that were never put, or that are there twice."""
    unrecovered: int
    """Messages that the project's reader finds in the bag as it lies there."""


class Ledger:
    """A mapped file that counts, outside of a recorder, what it has put and synced."""

    def __init__(self, path: Path) -> None:
        self.cells = np.memmap(path, np.int64, 'r+' if path.exists() else 'w+', shape=(4 * MOST,))
        self.times = self.cells[8 : 8 + MOST]
        self.syncs = self.cells[2 * MOST : 3 * MOST].reshape(-1, 4)
        """begin, end (ns), number and size of the newest file"""

    def put(self, time_ns: int) -> int:
        k = int(self.cells[0])
        self.times[k] = time_ns
        self.cells[0] = k + 1
        return k

    def synced(self, begin_ns: int, bag: Path) -> None:
        files = storage_files(bag)
        row = begin_ns, time.time_ns(), len(files), files[-1].stat().st_size
        self.syncs[int(self.cells[1])] = row
        self.cells[1] += 1


def storage_files(bag: Path) -> list[Path]:
    return sorted(bag.glob('*.mcap'))


class Watched(BagWriter):
    """Tells the ledger what has been synced."""

    ledger: Ledger

    def flush(self) -> None:
        begin_ns = time.time_ns()
        super().flush()
        self.ledger.synced(begin_ns, self.path)


def fly(bag: Path, ledger: Ledger, split_s: float) -> None:
    """Record until somebody kills this process."""
    writer = Watched(bag, Limits(split_s=split_s))
    writer.ledger = ledger
    recording = Recording(writer)
    for topic in TOPICS:
        recording.declare(topic, VECTOR, ())
    start_s = time.monotonic()
    for tick in range(MOST // BURST):
        for _ in range(BURST):
            now_ns = time.time_ns()
            # the ledger is the later one: what it holds was put
            data = MESSAGE[:PLACE] + SERIAL.pack(ledger.cells[0]) + MESSAGE[PLACE + 8 :]
            recording.put(TOPICS[int(ledger.cells[0]) % len(TOPICS)], now_ns, data)
            ledger.put(now_ns)
        time.sleep(max(start_s + (tick + 1) * TICK_S - time.monotonic(), 0.0))
    time.sleep(60.0)


def start(folder: Path, split_s: float, life_s: float) -> tuple[int, float]:
    """Fork a recorder; its process id and when it is to die, `life_s` after its bag is there."""
    folder.mkdir()
    ledger = Ledger(folder / 'ledger')
    pid = os.fork()
    if pid == 0:
        try:
            fly(folder / 'bag', ledger, split_s)
        finally:
            os._exit(1)
    patience_s = time.monotonic() + 30.0
    while not (bag := folder / 'bag').is_dir() or not storage_files(bag):
        if time.monotonic() > patience_s:
            raise RuntimeError(f'{bag}: its recorder has not begun')
        time.sleep(0.005)
    return pid, time.monotonic() + life_s


def damaged_at(bag: Path, ledger: Ledger, damage: str, rng: np.random.Generator) -> float:
    """Cut the newest file as the damage wants it; the moment (ns) that the disk's state is of."""
    moment = int(ledger.times[int(ledger.cells[0]) - 1])
    if damage == 'kill':
        return moment
    newest = storage_files(bag)[-1]
    size = newest.stat().st_size
    syncs = ledger.syncs[: int(ledger.cells[1])]
    mine = syncs[syncs[:, 2] == len(storage_files(bag))]
    if damage == 'power':
        least = int(mine[-1, 3]) if len(mine) else 0
        os.truncate(newest, int(rng.integers(least, size + 1)))
        return moment
    cut = int(rng.integers(0, size + 1))
    os.truncate(newest, cut)
    after = mine[mine[:, 3] > cut]
    return int(after[0, 1]) if len(after) else moment


def messages_in(bag: Path) -> list[int]:
    storage = Storage(bag, TOPICS)
    raws = [raw for batch in storage.batches() for part in batch.values() for raw in part]
    return [int(SERIAL.unpack_from(raw, PLACE)[0]) for raw in raws]


def judged(folder: Path, split_s: float, damage: str, seed: int) -> Point:
    """Damage what a dead recorder has left, recover it, compare with the ledger."""
    ledger, bag = Ledger(folder / 'ledger'), folder / 'bag'
    put = int(ledger.cells[0])
    moment = damaged_at(bag, ledger, damage, np.random.default_rng(seed))
    before = {p.name: (p.stat().st_size, p.stat().st_mtime_ns) for p in bag.iterdir()}
    try:
        unrecovered = len(messages_in(bag))
    except UnreadableError:
        unrecovered = 0
    try:
        result = recover(bag)
        found = messages_in(result.path)
    except BadInputError:  # nothing whole in it
        found = []
    if before != {p.name: (p.stat().st_size, p.stat().st_mtime_ns) for p in bag.iterdir()}:
        raise RuntimeError(f'{bag} was touched')
    # one message may have been put and not yet be in the ledger
    strange = len(found) - len(set(found) & set(range(put + 1)))
    missing = sorted(set(range(put)) - set(found))
    lost_s = (moment - int(ledger.times[missing[0]])) * 1e-9 if missing else 0.0
    return Point(split_s, damage, put, len(found), max(lost_s, 0.0), strange, unrecovered)


def study(folder: Path, points: int, seed: int, parallel: int = 6) -> list[Point]:
    """Kill `points` recorders, some at a time, and judge what each has left."""
    rng = np.random.default_rng(seed)
    done: list[Point] = []
    for first in range(0, points, parallel):
        batch = []
        for i in range(first, min(first + parallel, points)):
            split_s = SPLITS_S[i % len(SPLITS_S)]
            place = folder / f'point{i}'
            batch.append((place, split_s, i, *start(place, split_s, rng.uniform(*LIFE_S))))
        for *_, pid, end_s in sorted(batch, key=lambda item: item[-1]):
            time.sleep(max(end_s - time.monotonic(), 0.0))
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        for place, split_s, i, _, _ in batch:
            done.append(judged(place, split_s, DAMAGES[i // len(SPLITS_S) % 3], seed + i))
            shutil.rmtree(place)
    return done


def table(points: list[Point]) -> list[str]:
    lines = ['files damage points  lost s: median   most beyond']
    for split_s, damage in sorted({(p.split_s, p.damage) for p in points}):
        lost = [p.lost_s for p in points if (p.split_s, p.damage) == (split_s, damage)]
        beyond = sum(value > BOUND_S for value in lost)
        lines.append(
            f'{"split" if split_s else "one":5} {damage:6} {len(lost):6d} '
            f'{np.median(lost):15.3f} {max(lost):6.3f} {beyond:6d}'
        )
    return lines


def summary(points: list[Point]) -> dict[str, object]:
    return {
        'points': len(points),
        'beyond_bound': sum(p.lost_s > BOUND_S for p in points),
        'bound_s': BOUND_S,
        'most_lost_s': max(p.lost_s for p in points),
        'median_lost_s': float(np.median([p.lost_s for p in points])),
        'strange_messages': sum(p.strange for p in points),
        'unrecovered_short': sum(p.unrecovered < p.recovered for p in points if p.damage != 'cut'),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--points', type=int, default=500)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--parallel', type=int, default=6)
    parser.add_argument('--worst', type=int, default=0, help='print the worst points')
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir='.') as folder:
        points = study(Path(folder).resolve(), given.points, given.seed, given.parallel)
    print('\n'.join(table(points)))
    short = [p for p in points if p.unrecovered < p.recovered and p.damage != 'cut']
    for point in (*sorted(points, key=lambda p: -p.lost_s)[: given.worst], *short):
        print(asdict(point))
    print(json.dumps(summary(points)))


if __name__ == '__main__':
    main()
