"""How fast a recorded flight becomes arrays: this project's reader beside rosbags' reader loop.

Both read the same bag in the same run, and the arrays are compared bit for bit. 1,510 messages a
second, mcap by the logger's own writer, 0.4 s per chunk; compressed and sqlite3 bags by rosbags.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from quad_bridge.log.writer import BagWriter, Limits
from quad_sysid.bags import cdr
from quad_sysid.bags.cdr import typestore
from quad_sysid.bags.storage import Storage
from quad_sysid.bags.writer import template
from quad_sysid.contract import TOPIC_TYPES

RATE_HZ = 250
TOPICS = (
    '/imu/data', '/motors/command', '/control/wrench', '/setpoint/attitude', '/setpoint/rates',
    '/excitation/applied', '/battery',
)  # fmt: skip
FORMATS = {
    'mcap': Limits(), 'mcap split': Limits(split_s=60.0), 'mcap zstd': 'STORAGE',
    'mcap zstd message': 'MESSAGE', 'sqlite3': 'NONE', 'sqlite3 zstd message': 'MESSAGE',
}  # fmt: skip
"""By name: the logger's limits, or the compression of rosbags' writer."""
T0 = 1_750_000_000_000_000_000
Arrays = dict[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Speed:
    """Time to read one bag, s, by rosbags and by this project."""

    name: str
    messages: int
    rosbags_read: float
    """Time of the reader's loop, without deserialising."""
    rosbags_deserialise: float
    decode: float
    """Time to decode the messages in bulk, from memory."""
    read: float
    """Time from the bag to the arrays."""
    equal: bool

    @property
    def ratios(self) -> tuple[float, float]:
        """Deserialisation alone; bag to arrays."""
        loop = self.rosbags_read + self.rosbags_deserialise
        return self.rosbags_deserialise / self.decode, loop / self.read

    def line(self) -> str:
        return (
            f'{self.name:22}{self.messages:9d}{self.rosbags_read:9.2f}'
            f'{self.rosbags_deserialise:8.2f}{self.decode:8.3f}{self.read:8.3f}'
            f'{self.ratios[0]:9.1f}{self.ratios[1]:8.1f}  {self.equal}'
        )


class Theirs:
    """A writer of rosbags with the methods of ours."""

    def __init__(self, path: Path, name: str, compression: str) -> None:
        self._writer = Writer(
            path, version=9, storage_plugin=StoragePlugin[name.split(maxsplit=1)[0].upper()]
        )
        self._writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
        self._writer.open()
        self._topics: dict[str, object] = {}

    def add_topic(self, topic: str, kind: str) -> None:
        self._topics[topic] = self._writer.add_connection(topic, kind, typestore=typestore())

    def write(self, topic: str, time_ns: int, data: bytes) -> None:
        self._writer.write(self._topics[topic], time_ns, data)  # type: ignore[arg-type]

    def flush(self) -> None:
        pass

    def close(self) -> None:
        self._writer.close()


def write_flight(path: Path, seconds: float, name: str, how: Limits | str) -> None:
    """A flight of random numbers, a minute at a time."""
    writer = Theirs(path, name, how) if isinstance(how, str) else BagWriter(path, how)
    for topic in TOPICS:
        writer.add_topic(topic, TOPIC_TYPES[topic])
    rng = np.random.default_rng(1)
    for start in range(0, round(seconds * RATE_HZ), 60 * RATE_HZ):
        n = min(60 * RATE_HZ, round(seconds * RATE_HZ) - start)
        stamps = T0 + 4_000_000 * np.arange(start, start + n)
        raws = {}
        for topic in TOPICS:
            kind = TOPIC_TYPES[topic]
            # steps of a filtered sensor's size, so that compressing costs what it costs in flight
            values = np.round(np.cumsum(rng.standard_normal((n, cdr.WIDTH[kind])), axis=0)) / 64
            values[:, 4:5] = 0.0
            raws[topic] = cdr.encode(kind, template(kind), stamps, values)
        for k, stamp in enumerate(stamps.tolist()):
            for topic in TOPICS[:-1]:
                writer.write(topic, stamp, raws[topic][k])
            if k % 25 == 0:
                writer.write('/battery', stamp, raws['/battery'][k])
            if k % 100 == 99:
                writer.flush()
    writer.close()


def fast(bag: Path) -> Arrays:
    parts: dict[str, list[cdr.Stamped]] = {}
    for batch in Storage(bag, TOPICS).batches():
        for topic, raws in batch.items():
            parts.setdefault(topic, []).append(cdr.decode(TOPIC_TYPES[topic], raws))
    return {
        topic: (np.concatenate([p.stamps for p in some]), np.concatenate([p.values for p in some]))
        for topic, some in parts.items()
    }


