"""`ros2 run quad_bridge recover BAG`: a damaged bag read as far as it is whole, written as mcap.

The original is only read, and a sound one is copied only where --out asks for it. A damaged
sqlite3 file is left to the `sqlite3` command. The losses are printed; exit status as in the
contract.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

from quad_bridge.arguments import OneLineParser, ended_in_one_line, say
from quad_bridge.errors import BadInputError
from quad_bridge.log.reader import messages_of, storage_files
from quad_bridge.log.stored.files import PACKED, RECORDING, missing_parts, recording_state
from quad_bridge.log.stored.records import Topic
from quad_bridge.log.stored.scan import McapScan, Message
from quad_bridge.log.writer import BagWriter, Definition

LATEST_NS = 1 << 63
"""Latest plausible receive time."""


@dataclass
class Recovered:
    """The result of a recovery."""

    path: Path
    """The new bag; the old one where it is sound and no copy was requested."""
    counts: dict[str, int] = field(default_factory=dict)
    lost: int = 0
    """Lower bound on the lost messages; the missing end of a file may have held more."""
    unread_bytes: int = 0
    total_bytes: int = 0
    undecodable: int = 0
    """Messages with damaged compression, time or topic."""
    notes: list[str] = field(default_factory=list)
    sound: bool = True
    """Whether the bag is whole as it lies there."""
    kinds: dict[str, str] = field(default_factory=dict)
    """First type of each topic."""

    @property
    def messages(self) -> int:
        """Messages that are whole, all of which a new bag has."""
        return sum(self.counts.values())

    def lines(self) -> list[str]:
        """The summary as text lines."""
        counts = [f'  {count:8d}  {topic}' for topic, count in sorted(self.counts.items())]
        if self.sound:
            return [f'{self.path}: {self.messages} messages, none missing', *counts]
        share = 100.0 * self.unread_bytes / max(self.total_bytes, 1)
        lost = f'{self.unread_bytes} of {self.total_bytes} bytes ({share:.2f} %) are not whole'
        if self.undecodable:
            lost += f', {self.undecodable} messages are damaged in themselves'
        if self.lost:
            lost += f', at least {self.lost} messages are missing'
        head = f'{self.path}: {self.messages} messages recovered; lost: {lost}'
        return [head, *self.notes, *counts]


def recover(bag: Path, out: Path | None = None) -> Recovered:
    """Write what is whole of `bag` (a directory or an .mcap or .db3 file) as a new bag.

    `out`: default `<bag>_recovered` beside it, where it is damaged. Raises BadInputError where
    nothing can be recovered or the new bag exists already.
    """
    files, resolved = storage_files(bag), bag.resolve()
    state = recording_state(files[-1])
    if state == RECORDING:
        raise BadInputError(str(bag), state, remedy='stop the recording first')
    stem = resolved.name.removesuffix(PACKED).removesuffix('.mcap').removesuffix('.db3')
    target = resolved.with_name(f'{stem}_recovered') if out is None else out.absolute()
    if out is not None and target.exists():
        raise BadInputError(str(target), 'exists already', remedy='name another with --out')
    if out is None and (checked := _copied(bag, files, bag, Tally())).sound:
        return checked
    if target.exists():
        raise BadInputError(str(target), 'exists already',
                            remedy='move it away, or name another with --out')
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix='.unfinished_') as work:
            writer = BagWriter(Path(work, target.name))
            result = _copied(bag, files, target, writer)
            writer.close()
            writer.path.rename(target)
    except OSError as error:
        raise BadInputError(str(target), f'cannot be written: {error.strerror}',
                            remedy='make room, or choose another place by --out') from error
    return result


class Tally:
    """Stands in for a writer, and counts what it would have written."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}

    def add_topic(self, key: str, *_: object, **__: object) -> None:
        """Count messages of this key."""
        self.counts[key] = 0

    def write(self, key: str, *_: object) -> None:
        """Count one."""
        self.counts[key] += 1


def _copied(bag: Path, files: Sequence[Path], target: Path,
            writer: BagWriter | Tally) -> Recovered:
    """Copy all intact messages; BadInputError where there are none."""
    result = Recovered(target)
    result.notes += [f'  {note}' for note in missing_parts(files)]
    counted = _counted(bag)
    result.sound = not result.notes and (counted is not None or not bag.is_dir())
    for file in files:
        _copy_file(file, writer, result, alone=len(files) == 1)
    if not result.messages:
        what = '; '.join(('holds no whole message', *map(str.strip, result.notes)))
        raise BadInputError(str(bag), what, remedy='nothing to recover')
    absent = (counted or 0) - result.messages - result.undecodable
    if absent > 0:
        result.notes.append(f'  metadata.yaml counts {counted} messages')
        result.lost = max(result.lost, absent)
    result.sound &= not (result.lost or result.undecodable)
    return result


