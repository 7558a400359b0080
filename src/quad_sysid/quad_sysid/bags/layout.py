"""Where the numbers of one serialised message lie: a walk over its type's fields, without values.

Serves cdr.py, which reads many messages of one layout at once. The types' fields come from
rosbags. Source of the rules: OMG CDR (XCDR1), 4 bytes of encapsulation header, alignment counted
after it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rosbags.typesys.store import Typestore

LITTLE_ENDIAN = b'\x00\x01'
PADDING = 3
"""Bytes that may follow the last field."""
_DTYPES = {
    'bool': '|u1', 'byte': '|u1', 'char': '|u1', 'uint8': '|u1', 'int8': '|i1', 'uint16': '<u2',
    'int16': '<i2', 'uint32': '<u4', 'int32': '<i4', 'uint64': '<u8', 'int64': '<i8',
    'float32': '<f4', 'float64': '<f8',
}  # fmt: skip
_LENGTH = struct.Struct('<I')


class LayoutError(Exception):
    """The bytes hold no message of a layout that can be read in bulk."""


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Rosbags' table of Jazzy's message types."""
    return get_typestore(Stores.ROS2_JAZZY)


@dataclass(frozen=True)
class Step:
    """What follows next in a message: numbers one after the other, a string, or many of them."""

    names: tuple[str, ...]
    """Of the numbers, such as `orientation.x`; one name for a string or a sequence."""
    dtype: str = ''
    """Of numbers; empty for strings."""
    many: bool = False
    """A sequence, its length before it."""

    @property
    def size(self) -> int:
        """Bytes of one number."""
        return np.dtype(self.dtype).itemsize


@dataclass
class Layout:
    """Messages of this layout agree in the `fixed` bytes and have a terminated text in `texts`."""

    places: list[tuple[int, int]] = field(default_factory=list)
    """(offset, count) of each step's numbers."""
    fixed: list[tuple[int, int]] = field(default_factory=list)
    """Byte ranges [start, stop) of lengths."""
    texts: list[tuple[int, int]] = field(default_factory=list)
    """Byte ranges of strings, the zero at their end included."""
    lists: dict[str, list[str]] = field(default_factory=dict)
    """Content of sequences of strings; their bytes stand in `fixed` too."""
    end: int = 4


@lru_cache(maxsize=64)
def steps_of(msgtype: str) -> tuple[Step, ...]:
    """Steps of a type, neighbours of one number type joined. Raises LayoutError."""
    joined: list[Step] = []
    for step in _steps(msgtype, ''):
        last = joined[-1] if joined else None
        if last and step.dtype and last.dtype == step.dtype and not (last.many or step.many):
            joined[-1] = Step(last.names + step.names, step.dtype)
        else:
            joined.append(step)
    return tuple(joined)


def _steps(msgtype: str, prefix: str) -> Iterator[Step]:
    for name, description in typestore().fielddefs[msgtype][1]:
        yield from _field(description, prefix + name)


def _field(description: Any, name: str) -> Iterator[Step]:
    kind, content = description
    if kind == Nodetype.NAME:
        yield from _steps(content, f'{name}.')
    elif kind == Nodetype.BASE:
        yield _base(content[0], name, many=False)
    elif kind == Nodetype.ARRAY:
        for i in range(content[1]):
            yield from _field(content[0], f'{name}[{i}]')
    elif content[0][0] == Nodetype.BASE:
        yield _base(content[0][1][0], name, many=True)
    else:
        raise LayoutError(f'{name}: sequence of messages')


def _base(kind: str, name: str, *, many: bool) -> Step:
    if kind != 'string' and kind not in _DTYPES:
        raise LayoutError(f'{name}: {kind}')
    return Step((name,), _DTYPES.get(kind, ''), many)


def layout_of(msgtype: str, raw: bytes) -> Layout:
    """Layout of one little-endian message.

    Raises LayoutError for what rosbags' deserialiser would refuse too, and for what cannot be read
    in bulk.
    """
    if raw[:2] != LITTLE_ENDIAN:
        raise LayoutError(raw[:2].hex())
    layout = Layout(fixed=[(0, 2)])
    try:
        for step in steps_of(msgtype):
            _take(step, raw, layout)
    except (struct.error, UnicodeDecodeError) as error:
        raise LayoutError(str(error)) from error
    if not layout.end <= len(raw) <= layout.end + PADDING:
        raise LayoutError(f'{len(raw)} bytes for {layout.end}')
    return layout


def _take(step: Step, raw: bytes, layout: Layout) -> None:
    """Move the layout's end behind one step."""
    count = len(step.names)
    if step.many:
        count = _length(raw, layout)
    if step.dtype:
        if count:
            layout.end = _align(layout.end, step.size)
        layout.places.append((layout.end, count))
        layout.end += step.size * count
        return
    layout.places.append((layout.end, count))
    start, found = layout.end, []
    if count > len(raw):
        raise LayoutError(f'{count} strings')
    for _ in range(count):
        length = _length(raw, layout)
        begin, layout.end = layout.end, layout.end + length
        if length < 1 or layout.end > len(raw) or raw[layout.end - 1]:
            raise LayoutError(f'string of {length} bytes')
        layout.texts.append((begin, layout.end))
        found.append(raw[begin : layout.end - 1].decode())
    if step.many:
        layout.lists[step.names[0]] = found
        layout.fixed.append((start, layout.end))


def _length(raw: bytes, layout: Layout) -> int:
    """Take the length of a string or sequence."""
    start = _align(layout.end, 4)
    (length,) = _LENGTH.unpack_from(raw, start)
    layout.fixed.append((start, start + 4))
    layout.end = start + 4
    return int(length)


def _align(offset: int, size: int) -> int:
    """Next offset aligned to `size`, counted after the encapsulation header."""
    return offset + (4 - offset) % size
