"""`ros2 run quad_bridge recover BAG`: a damaged bag read as far as it is whole, written anew.

The original is only read. What was lost is said on stdout; exit status as in the contract.
"""

from __future__ import annotations

import re
import shutil
import sqlite3
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

from quad_bridge.arguments import OneLineParser
from quad_bridge.bag_writer import BagWriter, Definition
from quad_bridge.compression import decompress
from quad_bridge.damaged_mcap import DamagedMcap, Message, Topic
from quad_bridge.damaged_sqlite import DamagedSqlite
from quad_bridge.errors import BadInputError, QuadBridgeError

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
HOLE_S = 1.0
"""Silence of all topics that is told."""


@dataclass
class Recovered:
    """What was found in a bag, and what not."""

    path: Path
    counts: dict[str, int] = field(default_factory=dict)
    unread_bytes: int = 0
    total_bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    undecodable: int = 0
    """Messages whose own compression is damaged."""
    notes: list[str] = field(default_factory=list)
    holes: list[tuple[int, int]] = field(default_factory=list)
    """Stretches of receive time (ns) without any message."""

    @property
    def messages(self) -> int:
        """Messages written to the new bag."""
        return sum(self.counts.values())

    def lines(self) -> list[str]:
        """The summary for people."""
        seconds = (self.last_ns - self.first_ns) * 1e-9
        share = 100.0 * self.unread_bytes / max(self.total_bytes, 1)
        lost = f'{self.unread_bytes} of {self.total_bytes} bytes ({share:.2f} %) are not whole'
        if self.undecodable:
            lost += f', {self.undecodable} messages are damaged in themselves'
        counts = [f'  {count:8d}  {topic}' for topic, count in sorted(self.counts.items())]
        holes = [
            f'  nothing for {(end - start) * 1e-9:.2f} s at {(start - self.first_ns) * 1e-9:.2f} s'
            for start, end in self.holes
        ]
        return [
            f'{self.path}: {self.messages} messages over {seconds:.2f} s recovered; lost: {lost}',
            *self.notes,
            *holes,
            *counts,
        ]


def recover(bag: Path) -> Recovered:
    """Write `<bag>_recovered` beside `bag` (a directory or an .mcap or .db3 file).

    Raises BadInputError where nothing can be recovered or the result exists already.
    """
    files = _storage_files(bag)
    whole = bag.resolve()
    stem = whole.name.removesuffix('.mcap').removesuffix('.db3')
    target = whole.with_name(f'{stem}_recovered')
    if target.exists():
        raise BadInputError(str(target), 'exists already', remedy='move it away first')
    result = Recovered(target, total_bytes=sum(file.stat().st_size for file in files))
    result.notes += _missing_parts(files)
    storage = 'sqlite3' if files[0].suffix == '.db3' else 'mcap'
    work = target.with_name(f'{target.name}.part')
    shutil.rmtree(work, ignore_errors=True)
    try:
        work.mkdir()
        writer = BagWriter(work / target.name, storage)
        for file in files:
            read = _sqlite_messages if file.suffix == '.db3' else _mcap_messages
            try:
                for message in read(file, result):
                    _copy(message, writer, result)
            except BadInputError as error:  # one file of a split bag; alone it is the answer
                if len(files) == 1:
                    raise
                result.notes.append(f'  {error}')
        writer.close()
        if not result.messages:
            raise BadInputError(str(bag), 'holds no whole message', remedy='nothing to recover')
        (work / target.name).rename(target)
    except (OSError, sqlite3.Error) as error:
        what = f'cannot be written: {getattr(error, "strerror", None) or error}'
        remedy = 'make room, or copy the bag elsewhere'
        raise BadInputError(str(target), what, remedy=remedy) from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return result


def _storage_files(bag: Path) -> list[Path]:
    if bag.is_file():
        files = [bag]
    elif bag.is_dir():
        found = (p for p in bag.iterdir() if p.suffix in {'.mcap', '.db3'})
        files = sorted(found, key=lambda p: (len(p.name), p.name))
    else:
        raise BadInputError(str(bag), 'does not exist', remedy='check the path')
    if not files or files[0].suffix not in {'.mcap', '.db3'}:
        raise BadInputError(str(bag), 'holds no .mcap or .db3 file', remedy='check the path')
    return files


def _missing_parts(files: list[Path]) -> list[str]:
    """Parts of a split bag, numbered by the recorder, that are not there."""
    numbers = [int(m[1]) for m in (re.search(r'_(\d+)$', file.stem) for file in files) if m]
    if len(numbers) != len(files) or min(numbers) > 0 or max(numbers) > 10_000:
        return []
    absent = sorted(set(range(max(numbers))) - set(numbers))
    return [f'  part {number} of the bag is missing' for number in absent]


def _copy(message: Message, writer: BagWriter, result: Recovered) -> None:
    topic, data = message.topic, message.data
    if data[:4] == ZSTD_MAGIC:
        data, whole = decompress('zstd', data)
        if not whole:
            result.undecodable += 1
            return
    if topic.name not in writer.counts:
        qos = _qos(topic, result)
        writer.add_topic(topic.name, topic.kind, qos, Definition(topic.definition, ''))
    writer.write(topic.name, message.time_ns, data)
    result.counts[topic.name] = writer.counts[topic.name]
    if result.last_ns and message.time_ns - result.last_ns > HOLE_S * 1e9:
        result.holes.append((result.last_ns, message.time_ns))
    result.first_ns = min(result.first_ns or message.time_ns, message.time_ns)
    result.last_ns = max(result.last_ns, message.time_ns)


def _qos(topic: Topic, result: Recovered) -> tuple[Qos, ...]:
    if not topic.qos:
        return ()
    try:
        return tuple(parse_qos(topic.qos))
    except Exception as error:  # noqa: BLE001  (whatever a damaged text makes the parser raise)
        result.notes.append(f'  {topic.name}: its QoS is not readable ({error}); left out')
        return ()


def _mcap_messages(file: Path, result: Recovered) -> Iterator[Message]:
    damaged = DamagedMcap(file)
    yield from damaged.messages()
    result.unread_bytes += damaged.unread
    if damaged.bad_chunks:
        result.notes.append(f'  {file.name}: {damaged.bad_chunks} chunks are not whole')
    if damaged.complete:
        result.notes.append(f'  {file.name}: its data were complete')
    else:
        result.notes.append(f'  {file.name}: ends without its index')


def _sqlite_messages(file: Path, result: Recovered) -> Iterator[Message]:
    damaged = DamagedSqlite(file)
    yield from damaged.messages()
    result.notes += [f'  {note}' for note in damaged.notes]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; exits with the contract's status."""
    parser = OneLineParser(
        prog='recover', description='Rebuild a bag whose recorder was killed, as BAG_recovered.'
    )
    parser.add_argument('bag', type=Path, metavar='BAG', help='bag directory, .mcap or .db3 file')
    bag = parser.parse_args(arguments).bag
    try:
        result = recover(bag)
    except (QuadBridgeError, OSError) as error:
        sys.stderr.write(f'recover: {" ".join(str(error).split())}\n')
        sys.exit(2)
    sys.stdout.write('\n'.join(result.lines()) + '\n')