def _counted(bag: Path) -> int | None:
    """Number of messages by metadata.yaml; None where it does not say."""
    try:
        content = yaml.safe_load((bag / 'metadata.yaml').read_text(encoding='utf-8'))
        return int(content['rosbag2_bagfile_information']['message_count'])
    except (OSError, ValueError, LookupError, TypeError, yaml.YAMLError):
        return None


def _copy_file(file: Path, writer: BagWriter | Tally, result: Recovered, *, alone: bool) -> None:
    """Copy the intact messages; BadInputError where the bag's only file is unreadable."""
    undecodable = result.undecodable

    def judge(scan: McapScan, file: Path) -> None:
        result.total_bytes += len(scan.data)
        result.unread_bytes += scan.unread
        result.lost += scan.lost
        result.sound &= scan.complete
        notes = _notes(scan, all_decoded=result.undecodable == undecodable)
        result.notes += [f'  {file.name}: {note}' for note in notes]

    try:
        for message in messages_of(file, judge):
            _copy(message, writer, result)
        if file.name.removesuffix(PACKED).endswith('.db3'):
            result.notes.append(f'  {file.name}: all its rows are there (without checksums)')
    except BadInputError as error:
        if alone:
            raise
        result.notes.append(f'  {error}')
        result.sound = False


def _copy(message: Message, writer: BagWriter | Tally, result: Recovered) -> None:
    if not message.data or message.time_ns >= LATEST_NS:
        result.undecodable += 1
        return
    key = _declared(message.topic, writer, result)
    writer.write(key, message.time_ns, message.data)
    result.counts[key] = writer.counts[key]


def _declared(topic: Topic, writer: BagWriter | Tally, result: Recovered) -> str:
    """Declare the topic; returns its key."""
    key = topic.name
    if result.kinds.setdefault(key, topic.kind) != topic.kind:
        key = f'{topic.name} as {topic.kind}'
    if key not in writer.counts:
        qos, definition = _qos(topic, result), Definition(topic.definition, topic.digest)
        writer.add_topic(key, topic.kind, qos, definition, name=topic.name)
    return key


def _qos(topic: Topic, result: Recovered) -> tuple[Qos, ...]:
    if not topic.qos:
        return ()
    try:
        return tuple(parse_qos(topic.qos))
    except Exception as error:  # noqa: BLE001  (whatever a damaged text makes the parser raise)
        result.notes.append(f'  {topic.name}: its QoS is not readable ({error}); left out')
        result.sound = False
        return ()


def _notes(scan: McapScan, *, all_decoded: bool) -> list[str]:
    """Notes on one file."""
    notes = []
    if scan.bad_chunks:
        notes.append(f'{scan.bad_chunks} chunks are not whole')
    if scan.unchecked:
        notes.append(f'{scan.unchecked} messages of the last one lack their checksum')
    if scan.unnamed:
        notes.append(f'{scan.unnamed} messages have lost their topic')
    if scan.stated is not None and scan.lost:
        notes.append(f'its statistics count {scan.stated} messages')
    if not scan.ended:
        notes.append('ends without its index')
    elif scan.complete and all_decoded:
        notes.append('its data are complete')
    elif not (scan.stated or scan.lost or scan.unread or scan.bad_chunks):
        notes.append('read to its end, where its summary is damaged: what is missing is not known')
    else:
        notes.append('its data are damaged, their end is there')
    return notes


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; exits with the contract's status."""
    parser = OneLineParser(
        prog='recover', description='Rebuild a bag whose recorder was killed or whose files are '
        'damaged. The bag is only read; a sound one is left as it is.'
    )
    parser.add_argument('bag', type=Path, metavar='BAG', help='bag directory, .mcap or .db3 file')
    parser.add_argument('--out', type=Path, metavar='DIR', help='a new folder '
                        '(default: BAG_recovered beside a damaged bag, none of a sound one)')
    options = parser.parse_args(arguments)
    result = ended_in_one_line('recover', lambda: recover(options.bag, options.out))
    say('\n'.join(result.lines()) + '\n')
    if result.path == options.bag:
        say('the bag is sound: nothing to recover, nothing copied (--out DIR does)\n')
