"""The one place that opens a serial port: a reader thread that survives whatever the port does.

Bytes go to a callback, in the reader's thread; what they mean is not known here. All faults of
pyserial and the terminal layer are caught in this file and become a `PortState`.
"""

from __future__ import annotations

import errno
import termios
import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import serial

REOPEN_S = 0.5
READ_TIMEOUT_S = 0.2
WRITE_TIMEOUT_S = 0.05
SOCKET_READ = 4096
"""Bytes taken from a socket at once."""
FAULTS = (serial.SerialException, OSError, termios.error, TypeError, ValueError)
"""SerialException from read and write, OSError from in_waiting, termios.error from configuring,
TypeError and ValueError when another thread has closed the port."""


class PortState(Enum):
    """What is the matter with the port; the value is the text for people."""

    CLOSED = 'closed'
    OPEN = 'open'
    NOT_THERE = 'not there: plug it in, or set the parameter port'
    BUSY = 'busy: another program has it open'
    DENIED = 'not permitted: add the user to the group dialout and log in again'
    UNUSABLE = 'cannot be used as a serial port'
    HUNG_UP = 'hung up: waiting for it to come back'


_BY_ERRNO = {
    errno.ENOENT: PortState.NOT_THERE,
    errno.ENXIO: PortState.NOT_THERE,
    errno.ENODEV: PortState.NOT_THERE,
    errno.EBUSY: PortState.BUSY,
    errno.EAGAIN: PortState.BUSY,
    errno.EACCES: PortState.DENIED,
    errno.EPERM: PortState.DENIED,
}


@dataclass(frozen=True)
class PortStatus:
    """A snapshot for diagnostics."""

    state: PortState
    detail: str
    """The system's own words for the last fault; empty while all is well."""
    opened: int
    """Times the port has been opened."""
    dropped_writes: int
    """Writes that found the output full or the port shut."""


class SerialPort:
    """Keeps a port open and reads it; reopens it every `REOPEN_S` after any fault."""

    def __init__(
        self,
        path: str,
        baud: int,
        on_bytes: Callable[[bytes], None],
        on_open: Callable[[], None] = lambda: None,
        *,
        reopen_s: float = REOPEN_S,
    ) -> None:
        """`path` is a device or a URL of pyserial; both callbacks run in the reader's thread."""
        self._path = path
        self._baud = baud
        self._on_bytes = on_bytes
        self._on_open = on_open
        self._reopen_s = reopen_s
        self._port: Any = None
        self._stop = threading.Event()
        self._write_lock = threading.Lock()
        self._state = PortState.CLOSED
        self._detail = ''
        self._opened = 0
        self._dropped = 0
        self._thread = threading.Thread(target=self._run, name='serial reader', daemon=True)

    @property
    def status(self) -> PortStatus:
        """State, last fault and counts."""
        return PortStatus(self._state, self._detail, self._opened, self._dropped)

    def start(self) -> None:
        """Start the reader's thread; the port need not be there yet."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the port; safe to call twice."""
        self._stop.set()
        port = self._port
        if port is not None:
            try:
                port.cancel_read()
            except (*FAULTS, AttributeError):
                pass
        if self._thread.is_alive():
            self._thread.join(timeout=2.0)

    def write(self, data: bytes) -> bool:
        """Send `data`; False (and counted) where the port is shut or its output full."""
        with self._write_lock:
            port = self._port
            try:
                if port is not None:
                    port.write(data)
                    return True
            except FAULTS as error:
                self._detail = _one_line(error)
            self._dropped += 1
            return False

    def _run(self) -> None:
        while not self._stop.is_set():
            if self._open():
                self._read_until_fault()
                self._close()
            self._stop.wait(self._reopen_s)
        self._state = PortState.CLOSED

    def _open(self) -> bool:
        try:
            self._port = serial.serial_for_url(
                self._path,
                baudrate=self._baud,
                timeout=READ_TIMEOUT_S,
                write_timeout=WRITE_TIMEOUT_S,
                exclusive=True,
            )
        except FAULTS as error:
            number = getattr(error, 'errno', None)
            known = _BY_ERRNO.get(number) if isinstance(number, int) else None
            self._state = known or PortState.UNUSABLE
            self._detail = _one_line(error)
            return False
        self._opened += 1
        self._detail = ''
        self._state = PortState.OPEN
        self._on_open()
        return True

    def _read_until_fault(self) -> None:
        port = self._port
        while not self._stop.is_set():
            try:
                data = self._read(port)
            except FAULTS as error:
                self._state = PortState.HUNG_UP
                self._detail = _one_line(error)
                return
            if data:
                self._on_bytes(data)

    def _read(self, port: Any) -> bytes:
        data = bytes(port.read(port.in_waiting or 1))
        if data and '://' in self._path:
            # a socket of pyserial tells that something waits, not how much
            port.timeout = 0
            data += port.read(SOCKET_READ)
            port.timeout = READ_TIMEOUT_S
        return data

    def _close(self) -> None:
        with self._write_lock:
            port, self._port = self._port, None
            try:
                port.close()
            except FAULTS as error:
                self._detail = _one_line(error)


def _one_line(error: BaseException) -> str:
    return ' '.join(str(error).split())
