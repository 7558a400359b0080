"""The pseudo-terminal that the virtual STM32 sits behind: a UART that never blocks its sender.

What nobody reads is dropped and counted, as on a UART. Knows nothing of frames.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import termios
import time
import tty
from pathlib import Path

from quad_bridge.virtual.errors import ConfigurationError

GIVE_UP_S = 1.0
"""A reader that took nothing for so long is taken as absent; what it left is thrown away."""


class PseudoTerminal:
    """Master side of a raw pty; `path` is what the bridge opens."""

    def __init__(self, link: Path | None = None) -> None:
        self._master, self._slave = pty.openpty()
        # the slave stays open here, or its raw mode would be lost with the last reader
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self.dropped_bytes = 0
        self._rest = b''
        self._blocked_since: float | None = None
        self._link = link
        if link is not None:
            self._make_link(link)

    @property
    def number(self) -> int:
        """The file descriptor that becomes readable when something has arrived."""
        return self._master

    def _make_link(self, link: Path) -> None:
        if link.exists() and not link.is_symlink():
            raise ConfigurationError(f'--link {link}', 'exists and is not a symbolic link')
        fresh = link.with_name(f'.{link.name}.{os.getpid()}')
        try:
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(self.path)
            fresh.replace(link)
        except OSError as error:
            raise ConfigurationError(
                f'--link {link}', f'cannot be made ({error.strerror})'
            ) from error

    def write(self, data: bytes) -> None:
        """Send what fits; the whole of `data` is dropped while older bytes are stuck."""
        if self._rest:
            self._rest = self._rest[self._push(self._rest) :]
        if self._rest:
            self.dropped_bytes += len(data)
            return
        self._rest = data[self._push(data) :]

    def _push(self, data: bytes) -> int:
        try:
            sent = os.write(self._master, data)
        except BlockingIOError:
            sent = 0
        now = time.monotonic()
        if sent:
            self._blocked_since = None
        elif self._blocked_since is None:
            self._blocked_since = now
        elif now - self._blocked_since > GIVE_UP_S:
            termios.tcflush(self._slave, termios.TCIFLUSH)
            self._blocked_since = None
        return sent

    def read(self, wait_s: float) -> bytes:
        """What arrived within `wait_s`, b'' if nothing did."""
        ready, _, _ = select.select([self._master], [], [], max(0.0, wait_s))
        if not ready:
            return b''
        try:
            return os.read(self._master, 65536)
        except OSError:
            return b''

    def close(self) -> None:
        """Hang up, and take the link away if it is still ours."""
        if self._link is not None:
            with contextlib.suppress(OSError):
                if str(self._link.readlink()) == self.path:
                    self._link.unlink()
        os.close(self._master)
        os.close(self._slave)
