"""The one place that opens a serial port, with a reader thread that survives all its faults.

Bytes go to a callback, in the reader's thread; what they mean is not known here. All faults of
pyserial and the terminal layer are caught in this file and become a `PortState`. A port that falls
silent is looked at: its name may lead to another device by now, or the peer may be gone.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import ipaddress
import os
import select
import termios
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

import serial

from quad_bridge.link.udp import UdpPort, is_udp, parts
from quad_bridge.lockstep import clock

REOPEN_S = 0.25
SILENT_S = 0.2
"""After so long without a byte it is looked whether the name still leads to the same device."""
HALF_OPEN_S = (5.0, 60.0)
"""Silent for so long, the port is opened anew; each time after twice as long, up to the second."""
STOP_S, OPENING_S = 2.0, 0.5
"""How long the thread's end is waited for, with the port open and while it is being opened."""
CHUNK = 65536
NETWORK = ('socket://', 'rfc2217://', 'udp://', 'udpin://', 'udpout://')
WIRED = ('loop', 'spy', 'hwgrep', 'alt', 'cp2110')
"""Schemes of pyserial's URLs that lead to no network."""
FAULTS = (serial.SerialException, OSError, termios.error, TypeError, ValueError)
"""SerialException from read and write, OSError from in_waiting, termios.error from configuring,
TypeError and ValueError when another thread has closed the port."""


class PortState(Enum):
    """State of the port; the value is the text for the user."""

    CLOSED = 'closed'
    OPEN = 'open'
    NOT_THERE = 'not there: plug it in, or name another'
    BUSY = 'busy: another program has it open'
    DENIED = 'not permitted: add the user to the group dialout and log in again'
    UNUSABLE = 'cannot be used as a serial port'
    UNREACHABLE = 'not reachable: does the aircraft listen there?'
    HUNG_UP = 'hung up: waiting for it to come back'


_BY_ERRNO = {
    errno.ENOENT: PortState.NOT_THERE,
    errno.ENXIO: PortState.NOT_THERE,
    errno.ENODEV: PortState.NOT_THERE,
    errno.EBUSY: PortState.BUSY,
    errno.EADDRINUSE: PortState.BUSY,
    errno.EAGAIN: PortState.BUSY,
    errno.EACCES: PortState.DENIED,
    errno.EPERM: PortState.DENIED,
}


@dataclass(frozen=True)
class PortStatus:
    """A snapshot for diagnostics."""

    state: PortState = PortState.CLOSED
    detail: str = ''  # the system's own words for the last fault; empty while all is well
    opened: int = 0  # times the port has been opened
    dropped_writes: int = 0  # writes that found the output of the open port full
    path: str = ''  # the device that is open, or was last: what a link or pattern has led to
    latency_ms: int | None = None  # an FTDI adapter's latency timer; None where there is none

    @property
    def refused(self) -> str:
        """Why the port has not opened yet and cannot without the user's help; else empty."""
        helpless = self.state in {PortState.NOT_THERE, PortState.BUSY, PortState.DENIED,
                                  PortState.UNUSABLE}  # fmt: skip
        return f'port {self.state.value}' if helpless and not self.opened else ''


