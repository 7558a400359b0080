"""The end of the lockstep line that owns the clock; the others' end is quad_bridge/lockstep.py.

It sends the time, receives the answers of all participants, and decides whether time may go on.
"""

from __future__ import annotations

import contextlib
import json
import select
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from quad_bridge.errors import BadInputError
from quad_bridge.lockstep import START_NS, WINDOW_NS, WIRE

STALLED_S = 10.0  # whoever lets simulated time stand still for so long is named


@dataclass
class _Member:
    """One process on the line."""

    reached_ns: int
    name: str = 'a process'
    published: Mapping[str, int] = field(default_factory=dict)
    rest: bytes = b''

    def take(self, data: bytes) -> None:
        *whole, self.rest = (self.rest + data).split(b'\n')
        if whole:
            message = json.loads(whole[-1])
            self.name, self.published = message['name'], message['published']
            self.reached_ns = max(self.reached_ns, message['reached'])


class Line:
    """See the module. Not thread-safe."""

    def __init__(self, path: Path, say: Callable[[str], object] = lambda _: None) -> None:
        """Listen at `path`; `say` takes lines about who lets time stand still."""
        self._path, self._say = path, say
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            path.unlink(missing_ok=True)
            self._listener.bind(str(path))
        except OSError as error:
            self._listener.close()
            what = f'cannot listen there ({error.strerror or error})'
            raise BadInputError(f'--lockstep {path}', what) from error
        self._listener.listen()
        self._members: dict[socket.socket, _Member] = {}
        self.published: dict[str, int] = {}  # how far the streams of this process itself are
        self._now_ns = START_NS
        self._since_s = time.monotonic()

    @property
    def names(self) -> list[str]:
        """Who takes part."""
        return [member.name for member in self._members.values()]

    @property
    def slowest_ns(self) -> int:
        """The time that all have reached."""
        return min((m.reached_ns for m in self._members.values()), default=0)

    @property
    def ready(self) -> bool:
        """Whether time may go on: somebody takes part, and nobody is too far behind."""
        return self.slowest_ns >= self._now_ns - WINDOW_NS

    def tell(self, now_ns: int) -> None:
        """Send the time, before anything of that time is sent to others."""
        if now_ns > self._now_ns:
            self._now_ns, self._since_s = now_ns, time.monotonic()
        published = {WIRE: now_ns, **self.published}
        for member in self._members.values():
            published |= member.published
        text = json.dumps({'now': now_ns, 'published': published}) + '\n'
        for line in list(self._members):
            with contextlib.suppress(OSError):  # it has gone, which `attend` will notice
                line.sendall(text.encode())

    def attend(self, wait_s: float) -> None:
        """Take answers, and who comes and goes; wait for `wait_s` at most."""
        ready, _, _ = select.select([self._listener, *self._members], [], [], wait_s)
        for line in ready:
            if line is self._listener:
                self._members[self._listener.accept()[0]] = _Member(self._now_ns)
            else:
                self._hear(line)
        stands_s = time.monotonic() - self._since_s
        if stands_s > STALLED_S and not self.ready:
            self._since_s = time.monotonic()
            slow = [m.name for m in self._members.values() if m.reached_ns == self.slowest_ns]
            self._say(f'simulated time waits for {", ".join(slow) or "the first node"}\n')

    def _hear(self, line: socket.socket) -> None:
        try:
            data = line.recv(65536)
        except OSError:
            data = b''
        if data:
            self._members[line].take(data)
        else:
            self._drop(line)

    def _drop(self, line: socket.socket) -> None:
        del self._members[line]
        line.close()
        self.tell(self._now_ns)  # nobody waits for its messages any more

    def close(self) -> None:
        """Hang up."""
        for line in [*self._members, self._listener]:
            line.close()
        with contextlib.suppress(OSError):
            self._path.unlink()
