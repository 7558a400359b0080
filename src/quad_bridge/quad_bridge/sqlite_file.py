"""One sqlite3 file being written, in rosbag2's tables; each `sync` is one transaction.

Not for reading, knows no bag around it (bag_writer.py). The rollback journal is left at SQLite's
default: what a killed transaction has begun is undone by whoever opens the file next.
Source: rosbag2_storage_sqlite3, schema version 4, as Jazzy writes it.
"""

from __future__ import annotations

import sqlite3
from pathlib import Path

from quad_bridge.bag_metadata import VERSION, FileEntry, RecordedTopic
from quad_bridge.compression import COMPRESSORS

TABLES = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL,
  metadata TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
  serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,
  type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL,
  encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL,
  type_description_hash TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
  timestamp INTEGER NOT NULL, data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema(schema_version, ros_distro) VALUES (4, 'jazzy');
"""
_ROW = 40
"""Bytes that a row takes beside its data, about (row, index entry)."""


class SqliteFile:
    """Open from construction to `close` or `abandon`. All methods may raise sqlite3.Error."""

    def __init__(self, path: Path, compression: str = 'none') -> None:
        """Create the file; FileExistsError where there is one."""
        path.touch(exist_ok=False)
        self.path = path
        self._compress = COMPRESSORS[compression]
        self._base = sqlite3.connect(path, check_same_thread=False)
        self._base.execute('PRAGMA locking_mode=EXCLUSIVE')  # no reader can hold up the recorder
        self._base.executescript(TABLES)
        self._topics: dict[str, int] = {}
        self._kinds: set[str] = set()
        self._declarations: list[tuple[str, tuple[object, ...]]] = []
        """Statements that declare topics, for the next transaction."""
        self._rows: list[tuple[int, int, bytes | memoryview]] = []
        self._written = 0
        self.entry = FileEntry(path.name)
        """What finished transactions hold."""

    @property
    def size(self) -> int:
        """Bytes on their way to the disk, about."""
        return self._written

    @property
    def pending(self) -> int:
        """Messages that wait for the next transaction: those that a kill would lose."""
        return len(self._rows)

    def add_topic(self, topic: RecordedTopic) -> None:
        """Declare a topic of this file before its first message."""
        if topic.kind not in self._kinds:
            coding = 'ros2idl' if topic.definition.startswith('=' * 80) else 'ros2msg'
            self._declarations.append(
                (
                    'INSERT INTO message_definitions VALUES(NULL, ?, ?, ?, ?)',
                    (topic.kind, coding, topic.definition, topic.digest),
                )
            )
            self._kinds.add(topic.kind)
        number = len(self._topics) + 1
        self._declarations.append(
            (
                'INSERT INTO topics VALUES(?, ?, ?, ?, ?, ?)',
                (number, topic.name, topic.kind, 'cdr', topic.qos_text, topic.digest),
            )
        )
        self._topics[topic.label] = number

    def write(self, topic: str, time_ns: int, data: bytes | memoryview) -> None:
        """Keep one message for the next transaction."""
        packed = self._compress(bytes(data))
        self._rows.append((self._topics[topic], time_ns, packed))
        self._written += len(packed) + _ROW

    def sync(self) -> None:
        """Write what waits in one transaction: from here it survives a power cut."""
        for statement, values in self._declarations:
            self._base.execute(statement, values)
        if self._rows:
            self._base.executemany('INSERT INTO messages VALUES(NULL, ?, ?, ?)', self._rows)
        self._base.commit()
        self._declarations.clear()
        names = list(self._topics)
        for number, time_ns, _ in self._rows:
            self.entry.add(names[number - 1], 1, time_ns, time_ns)
        self._rows.clear()

    def cut_back(self) -> None:
        """Undo a transaction that failed."""
        self._base.rollback()

    def forget(self) -> None:
        """Drop the messages that wait."""
        self._rows.clear()

    def close(self, metadata: str) -> None:
        """Write the rest and rosbag2's metadata (YAML)."""
        self._base.execute('INSERT INTO metadata VALUES(NULL, ?, ?)', (VERSION, metadata))
        self.sync()
        self._base.close()

    def abandon(self) -> None:
        """Close without metadata; what was synced stays. A second time does nothing."""
        self._base.close()
