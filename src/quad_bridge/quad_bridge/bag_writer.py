"""Serialised messages into a rosbag2 bag, mcap or sqlite3, through rosbags. No ROS, no threads.

What is written is on its way to the disk after `flush`, also when the process dies afterwards:
rosbags alone would hold up to a megabyte back.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, TypesysError, get_typestore

from quad_bridge.errors import BadInputError

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
COMPRESSIONS = ('none', 'zstd')
METADATA_VERSION: Literal[9] = 9
"""Of metadata.yaml, as Jazzy writes it."""


def free_path(folder: Path, prefix: str, now: datetime) -> Path:
    """A path in `folder` that does not exist yet: prefix, date, time, a number where needed."""
    stem = f'{prefix}_{now:%Y%m%d_%H%M%S}'

    def candidates() -> Iterator[Path]:
        yield folder / stem
        number = 2
        while True:
            yield folder / f'{stem}_{number}'
            number += 1

    return next(path for path in candidates() if not path.exists())


@dataclass(frozen=True)
class Definition:
    """A message's definition where the bag that is copied brings it along."""

    text: str
    digest: str
    """RIHS01 hash; empty where unknown."""


class BagWriter:
    """One bag, open from construction to `close`; never writes over an existing one."""

    def __init__(self, path: Path, storage: str = 'mcap', compression: str = 'none') -> None:
        """Create the bag's directory. Raises BadInputError where it cannot be."""
        if storage not in STORAGES:
            raise BadInputError(str(path), 'storage must be mcap or sqlite3', storage)
        if compression not in COMPRESSIONS:
            raise BadInputError(str(path), 'compression must be none or zstd', compression)
        self.path = path
        self.counts: dict[str, int] = {}
        """Messages written, by topic."""
        self._connections: dict[str, Connection] = {}
        self._store = get_typestore(Stores.ROS2_JAZZY)
        try:
            self._writer = Writer(path, version=METADATA_VERSION, storage_plugin=STORAGES[storage])
            if compression == 'zstd':
                chunks = storage == 'mcap'
                mode = CompressionMode.STORAGE if chunks else CompressionMode.MESSAGE
                self._writer.set_compression(mode, CompressionFormat.ZSTD)
            self._writer.open()
        except (OSError, WriterError) as error:
            raise BadInputError(str(path), f'cannot write a bag here: {error}') from error

    def add_topic(
        self,
        topic: str,
        kind: str,
        qos: tuple[Qos, ...] = (),
        definition: Definition | None = None,
    ) -> None:
        """Declare a topic before its first message; a second time does nothing.

        `kind` such as `sensor_msgs/msg/Imu`. Raises BadInputError for a type that neither Jazzy's
        standard types nor `definition` give.
        """
        if topic in self._connections:
            return
        try:
            text, _ = self._store.generate_msgdef(kind, ros_version=2)
            digest = self._store.hash_rihs01(kind)
        except (TypesysError, KeyError) as error:
            if definition is None or not definition.text:
                where = f'{self.path}: {topic}'
                raise BadInputError(where, 'message type is not a standard one', kind) from error
            text, digest = definition.text, definition.digest or 'RIHS01_' + '0' * 64
        self._connections[topic] = self._writer.add_connection(
            topic, kind, msgdef=text, rihs01=digest, offered_qos_profiles=qos
        )
        self.counts[topic] = 0

    def write(self, topic: str, time_ns: int, data: bytes | memoryview) -> None:
        """Append one serialised message; `time_ns` is when it was received."""
        self._writer.write(self._connections[topic], time_ns, data)
        self.counts[topic] += 1

    def flush(self) -> None:
        """Hand everything written so far to the disk. Raises OSError or sqlite3.Error."""
        storage: Any = self._writer.storage
        if hasattr(storage, 'close_chunk'):
            if storage.chunk.msgs:
                storage.close_chunk()
            storage.bio.flush()
            os.fdatasync(storage.bio.fileno())
        else:
            storage.conn.commit()

    def close(self) -> None:
        """Write the index and metadata.yaml."""
        self._writer.close()

    def abort(self) -> None:
        """Give up without index: what was flushed stays, `recover` reads it."""
        self._writer.abort()
