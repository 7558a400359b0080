"""MAVLink over UDP as a port: `udp://`, `udpin://`, `udpout://`. No frames here.

`udpin://HOST:PORT` listens, and answers all who have spoken lately; `udpout://HOST:PORT` speaks to
that address. `udp://HOST:PORT` listens where the address is this computer's and free, else it
speaks to it: PX4's simulator sends to port 14540, others wait there. No host means any address.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import time

SCHEMES = ('udp', 'udpin', 'udpout')
PEER_TIMEOUT_S = 10.0  # whoever has been silent for longer gets no answers
MAX_PEERS = 8  # that are answered at once: those who spoke last, so that no flood keeps one out
LARGEST = 65536  # bytes of a datagram; ports are below it too
BUFFER = 1 << 20  # bytes that wait in the kernel while the bridge gets no time
NOT_OURS = (errno.EADDRINUSE, errno.EADDRNOTAVAIL)


class UdpPort:
    """Datagrams as a stream of bytes; raises OSError and ValueError as a port does."""

    def __init__(self, url: str) -> None:
        scheme, host, port = parts(url)
        self.refused = False
        """Whether nobody listens at the address that is spoken to."""
        self._peers: dict[tuple[str, int], float] = {}
        family, kind, _, _, address = socket.getaddrinfo(
            host or '0.0.0.0', port, type=socket.SOCK_DGRAM  # noqa: S104
        )[0]
        self._socket = socket.socket(family, kind)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
        try:
            self.listens = scheme != 'udpout' and self._bound(address, scheme)
            if not self.listens:
                self._socket.connect(address)
        except OSError:
            self._socket.close()
            raise
        self.url = f'{"udpin" if self.listens else "udpout"}://{host}:{port}'

    def fileno(self) -> int:
        """Descriptor of the socket, for `select`."""
        return self._socket.fileno()

    def read(self, _size: int) -> bytes:
        """All datagrams that wait."""
        data = bytearray()
        with contextlib.suppress(BlockingIOError):
            while len(data) < LARGEST:
                try:
                    datagram, sender = self._socket.recvfrom(LARGEST)
                except ConnectionRefusedError:
                    self.refused = True
                    break
                data += datagram
                if datagram:
                    self.refused = False
                    self._peers[sender] = time.monotonic()
        return bytes(data)

    def write(self, data: bytes) -> int:
        """Send one datagram to each peer; 0 where the output is full."""
        try:
            if not self.listens:
                return self._sent(data)
            since_s = time.monotonic() - PEER_TIMEOUT_S
            last = sorted([*self._peers.items()], key=lambda peer: peer[1])[-MAX_PEERS:]
            self._peers = {peer: last_s for peer, last_s in last if last_s > since_s}
            return max((self._to(peer, data) for peer in [*self._peers]), default=len(data))
        except BlockingIOError:
            return 0

    def _to(self, peer: tuple[str, int], data: bytes) -> int:
        """Send to one peer; one that cannot be reached is left out until it is heard again."""
        try:
            return self._socket.sendto(data, peer)
        except BlockingIOError:
            raise
        except OSError:
            self._peers.pop(peer, None)
            return len(data)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _sent(self, data: bytes) -> int:
        """Send to the one address, again where this reports the refusal of an earlier one."""
        try:
            return self._socket.send(data)
        except ConnectionRefusedError:
            self.refused = True
        with contextlib.suppress(ConnectionRefusedError):
            return self._socket.send(data)
        return len(data)

    def _bound(self, address: tuple[object, ...], scheme: str) -> bool:
        try:
            self._socket.bind(address)
        except OSError as error:
            if scheme == 'udp' and error.errno in NOT_OURS:
                return False
            raise
        return True


def is_udp(url: str) -> bool:
    """Whether a port is one of these."""
    scheme, separator, _ = url.partition('://')
    return bool(separator) and scheme.lower() in SCHEMES


def parts(url: str) -> tuple[str, str, int]:
    """Scheme, host (empty: any address) and port; raises ValueError where the URL has no port."""
    scheme, _, rest = url.partition('://')
    host, separator, port = rest.partition('/')[0].rpartition(':')
    if not separator or not port.isdecimal() or not 0 < int(port) < LARGEST:
        raise ValueError(f'{url}: a UDP port is written udp://HOST:PORT')
    if not host and scheme.lower() == 'udpout':
        raise ValueError(f'{url}: must name the host that is spoken to')
    return scheme.lower(), host.strip('[]'), int(port)