class SerialPort:
    """Keeps a port open and reads it; reopens it every `REOPEN_S` after any fault."""

    def __init__(
        self,
        path: str,
        baud: int,
        on_bytes: Callable[[bytes], None],
        on_open: Callable[[], None] = lambda: None,
        on_silence: Callable[[], None] = lambda: None,
    ) -> None:
        """`path` is a device, a pattern (`/dev/ttyACM*`), a URL of pyserial or of udp.py.

        If several devices match, the first that opens is used, and the next one where that
        stays silent. `on_silence` is called where nothing has come for `SILENT_S`, and when the
        port is shut. The callbacks run in the reader's thread.
        """
        self._path = path
        self._baud = baud
        self._on_bytes = on_bytes
        self._on_open, self._on_silence = on_open, on_silence
        self._port: Any = None
        self._stop = threading.Event()
        self._write_lock, self._status_lock = threading.Lock(), threading.Lock()
        self._tail = b''  # rest of the last write: no frame is torn
        self.status = PortStatus()
        self._timeout_s = HALF_OPEN_S[0]
        self._skip = 0
        self._thread = threading.Thread(target=self._run, name='serial reader', daemon=True)

    def start(self) -> None:
        """Start the reader's thread; the port need not be there yet."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the port; safe to call twice.

        A network's peer that is still being looked for is not waited for: the thread ends then.
        """
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=STOP_S if self._port is not None else OPENING_S)

    def write(self, data: bytes) -> bool:
        """Send whole frames without waiting; False where the port is shut, or full (counted).

        What the output takes only in part is completed before anything else goes out.
        """
        with self._write_lock:
            if self._port is None:
                return False
            try:
                if self._tail:
                    self._tail = self._tail[_write(self._port, self._tail) :]
                count = 0 if self._tail else _write(self._port, data)
            except FAULTS as error:
                count, self._tail = 0, b''
                self._note(detail=_one_line(error))
            if count:
                self._tail = data[count:]
                return True
            self._note(dropped_writes=self.status.dropped_writes + 1)
            return False

    def _note(self, **changed: Any) -> None:
        with self._status_lock:
            self.status = replace(self.status, **changed)

    def _run(self) -> None:
        while not self._stop.is_set():
            if self._open():
                self._read_until_fault()
                self._close()
                self._on_silence()
            self._stop.wait(REOPEN_S)
        self._note(state=PortState.CLOSED)

    def _open(self) -> bool:
        devices = candidates(self._path)
        for k in range(len(devices)):
            device = devices[(k + self._skip) % len(devices)]
            try:
                if is_udp(device):
                    port: Any = UdpPort(device)
                    device = port.url  # which says whether it listens
                else:
                    port = serial.serial_for_url(
                        device, baudrate=self._baud, timeout=0, write_timeout=0, exclusive=True
                    )
            except FAULTS as error:
                number = getattr(error, 'errno', None)
                remedy = _BY_ERRNO.get(number) if isinstance(number, int) else None
                network = device.lower().startswith(NETWORK)
                otherwise = PortState.UNREACHABLE if network else PortState.UNUSABLE
                self._note(state=remedy or otherwise, detail=_one_line(error))
                continue
            self._note(detail='', opened=self.status.opened + 1, path=device,
                       latency_ms=latency_timer(device))  # fmt: skip
            if not self._stop.is_set():  # while a network's peer was waited for
                self._on_open()
            self._port = port  # what was meant for the device before is not written to this one
            self._note(state=PortState.OPEN)
            return True
        if not devices:
            self._note(state=PortState.NOT_THERE, detail=f'nothing matches {self._path}')
        return False

    def _read_until_fault(self) -> None:
        port, received_s = self._port, clock().now_s()
        file_id = identity(self.status.path)
        while not self._stop.is_set():
            try:
                data = _read(port)
            except FAULTS as error:
                self._note(state=PortState.HUNG_UP, detail=_one_line(error))
                return
            refused = isinstance(port, UdpPort) and port.refused
            if refused != (self.status.state is PortState.UNREACHABLE):
                self._note(state=PortState.UNREACHABLE if refused else PortState.OPEN)
            if data:
                received_s = clock().now_s()
                self._timeout_s = HALF_OPEN_S[0]
                self._on_bytes(data)
                continue
            self._on_silence()
            if identity(self.status.path) != file_id:
                reason = 'its name leads to another device now, or to none'
                self._note(state=PortState.HUNG_UP, detail=reason)
                return
            if clock().now_s() - received_s > self._timeout_s:
                # half-open: a peer that went without a word, or the wrong one of several
                self._timeout_s = min(2.0 * self._timeout_s, HALF_OPEN_S[1])
                self._skip += 1
                return

    def _close(self) -> None:
        with self._write_lock:  # nobody writes behind it; closing a socket takes its time
            port, self._port, self._tail = self._port, None, b''
        try:
            port.close()
        except FAULTS as error:
            self._note(detail=_one_line(error))


def candidates(path: str) -> list[str]:
    """Devices that `path` may name now: a URL or name as it is, a pattern's matches sorted."""
    if '://' in path or not glob.has_magic(path):
        return [path]
    return sorted(glob.glob(path))  # noqa: PTH207  (Path.glob takes no absolute pattern)


def identity(device: str) -> tuple[int, int] | None:
    """Which device a name leads to: another one when it is plugged anew, None without one."""
    if '://' in device:
        return (0, 0)
    try:
        state = Path(device).stat()
    except OSError:
        return None
    return (state.st_rdev, state.st_ino)


def latency_timer(device: str) -> int | None:
    """The latency timer of an FTDI adapter in ms, None for anything else."""
    name = os.path.realpath(device).rpartition('/')[2]
    with contextlib.suppress(OSError, ValueError):
        text = Path(f'/sys/class/tty/{name}/device/latency_timer').read_text(encoding='ascii')
        return int(text)
    return None


def over_network(port: str) -> bool:
    """Whether others than this computer, and whoever holds its wires, can speak on `port`."""
    scheme, separator, rest = port.partition('://')
    if not separator or scheme.lower() in WIRED:
        return False
    if is_udp(port):
        try:
            host = parts(port)[1]
        except ValueError:
            return True
    else:
        host = rest.partition('/')[0].rpartition(':')[0].rpartition('@')[2].strip('[]')
    if host.lower() == 'localhost':
        return False
    try:
        return not ipaddress.ip_address(host).is_loopback
    except ValueError:
        return True


def _read(port: Any) -> bytes:
    """Bytes that have arrived, after a short wait; b'' if none."""
    try:
        number = port.fileno()
    except (AttributeError, OSError):  # `loop://` and its like
        time.sleep(0.002)
        return bytes(port.read(CHUNK))
    if not select.select([number], [], [], SILENT_S)[0]:
        return b''
    if isinstance(port, UdpPort):
        return port.read(CHUNK)
    try:  # pyserial's own read would ask the kernel once more
        data = os.read(number, CHUNK)
    except BlockingIOError:
        return b''
    if not data:
        raise OSError('it has hung up: ready to be read, and nothing there')
    return data


def _write(port: Any, data: bytes) -> int:
    """How many bytes the output takes now, without waiting.

    pyserial's own write tries for ever where the output is full, a core at its limit.
    """
    if isinstance(port, UdpPort):
        return port.write(data)
    try:
        number = port.fileno()
    except (AttributeError, OSError):
        # `rfc2217://` sends all or waits: ask before; `loop://` has no socket and takes all
        line = getattr(port, '_socket', None)
        if line is not None and not select.select([], [line], [], 0.0)[1]:
            return 0
        return int(port.write(data))
    try:
        return os.write(number, data)
    except BlockingIOError:
        return 0


def _one_line(error: BaseException) -> str:
    return ' '.join(str(error).split())
