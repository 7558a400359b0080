"""A recording in progress: a queue between the subscriptions and the thread that writes the bag.

No ROS. A slow disk fills the queue; a full queue, by messages or by bytes, drops its oldest
messages and counts them. A disk that is full, read-only or gone ends the recording, and the bag is
closed with what it has.
"""

from __future__ import annotations

import errno
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rosbags.interfaces import Qos

from quad_bridge.log.writer import BagWriter
from quad_bridge.status import ERROR, OK, WARN, Status

FLUSH_S = 0.4
"""Age at which a chunk is closed and synced; later where one sync takes longer (docs/log.md)."""
POLL_S = 0.05
"""Interval at which the thread takes the waiting messages."""
SLOW_S = 1.0
"""Duration of a sync from which a warning is given."""
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Faults that leave what was written before: after any other, such as a sync that failed, the
system may have dropped it, and the next sync does not say so."""
LOW_DISK_BYTES = 100_000_000
"""Free space below which a warning is given."""


@dataclass(frozen=True)
class RecordingStatus:
    """A snapshot for diagnostics."""

    path: Path
    written: int
    waiting: int
    dropped: int
    """Messages dropped here: the oldest of a full queue, or those after a fault of the disk."""
    lost: int
    """Messages that the middleware reports as lost before they arrived."""
    failure: str
    """Why the recording ended by itself; empty while it has not."""
    size: int = 0
    """Bytes of the bag."""
    longest_sync_s: float = 0.0


def recording_status(
    status: RecordingStatus | None, last: str, free_bytes: int | None = None
) -> Status:
    """The logger's entry of /diagnostics.

    `status` is that of the running recording, or of the last one if it failed, else None; `last`
    is the last announcement.
    """
    disk = {} if free_bytes is None else {'free disk (MB)': free_bytes // 1_000_000}
    if status is None:
        return Status('recording', OK, last or 'idle', disk)
    values = {
        'path': status.path,
        'messages written': status.written,
        'messages waiting': status.waiting,
        'messages dropped (disk)': status.dropped,
        'messages lost (middleware)': status.lost,
        'bag (MB)': f'{status.size / 1e6:.1f}',
        'longest sync of the disk (s)': f'{status.longest_sync_s:.2f}',
        **disk,
    }
    level, text = WARN, 'recording'
    if status.failure:
        level, text = ERROR, status.failure
    elif status.dropped or status.lost:
        text += f', {status.dropped + status.lost} messages lost'
    elif free_bytes is not None and free_bytes < LOW_DISK_BYTES:
        text += f', the disk is nearly full: {free_bytes // 1_000_000} MB are free'
    elif status.longest_sync_s > SLOW_S:
        text += f', the disk is slow: {status.longest_sync_s:.1f} s for one sync'
    else:
        level = OK
    return Status('recording', level, text, values)


class Recording:
    """Owns one bag and its thread from construction to `stop`."""

    def __init__(
        self, writer: BagWriter, capacity: int = 50_000, capacity_bytes: int = 64_000_000
    ) -> None:
        """Start the thread; so many messages, and bytes of them, may wait."""
        self._writer = writer
        self._capacity, self._capacity_bytes = capacity, capacity_bytes
        self._putting = threading.Lock()
        # that came into the queue, and left it: each counted by `put` or in the thread only
        self._put_bytes = self._dequeued_bytes = self._dropped_bytes = 0
        self._queue: deque[tuple[str, int, bytes]] = deque()
        self._declared: dict[str, tuple[str, tuple[Qos, ...]]] = {}
        self._dropped = 0
        self._lost = 0
        self._dequeued = 0
        """Messages that the writer has removed from the queue."""
        self._count = 0
        self._longest_sync_s = 0.0
        self._failure = ''
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name='bag writer', daemon=True)
        self._thread.start()

    @property
    def status(self) -> RecordingStatus:
        """Path, counts, failure."""
        return RecordingStatus(
            path=self._writer.path,
            written=self._count,
            waiting=len(self._queue),
            dropped=self._dropped,
            lost=self._lost,
            failure=self._failure,
            size=self._writer.size,
            longest_sync_s=self._longest_sync_s,
        )

    def known(self, topic: str) -> bool:
        """Whether the topic has been declared."""
        return topic in self._declared

    def declare(self, topic: str, kind: str, qos: tuple[Qos, ...]) -> None:
        """Declare a topic before its first message, with the QoS that its publishers offer."""
        self._declared[topic] = kind, qos

    def put(self, topic: str, time_ns: int, data: bytes) -> None:
        """Queue one serialised message of a declared topic, from any thread; returns at once."""
        with self._putting:
            if self._failure:
                self._dropped += 1
                return
            if len(self._queue) >= self._capacity and self._drop_oldest():
                self._dropped += 1
            self._put_bytes += len(data)
            while self._waiting_bytes > self._capacity_bytes and self._drop_oldest():
                self._dropped += 1
            self._queue.append((topic, time_ns, data))

    @property
    def _waiting_bytes(self) -> int:
        return self._put_bytes - self._dequeued_bytes - self._dropped_bytes

    def count_large(self) -> None:
        """Add a message that was too large to be queued."""
        self._dropped += 1

    def count_lost(self, number: int) -> None:
        """Add messages that the middleware lost."""
        self._lost += number

    def stop(self) -> RecordingStatus:
        """Write the waiting messages and close the bag; `status.failure` says if that failed."""
        self._stopping.set()
        self._thread.join()
        return self.status

    def _drop_oldest(self) -> bool:
        try:
            _, _, data = self._queue.popleft()
        except IndexError:  # the thread was faster
            return False
        self._dropped_bytes += len(data)
        return True

    def _run(self) -> None:
        try:
            self._write_until_stopped()
            self._drain()
            self._writer.close()
        except Exception as error:  # noqa: BLE001  (a dead thread would lose all without a word)
            self._fail(error)

    def _write_until_stopped(self) -> None:
        flushed_s = time.monotonic()
        while not self._stopping.wait(POLL_S) and not self._failure:
            self._drain()
            began_s = time.monotonic()
            if began_s - flushed_s >= FLUSH_S - POLL_S:
                flushed_s = began_s
                self._writer.flush()
                self._longest_sync_s = max(self._longest_sync_s, time.monotonic() - began_s)

    def _drain(self) -> None:
        """Write the messages that wait now, not those that arrive meanwhile."""
        for _ in range(len(self._queue)):
            try:
                topic, time_ns, data = self._queue.popleft()
            except IndexError:  # dropped meanwhile
                return
            self._dequeued += 1
            self._dequeued_bytes += len(data)
            if topic not in self._writer.counts:
                self._writer.add_topic(topic, *self._declared[topic])
            self._writer.write(topic, time_ns, data)
            self._count += 1

    def _fail(self, error: Exception) -> None:
        """Close the bag as it is; dequeued messages that are not in it count as dropped."""
        reason = f'writing failed: {" ".join(str(error).split())}'
        self._failure = f'{self._writer.path}: {reason}'  # from here on `put` drops
        try:
            self._writer.close_after_fault()
            end = 'closed, whole up to here'
            if getattr(error, 'errno', None) not in FULL:
                end = 'closed; `ros2 run quad_bridge recover` says what of it the disk has kept'
        except Exception as second:  # noqa: BLE001
            self._writer.abort()
            end = f'not closed ({second}); `ros2 run quad_bridge recover` reads it'
            if not self._writer.path.exists():
                end = 'gone, unless it was moved: `ros2 run quad_bridge recover` reads it there'
        self._count = sum(self._writer.counts.values())
        self._dropped += self._dequeued - self._count + len(self._queue)
        self._queue.clear()
        self._failure = f'{self._writer.path}: {reason}; the bag is {end}'


class Gaps:
    """Counts messages of one topic that were lost before arrival, by the publishers' numbers.

    A middleware with a bounded history overwrites messages that a late reader has not fetched, and
    reports few of them as lost. Several publishers may number independently.
    """

    def __init__(self) -> None:
        self._last: list[int] = []
        """Last number of each publisher, the most recent publisher last."""

    def lost_before(self, number: int, publishers: Callable[[], int]) -> int:
        """Number of messages missing before this one.

        The publisher is not known; it is the one whose numbering it continues. `publishers`
        returns their number and is called only where none fits.
        """
        if number - 1 in self._last:
            self._last.remove(number - 1)
            self._last.append(number)
            return 0
        count = max(publishers(), 1)
        below = [last for last in self._last if last < number]
        if number == 1 or len(self._last) < count or not below:  # a new publisher, or a restart
            self._last = [*self._last, number][-count:]
            return 0
        previous = max(below)
        self._last.remove(previous)
        self._last.append(number)
        return number - previous - 1
