"""What a bag says of itself: topics, files, counts → the text of metadata.yaml. No files here.

Source: rosbag2's metadata, version 9, as Jazzy writes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import dump_qos_v9

VERSION = 9


@dataclass(frozen=True)
class RecordedTopic:
    """One topic of a bag, with what a reader needs to decode and replay it."""

    name: str
    kind: str
    """Such as `sensor_msgs/msg/Imu`."""
    definition: str
    digest: str
    """RIHS01 hash of the type."""
    qos: tuple[Qos, ...] = ()
    key: str = ''
    """What it is counted under; its name unless another type has taken that."""

    @property
    def label(self) -> str:
        """Key of its messages in this bag."""
        return self.key or self.name

    @property
    def qos_text(self) -> str:
        """The publishers' QoS as storage plugins keep it, YAML."""
        return yaml.safe_dump(dump_qos_v9(list(self.qos)), sort_keys=False).strip()


@dataclass
class FileEntry:
    """What one storage file holds: messages by topic and their span of receive times (ns)."""

    name: str
    counts: dict[str, int] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0
    size: int = 0
    """Bytes, once the file is closed."""

    @property
    def messages(self) -> int:
        """All topics together."""
        return sum(self.counts.values())

    def add(self, topic: str, number: int, first_ns: int, last_ns: int) -> None:
        """Count messages of one topic that have been stored."""
        self.first_ns = min(self.first_ns or first_ns, first_ns)
        self.last_ns = max(self.last_ns, last_ns)
        self.counts[topic] = self.counts.get(topic, 0) + number


@dataclass(frozen=True)
class BagFormat:
    """How a bag is stored."""

    storage: str = 'mcap'
    compression: str = 'none'
    """`none`, `zstd` or (mcap only) `lz4`; of chunks in mcap, of messages in sqlite3."""

    @property
    def suffix(self) -> str:
        """Of its storage files."""
        return '.mcap' if self.storage == 'mcap' else '.db3'

    @property
    def by_message(self) -> bool:
        """Messages are compressed one by one, which metadata.yaml must say."""
        return self.storage == 'sqlite3' and self.compression != 'none'


def information(
    bag: BagFormat,
    topics: Sequence[RecordedTopic],
    files: Sequence[FileEntry],
    notes: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Content of `rosbag2_bagfile_information` for these files of the bag."""
    filled = [entry for entry in files if entry.messages]
    first = min((entry.first_ns for entry in filled), default=0)
    last = max((entry.last_ns for entry in filled), default=0)
    return {
        'version': VERSION,
        'storage_identifier': bag.storage,
        'duration': {'nanoseconds': last - first},
        'starting_time': {'nanoseconds_since_epoch': first},
        'message_count': sum(entry.messages for entry in files),
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic.name,
                    'type': topic.kind,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': dump_qos_v9(list(topic.qos)),
                    'type_description_hash': topic.digest,
                },
                'message_count': sum(entry.counts.get(topic.label, 0) for entry in files),
            }
            for topic in topics
        ],
        'compression_format': bag.compression if bag.by_message else '',
        'compression_mode': 'message' if bag.by_message else '',
        'relative_file_paths': [entry.name for entry in files],
        'files': [
            {
                'path': entry.name,
                'starting_time': {'nanoseconds_since_epoch': entry.first_ns},
                'duration': {'nanoseconds': entry.last_ns - entry.first_ns},
                'message_count': entry.messages,
            }
            for entry in files
        ],
        'custom_data': dict(notes) if notes else None,
        'ros_distro': 'jazzy',
    }


def yaml_text(content: Mapping[str, Any]) -> str:
    """YAML in the order of the keys."""
    return yaml.safe_dump(dict(content), sort_keys=False)
