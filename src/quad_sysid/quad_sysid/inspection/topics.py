"""How often each topic of the contract came, from the stamps of its messages alone.

Messages are not decoded: every type of the contract opens with its stamp.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from quad_sysid.bags.storage import Storage
from quad_sysid.contract import TOPIC_TYPES

GAP_CYCLES = 1.5
"""A pause between stamps longer than this many intervals is a gap."""
ON_CHANGE = 'rcl_interfaces/msg/ParameterEvent'
STAMP_END = 12


@dataclass(frozen=True)
class TopicContent:
    """One topic as it lies in the bag."""

    name: str
    messages: int
    rate_hz: float | None
    """Median rate of the stamps; None for a topic on change, or with fewer than 3 stamps."""
    span_s: float
    """From the first stamp to the last."""
    gaps: int
    longest_gap_s: float


@dataclass(frozen=True)
class Topics:
    """All topics that hold anything, in the order of the contract, and what reading told."""

    found: tuple[TopicContent, ...]
    absent: tuple[str, ...]
    warnings: tuple[str, ...]


def topics(path: Path) -> Topics:
    """Count every topic of the contract in a bag; raises BadInputError where it is none."""
    storage = Storage(path, tuple(TOPIC_TYPES))
    stamps: dict[str, list[npt.NDArray[np.int64]]] = {}
    for batch in storage.batches():
        for topic, raws in batch.items():
            stamps.setdefault(topic, []).append(_stamps(raws))
    found = tuple(
        _content(topic, np.concatenate(stamps[topic])) for topic in TOPIC_TYPES if topic in stamps
    )
    absent = tuple(topic for topic in TOPIC_TYPES if topic not in stamps)
    return Topics(found, absent, tuple(storage.warnings))


def _stamps(raws: Iterable[bytes]) -> npt.NDArray[np.int64]:
    """(n,) ns, from the first two words behind each message's 4 bytes of encapsulation."""
    whole = [raw for raw in raws if len(raw) >= STAMP_END]
    words = b''.join(bytes(raw[4:STAMP_END]) for raw in whole)
    little = np.array([raw[1] & 1 for raw in whole], dtype=bool)
    as_little = np.frombuffer(words, '<u4').reshape(-1, 2).astype(np.int64)
    as_big = np.frombuffer(words, '>u4').reshape(-1, 2).astype(np.int64)
    parts = np.where(little[:, None], as_little, as_big)
    found: npt.NDArray[np.int64] = parts[:, 0] * 1_000_000_000 + parts[:, 1]
    return found


def _content(topic: str, stamps: npt.NDArray[np.int64]) -> TopicContent:
    times = np.unique(stamps[stamps > 0])
    steps = np.diff(times) * 1e-9
    span = float(steps.sum()) if steps.size else 0.0
    if TOPIC_TYPES[topic] == ON_CHANGE or times.size < 3:
        return TopicContent(topic, int(stamps.size), None, span, 0, 0.0)
    usual = float(np.median(steps))
    wide = steps > GAP_CYCLES * usual
    return TopicContent(
        topic, int(stamps.size), 1.0 / usual, span, int(np.count_nonzero(wide)),
        float(steps.max()) if wide.any() else 0.0,
    )
