"""A recording in progress: a queue between the subscriptions and the thread that writes the bag.

No ROS. Losses are counted, a fault of the disk ends the recording with a reason.
"""

from __future__ import annotations

import queue
import sqlite3
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from rosbags.interfaces import Qos
from rosbags.rosbag2 import WriterError

from quad_bridge.bag_writer import BagWriter

FLUSH_S = 0.5
_FAULTS = (OSError, sqlite3.Error, WriterError, ValueError)


@dataclass(frozen=True)
class RecordingStatus:
    """A snapshot for diagnostics."""

    path: Path
    written: int
    waiting: int
    dropped: int
    """Messages that found the queue full."""
    lost: int
    """Messages that the middleware reports as lost before they arrived."""
    failure: str
    """Why the recording has ended by itself; empty while all is well."""


class Recording:
    """Owns one bag and its thread from construction to `stop`."""

    def __init__(self, writer: BagWriter, *, capacity: int = 50_000) -> None:
        """Start the thread; `capacity` is the number of messages that may wait."""
        self._writer = writer
        self._capacity = capacity
        self._queue: queue.SimpleQueue[tuple[str, int, bytes] | None] = queue.SimpleQueue()
        self._dropped = 0
        self._lost = 0
        self._written = 0
        self._failure = ''
        self._topics: set[str] = set()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name='bag writer', daemon=True)
        self._thread.start()

    @property
    def status(self) -> RecordingStatus:
        """Path, counts, failure."""
        return RecordingStatus(
            path=self._writer.path,
            written=self._written,
            waiting=self._queue.qsize(),
            dropped=self._dropped,
            lost=self._lost,
            failure=self._failure,
        )

    def known(self, topic: str) -> bool:
        """True once the topic has been declared."""
        return topic in self._topics

    def declare(self, topic: str, kind: str, qos: tuple[Qos, ...]) -> None:
        """Declare a topic before its first message, with the QoS that its publishers offer."""
        with self._lock:
            self._writer.add_topic(topic, kind, qos)
        self._topics.add(topic)

    def put(self, topic: str, time_ns: int, data: bytes) -> None:
        """Queue one serialised message of a declared topic; returns at once."""
        if self._failure or self._queue.qsize() >= self._capacity:
            self._dropped += 1
        else:
            self._queue.put((topic, time_ns, data))

    def count_lost(self, number: int) -> None:
        """Add messages that the middleware lost."""
        self._lost += number

    def stop(self) -> RecordingStatus:
        """Write what waits, close the bag; the status afterwards tells whether it is whole."""
        self._queue.put(None)
        self._thread.join()
        if not self._failure:
            try:
                self._writer.close()
            except _FAULTS as error:
                self._fail(error)
        return self.status

    def _run(self) -> None:
        try:
            self._write_until_stopped()
        except _FAULTS as error:
            self._fail(error)

    def _write_until_stopped(self) -> None:
        flushed_s = time.monotonic()
        while True:
            try:
                item = self._queue.get(timeout=FLUSH_S)
                if item is None:
                    return
                with self._lock:
                    self._writer.write(*item)
                self._written += 1
            except queue.Empty:
                pass
            now_s = time.monotonic()
            if now_s - flushed_s >= FLUSH_S:
                flushed_s = now_s
                with self._lock:
                    self._writer.flush()

    def _fail(self, error: Exception) -> None:
        self._failure = f'{self._writer.path}: writing failed: {" ".join(str(error).split())}'
        try:
            self._writer.abort()
        except _FAULTS as second:
            self._failure += f' ({second})'
