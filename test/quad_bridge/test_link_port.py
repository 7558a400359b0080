"""The port survives what ports do: absent, busy, hung up, replugged, foreign; and networks."""

import fcntl
import os
import select
import socket
import threading

import pytest
from flight_controller import Pty
from node_process import until
from probe import PATIENCE_S

from quad_bridge.link import port as serial_port
from quad_bridge.link.port import PortState, SerialPort, over_network
from quad_bridge.link.udp import UdpPort


@pytest.fixture
def line(tmp_path):
    return Pty(tmp_path / 'tty')


def read(line):
    """What comes at the other end within a moment."""
    return line.read() if select.select([line], [], [], 0.01)[0] else b''


class Started(SerialPort):
    """A port that notes what it hears and how often it was opened."""

    def __init__(self, path):
        self.data, self.openings, self.early = b'', 0, False
        super().__init__(str(path), 921600, self.take, self.count)

    def take(self, data):
        self.data += data

    def count(self):
        self.openings += 1
        self.early |= self.write(b'meant for the device before')

    def reaches(self, *states):
        until(lambda: self.status.state in states)

    def hears(self, line, data):
        self.data = b''
        os.write(line.master, data)
        until(lambda: self.data == data)


@pytest.fixture
def start(monkeypatch):
    monkeypatch.setattr(serial_port, 'REOPEN_S', 0.02)
    ports = []

    def make(path, *states):
        ports.append(Started(path))
        ports[-1].start()
        ports[-1].reaches(*states or [PortState.OPEN])
        return ports[-1]

    yield make
    for port in ports:
        assert not port.early
        port.stop()
        port.stop()
        port.reaches(PortState.CLOSED)
        until(lambda port=port: not port._thread.is_alive())


def test_a_busy_port_is_named_so_and_taken_when_free(line, start):
    with os.fdopen(os.open(line.link, os.O_RDWR | os.O_NOCTTY), 'rb', buffering=0) as other:
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        port = start(line.link, PortState.BUSY)
    port.reaches(PortState.OPEN)


def test_hang_up_and_replug_under_the_same_name(line, start):
    port = start(line.link)
    line.unplug()
    port.reaches(PortState.HUNG_UP, PortState.NOT_THERE)
    port.reaches(PortState.NOT_THERE)
    assert not port.write(b'lost')
    assert (port.status.opened, port.status.dropped_writes) == (1, 0)
    line.plug()
    until(lambda: port.status.state is PortState.OPEN and port.openings == 2)
    port.hears(line, b'again')
    assert port.status.opened == 2


def test_a_silent_one_of_several_is_left_for_the_next(tmp_path, start, monkeypatch):
    monkeypatch.setattr(serial_port, 'HALF_OPEN_S', (0.3, 60.0))
    Pty(tmp_path / 'ttyACM0')
    talking = Pty(tmp_path / 'ttyACM1')
    port = start(tmp_path / 'ttyACM*')
    until(lambda: port.data, 'a word', lambda: talking.write(b'x'))
    assert port.status.path.endswith('1')


def test_an_output_that_takes_frames_in_parts_tears_none(line, start, monkeypatch):
    port = start(line.link)
    write, room = serial_port._write, [True]
    monkeypatch.setattr(serial_port, '_write', lambda p, data: room[0] and write(p, data[:7]))
    frames = [bytes([k]) * 20 for k in range(1, 100)]
    taken = [frame for frame in frames if port.write(frame)]
    assert len(taken) > 20  # a frame goes in three parts, and two find the one before in the way
    room[0] = False
    assert not port.write(b'no room, not even for a part')
    room[0] = True
    while not port.write(bytes(7)):
        pass
    expected, arrived = b''.join(taken) + bytes(7), b''
    while len(arrived) < len(expected):  # a pseudo-terminal hands out what it likes at once
        arrived += read(line)
    assert arrived == expected
    assert port.status.dropped_writes >= len(frames) - len(taken)


def written(port, writes):
    """Whether so many writes come to an end; they are made in a thread that may hang."""
    thread = threading.Thread(target=lambda: [port.write(bytes(60)) for _ in range(writes)])
    thread.daemon = True
    thread.start()
    thread.join(PATIENCE_S)
    return not thread.is_alive()


def test_no_write_waits_for_a_terminal_whose_output_is_full(line, start):
    port = start(line.link)
    assert written(port, 2000)  # 120 KB, where 20 KB have room
    assert 1000 < port.status.dropped_writes < 2000
    while not port.write(b'again'):
        read(line)
    assert port.status.state is PortState.OPEN


# Networks: who listens, who is answered, and which ports need a key.


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


@pytest.mark.parametrize('scheme', ['udp', 'udpin'])
def test_who_sends_to_a_free_port_of_ours_is_heard_and_answered(scheme, free, peer, start):
    """PX4's simulator sends to 14540, and listens where it sends from."""
    port = start(f'{scheme}://127.0.0.1:{free}')
    assert port.status.path == f'udpin://127.0.0.1:{free}'
    assert port.write(b'to nobody yet')
    assert port.status.dropped_writes == 0
    peer.sendto(b'one', ('127.0.0.1', free))
    peer.sendto(b' two', ('127.0.0.1', free))
    until(lambda: port.data == b'one two')
    gone = {('127.0.0.1', 0): float('inf')}  # another one, whose network is not there any more
    port._port._peers = gone | port._port._peers
    assert port.write(b'answer')
    assert peer.recv(100) == b'answer'


def test_many_who_speak_keep_no_answer_from_one_who_goes_on(free, peer, start):
    port = start(f'udpin://127.0.0.1:{free}')
    for k in range(20):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.sendto(b'.', ('127.0.0.1', free))
        until(lambda k=k: len(port.data) == k + 1)
    peer.sendto(b'one', ('127.0.0.1', free))
    until(lambda: port.data.endswith(b'one'))
    assert port.write(b'answer')
    assert peer.recv(100) == b'answer'
    assert len(port._port._peers) <= 8


@pytest.mark.parametrize('scheme', ['udp', 'udpout'])
def test_who_listens_already_is_spoken_to(scheme, peer, start):
    number = peer.getsockname()[1]
    port = start(f'{scheme}://127.0.0.1:{number}')
    assert port.status.path == f'udpout://127.0.0.1:{number}'
    assert port.write(b'hello')
    data, ours = peer.recvfrom(100)
    assert data == b'hello'
    peer.sendto(b'here', ours)
    until(lambda: port.data == b'here')


def test_a_server_of_tcp_is_spoken_to(start):
    with socket.create_server(('127.0.0.1', 0)) as server:
        port = start(f'socket://127.0.0.1:{server.getsockname()[1]}')
        with server.accept()[0] as theirs:
            assert port.write(b'hello')
            assert theirs.recv(100) == b'hello'
            theirs.sendall(b'here')
            until(lambda: port.data == b'here')


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
