"""Logs as PX4 (.ulg) and ArduPilot (.bin) write them, and text tables, of columns."""

import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation


def quaternions(angles: np.ndarray) -> np.ndarray:
    """(n, 4) w x y z of roll, pitch, yaw (n, 3)."""
    return np.roll(Rotation.from_euler('ZYX', angles[:, ::-1]).as_quat(), 1, axis=1)


def text_table(path: Path, columns: dict, delimiter: str = ',', above: str = '') -> Path:
    """The columns below their names, exact to the last digit; `.gz` packs them."""
    np.savetxt(path, np.column_stack([*columns.values()]), '%.17g', delimiter, comments='',
               header=above + delimiter.join(columns))
    return path


def ulog(path: Path, topics: dict, parameters: dict, drop=(), later=()) -> Path:
    """Topics {name: {field: values}}, floats or arrays of them, all but the first, timestamp.

    later: parameters (row of the first topic, name, value) that are set in flight.
    """
    out = [b'ULog\x01\x12\x35\x01' + struct.pack('<Q', 1)]

    def add(kind: bytes, body: bytes) -> None:
        out.append(struct.pack('<Hc', len(body), kind) + body)

    for name, columns in topics.items():
        fields = ''.join(
            f'float{f"[{v.shape[1]}]" if v.ndim > 1 else ""} {f};'
            for f, v in columns.items() if f != 'timestamp'
        )
        add(b'F', f'{name}:uint64_t timestamp;{fields}'.encode())
    def write(name: str, value: float) -> None:
        key = f'{"int32_t" if isinstance(value, int) else "float"} {name}'.encode()
        form = '<i' if isinstance(value, int) else '<f'
        add(b'P', bytes([len(key)]) + key + struct.pack(form, value))

    for name, value in parameters.items():
        write(name, value)
    for i, name in enumerate(topics):
        add(b'A', struct.pack('<BH', 0, i) + name.encode())
    for i, columns in enumerate(topics.values()):
        stamps = columns['timestamp']
        values = np.column_stack([v for f, v in columns.items() if f != 'timestamp'])
        for k, stamp in enumerate(stamps):
            if k not in drop:
                body = struct.pack('<HQ', i, int(stamp)) + values[k].astype('<f4').tobytes()
                add(b'D', body)
            for _, name, value in (one for one in later if (i, k) == (0, one[0])):
                write(name, value)
    path.write_bytes(b''.join(out))
    return path


def dataflash(path: Path, messages: dict, parameters: dict, later=()) -> Path:
    """Messages {name: (labels, rows)}; the first label is TimeUS.

    later: parameters (time in us, name, value) that are set in flight.
    """
    out = []

    def fmt(number, name, form, labels, length):
        out.append(struct.pack('<3BBB4s16s64s', 0xA3, 0x95, 128, number, length, name.encode(),
                               form.encode(), ','.join(labels).encode()))

    fmt(128, 'FMT', 'BBnNZ', ('Type', 'Length', 'Name', 'Format', 'Columns'), 89)
    fmt(129, 'PARM', 'QNf', ('TimeUS', 'Name', 'Value'), 3 + 8 + 16 + 4)
    for stamp, name, value in (*((1, *item) for item in parameters.items()), *later):
        out.append(struct.pack('<3BQ16sf', 0xA3, 0x95, 129, stamp, name.encode(), value))
    for number, (name, (labels, rows)) in enumerate(messages.items(), 130):
        fmt(number, name, 'Q' + 'f' * (len(labels) - 1), labels, 11 + 4 * (len(labels) - 1))
        form = f'<3BQ{len(labels) - 1}f'
        out += [struct.pack(form, 0xA3, 0x95, number, int(row[0]), *row[1:]) for row in rows]
    path.write_bytes(b''.join(out))
    return path