def compare(bag: Path, name: str) -> Speed:
    """Best of two of everything; the arrays of rosbags' loop are made outside of its time."""
    times: dict[str, float] = {}

    def timed(what: str, since: float) -> None:
        times[what] = min(times.get(what, np.inf), time.perf_counter() - since)

    for _ in range(2):
        begin = time.perf_counter()
        with AnyReader([bag]) as reader:
            raws = [(c.topic, c.msgtype, raw) for c, _, raw in reader.messages()]
            timed('read', begin)
            begin = time.perf_counter()
            decoded = [reader.deserialize(raw, kind) for _, kind, raw in raws]
            timed('deserialise', begin)
        held: dict[str, list[bytes]] = {}
        for topic, _, raw in raws:
            held.setdefault(topic, []).append(bytes(raw))
        begin = time.perf_counter()
        for topic, some in held.items():
            cdr.decode(TOPIC_TYPES[topic], some)
        timed('decode', begin)
        begin = time.perf_counter()
        arrays = fast(bag)
        timed('fast', begin)
    slow = by_hand([topic for topic, _, _ in raws], decoded)
    equal = slow.keys() == arrays.keys() and all(
        np.array_equal(slow[t][0], arrays[t][0])
        and np.array_equal(slow[t][1].view(np.uint64), arrays[t][1].view(np.uint64))
        for t in slow
    )
    return Speed(
        name, len(raws), times['read'], times['deserialise'], times['decode'], times['fast'], equal
    )


def by_hand(topics: list[str], decoded: list[object]) -> Arrays:
    """Arrays from rosbags' objects, field by field."""
    out: dict[str, tuple[list[int], list[list[float]]]] = {}
    for topic, message in zip(topics, decoded, strict=True):
        stamps, rows = out.setdefault(topic, ([], []))
        stamp = message.header.stamp  # type: ignore[attr-defined]
        stamps.append(stamp.sec * 10**9 + stamp.nanosec)
        rows.append(cdr._values(TOPIC_TYPES[topic], message, cdr.Joints()).tolist())  # noqa: SLF001
    return {topic: (np.array(s), np.array(r, float)) for topic, (s, r) in out.items()}


MEMORY = """
import json, sys, threading, time
sys.path[:0] = {paths!r}
import numpy as np
from pathlib import Path
from quad_sysid.bags import read_bag
read_bag(Path(sys.argv[2]))  # imports and compiled code are not the bag's
def anonymous():
    for line in open('/proc/self/status'):
        if line.startswith('RssAnon'):
            return int(line.split()[1]) * 1024
peak, done = [anonymous()], threading.Event()
def watch():
    while not done.wait(0.01):
        peak.append(anonymous())
threading.Thread(target=watch).start()
begin = time.perf_counter()
record = read_bag(Path(sys.argv[1]))
seconds = time.perf_counter() - begin
done.set()
size = sum(v.nbytes for v in vars(record).values() if isinstance(v, np.ndarray))
print(json.dumps({{'seconds': seconds, 'samples': record.n, 'record_mb': size / 1e6,
                   'peak_mb': (max(peak) - peak[0]) / 1e6, 'warnings': len(record.warnings)}}))
"""


def memory(bag: Path, small: Path) -> dict[str, float]:
    """Time and peak of anonymous memory of `read_bag` in a process of its own."""
    code = MEMORY.format(paths=sys.path)
    done = subprocess.run(
        [sys.executable, '-c', code, str(bag), str(small)], capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    told: dict[str, float] = json.loads(done.stdout)
    return told


def study(folder: Path, minutes: float, compared_s: float) -> dict[str, object]:
    """Print the table of formats and the long bag; returns the figures."""
    print(
        f'Bag to arrays, {compared_s:g} s of flight, s (best of two), beside rosbags in this run'
    )
    print(
        'bag                    messages  rosbags  deser.    bulk    read deser. x  read x  equal'
    )
    speeds = []
    for name, how in FORMATS.items():
        bag = folder / name.replace(' ', '_')
        write_flight(bag, compared_s, name, how)
        speeds.append(compare(bag, name))
        print(speeds[-1].line())
    long = []
    for share in (0.25, 1.0):
        bag = folder / f'long{share}'
        write_flight(bag, 60 * minutes * share, 'mcap', Limits(split_s=600.0))
        told = {'minutes': minutes * share, **memory(bag, folder / 'mcap')}
        told['bag_mb'] = sum(p.stat().st_size for p in bag.iterdir()) / 1e6
        long.append(told)
        print(
            f'read_bag of {told["minutes"]:g} min ({told["bag_mb"]:.0f} MB): '
            f'{told["seconds"]:.1f} s, record {told["record_mb"]:.0f} MB, '
            f'peak {told["peak_mb"]:.0f} MB more'
        )
    return {
        'deserialise_times_faster': min(s.ratios[0] for s in speeds),
        'read_times_faster': min(s.ratios[1] for s in speeds),
        'bit_for_bit_equal': all(s.equal for s in speeds),
        'long': long,
    }
