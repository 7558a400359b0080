"""A log of the Crazyflie's SD-card deck → columns with their times.

Source of the format: crazyflie-firmware, usddeck, versions 1 and 2.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from quad_sysid.contract import FloatArray
from quad_sysid.errors import BadInputError

SD_MAGIC = 0xBC
SD_REGULAR = 'fixedFrequency'
"""Event of a Crazyflie's log with variables sampled at a fixed rate."""
SD_TYPES = frozenset('BbHhIiQqefd?')

Columns = dict[str, FloatArray]


def sd_card(data: bytes, source: str) -> tuple[Columns, Columns]:
    """The columns of a log, and the times of each, s.

    Raises BadInputError for a damaged file or another version. A wrong checksum is accepted, since
    a log that was cut off has one.
    """
    version = int.from_bytes(data[1:3], 'little')
    if version not in (1, 2):
        raise BadInputError(source, 'is an SD-card log of an unknown version', version,
                            "convert it to CSV with the Crazyflie's own tool and import that")
    try:
        events, position = _sd_events(data, source)
    except (struct.error, IndexError, ValueError, UnicodeDecodeError) as error:
        raise BadInputError(source, 'is not a whole log of a Crazyflie SD card',
                            remedy='copy it again from the card') from error
    stamp = struct.Struct('<HI' if version == 1 else '<HQ')
    tick = 1e-3 if version == 1 else 1e-6
    rows: dict[int, list[tuple[Any, ...]]] = {number: [] for number in events}
    while position + stamp.size <= len(data) - 4:
        number, ticks = stamp.unpack_from(data, position)
        position += stamp.size
        if number not in events or position + events[number][1].size > len(data):
            break
        rows[number].append((ticks * tick, *events[number][1].unpack_from(data, position)))
        position += events[number][1].size
    columns: Columns = {}
    times: Columns = {}
    for number, (names, _) in events.items():
        if len(rows[number]) > 1:
            values = np.array(rows[number], dtype=float)
            columns |= {name: values[:, i].copy() for i, name in enumerate(names, 1)}
            times |= dict.fromkeys(names, values[:, 0].copy())
    if not columns:
        raise BadInputError(source, 'holds no samples',
                            remedy='check that it was copied whole, else record again')
    return columns, times


def _sd_events(data: bytes, source: str) -> tuple[dict[int, tuple[list[str], struct.Struct]], int]:
    """Names and binary layout of each event by its number, and the offset of the samples."""
    (kinds,) = struct.unpack_from('<H', data, 3)
    position = 5
    events: dict[int, tuple[list[str], struct.Struct]] = {}
    for _ in range(kinds):
        (number,) = struct.unpack_from('<H', data, position)
        event, position = _text(data, position + 2)
        (count,) = struct.unpack_from('<H', data, position)
        position += 2
        names, form = [], '<'
        for _ in range(count):
            name, position = _text(data, position)
            names.append(name[:-3] if event == SD_REGULAR else f'{event}.{name[:-3]}')
            form += name[-2]
        if not set(form[1:]) <= SD_TYPES:
            raise BadInputError(source, 'contains an unknown data type', form)
        events[number] = (names, struct.Struct(form))
    return events, position


def _text(data: bytes, position: int) -> tuple[str, int]:
    end = data.index(b'\0', position)
    return data[position:end].decode(), end + 1
