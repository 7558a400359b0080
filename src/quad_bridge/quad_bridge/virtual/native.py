"""The firmware in C on this machine: where it is, and the same in memory.

Nothing here knows its settings (firmware.py) or what it says (hil.py and the wire).
"""

from __future__ import annotations

import ctypes
import functools
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from quad_bridge.gains.table import ROWS
from quad_bridge.virtual.errors import ConfigurationError

VARIABLE = 'QUAD_FIRMWARE'
"""The environment variable that names the folder of a build of one's own, which comes first."""
PROGRAM, LIBRARY = 'quad_firmware', 'libquad_firmware.so'
MOTORS_BYTES, MAX_ANSWER = 42, 2048  # size of a motor frame, of the frames to send


def _folders() -> Iterator[Path]:
    if VARIABLE in os.environ:
        yield Path(os.environ[VARIABLE])
    for prefix in filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)):
        yield Path(prefix) / 'lib' / PROGRAM
        yield Path(prefix).parent / PROGRAM / 'lib' / PROGRAM  # as colcon lays it
    yield Path(__file__).resolve().parents[4] / 'firmware' / 'build'


def built_file(name: str) -> Path:
    """The built file of this name; raises ConfigurationError where there is none."""
    folders = list(dict.fromkeys(_folders()))
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise ConfigurationError(
        name, f'not in {", ".join(map(str, folders))}',
        remedy='make qemu' if name.endswith('.elf') else 'make build (needs a C compiler)',
    )


@functools.cache
def library() -> ctypes.CDLL:
    """The firmware's library; its symbols are there for compiled code as well."""
    loaded = ctypes.CDLL(str(built_file(LIBRARY)), mode=ctypes.RTLD_GLOBAL)
    loaded.quad_library_size.restype = ctypes.c_size_t
    loaded.quad_library_send.restype = ctypes.c_size_t
    return loaded


class NativeFirmware:
    """One firmware in memory, booted by a frame of hil.py."""

    def __init__(self, boot: bytes, key: bytes | None = None, signing_time: int = 0) -> None:
        """`key` and `signing_time` as in quad_endpoint.h; ValueError for a frame it refuses."""
        self._library = library()
        self.memory: npt.NDArray[np.uint8] = np.zeros(self._library.quad_library_size(), np.uint8)
        self.boot(boot, key, signing_time)

    def boot(self, frame: bytes, key: bytes | None = None, signing_time: int = 0) -> None:
        """Begin anew with these settings."""
        time = ctypes.c_uint64(signing_time)
        count = ctypes.c_size_t(len(frame))
        if not self._library.quad_library_boot(self._state, frame, count, key, time):
            raise ValueError('the firmware refuses its settings')

    def receive(self, data: bytes, now_us: int) -> bytes:
        """Take the bridge's bytes; the bytes of what answers them."""
        count, now = ctypes.c_size_t(len(data)), ctypes.c_uint64(now_us)
        self._library.quad_library_receive(self._state, data, count, now)
        return self.send()

    def cycle(self, sensors: bytes) -> bytes:
        """Run a cycle with these sensors; the frame with its motors."""
        motors = ctypes.create_string_buffer(MOTORS_BYTES)
        count = ctypes.c_size_t(len(sensors))
        if not self._library.quad_library_cycle(self._state, sensors, count, motors):
            raise ValueError('the firmware refuses these sensors')
        return motors.raw

    def send(self) -> bytes:
        """The bytes that wait for the bridge."""
        buffer = ctypes.create_string_buffer(MAX_ANSWER)
        count = self._library.quad_library_send(self._state, buffer, ctypes.c_size_t(len(buffer)))
        return buffer.raw[:count]

    def gains(self) -> npt.NDArray[np.float32]:
        """(n,) parameters in force, in the order of their index."""
        values = np.zeros(len(ROWS), np.float32)
        self._library.quad_library_gains(self._state, ctypes.c_void_p(values.ctypes.data))
        return values

    def counts(self) -> tuple[int, ...]:
        """Frames used, bad, unsigned, forged, replayed, dropped."""
        values = (ctypes.c_uint32 * 6)()
        self._library.quad_library_counts(self._state, values)
        return tuple(values)

    def arm(self, armed: bool, *, may_arm: bool = True) -> None:
        """Arm as by the pilot's switch; `may_arm`: by command of the bridge as well."""
        self._library.quad_library_arm(self._state, int(armed), int(may_arm))

    @property
    def _state(self) -> ctypes.c_void_p:
        return ctypes.c_void_p(self.memory.ctypes.data)
