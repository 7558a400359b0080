"""Networks as a transport: who listens, who is answered, and which ports need a key."""

import socket

import pytest
from node_process import until
from probe import PATIENCE_S

from quad_bridge.link.port import SerialPort, over_network
from quad_bridge.link.udp import UdpPort


@pytest.fixture
def peer():
    """Somebody else's socket, bound to an address of its own."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(('127.0.0.1', 0))
        made.settimeout(PATIENCE_S)
        yield made


@pytest.fixture
def free():
    """A port of this computer at which nobody listens."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(('127.0.0.1', 0))
        return made.getsockname()[1]


@pytest.fixture
def opened():
    ports = []

    def make(url):
        heard = bytearray()
        ports.append(SerialPort(url, 921600, heard.extend, reopen_s=0.02))
        ports[-1].start()
        until(lambda: ports[-1].status.opened > 0)
        return ports[-1], heard

    yield make
    for port in ports:
        port.stop()


@pytest.mark.parametrize('scheme', ['udp', 'udpin'])
def test_who_sends_to_a_free_port_of_ours_is_heard_and_answered(scheme, free, peer, opened):
    """PX4's simulator sends to 14540, and listens where it sends from."""
    port, heard = opened(f'{scheme}://127.0.0.1:{free}')
    assert port.status.path == f'udpin://127.0.0.1:{free}'
    assert port.write(b'to nobody yet')
    assert port.status.dropped_writes == 0
    peer.sendto(b'one', ('127.0.0.1', free))
    peer.sendto(b' two', ('127.0.0.1', free))
    until(lambda: heard == b'one two')
    gone = {('127.0.0.1', 0): float('inf')}  # another one, whose network is not there any more
    port._port._peers = gone | port._port._peers
    assert port.write(b'answer')
    assert peer.recv(100) == b'answer'


@pytest.mark.parametrize('scheme', ['udp', 'udpout'])
def test_who_listens_already_is_spoken_to(scheme, peer, opened):
    number = peer.getsockname()[1]
    port, heard = opened(f'{scheme}://127.0.0.1:{number}')
    assert port.status.path == f'udpout://127.0.0.1:{number}'
    assert port.write(b'hello')
    data, ours = peer.recvfrom(100)
    assert data == b'hello'
    peer.sendto(b'here', ours)
    until(lambda: heard == b'here')


def test_a_server_of_tcp_is_spoken_to(opened):
    with socket.create_server(('127.0.0.1', 0)) as server:
        port, heard = opened(f'socket://127.0.0.1:{server.getsockname()[1]}')
        with server.accept()[0] as theirs:
            assert port.write(b'hello')
            assert theirs.recv(100) == b'hello'
            theirs.sendall(b'here')
            until(lambda: heard == b'here')


def test_a_port_that_another_program_has_bound_is_busy(peer):
    url = f'udpin://127.0.0.1:{peer.getsockname()[1]}'
    with pytest.raises(OSError, match='in use'):
        UdpPort(url)


HERE = (
    '/dev/ttyACM0', 'COM3', 'loop://', 'spy:///dev/ttyUSB0', 'hwgrep://FTDI',
    'socket://localhost:5760', 'socket://127.0.0.1:5760', 'rfc2217://[::1]:4000',
    'udp://127.0.0.1:14540', 'udpin://127.3.2.1:14540', 'udpout://LOCALHOST:14540',
)  # fmt: skip
ELSEWHERE = (
    'RFC2217://rig:4000', 'unknown://rig', 'socket://192.168.1.4:5760', 'udp://rig:14540',
    'udp://:14540', 'udpin://0.0.0.0:14540', 'udp://127.0.0.1.rig.org:1', 'udp://14540',
    'socket://127.0.0.1:5760@rig:1',
)  # fmt: skip


def test_loopback_is_like_a_cable_and_any_other_network_is_not():
    assert {port: over_network(port) for port in HERE} == dict.fromkeys(HERE, False)
    assert {port: over_network(port) for port in ELSEWHERE} == dict.fromkeys(ELSEWHERE, True)
