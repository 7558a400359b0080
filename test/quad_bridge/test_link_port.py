"""The port survives what ports do: absent, busy, hung up, replugged, foreign."""

import fcntl
import os
import socket
import threading
import time
from types import SimpleNamespace

import pytest
from flight_controller import Pty
from probe import PATIENCE_S

from quad_bridge.link import port as serial_port
from quad_bridge.link.port import PortState, SerialPort
from quad_bridge.nodes.fence import Sparing


def until(condition):
    """Poll a condition; the bound is a safety net, not a measurement."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True


@pytest.fixture
def line(tmp_path):
    return Pty(tmp_path / 'tty')


class Ears:
    def __init__(self):
        self.data, self.opened = b'', 0

    def bytes(self, data):
        self.data += data

    def open(self):
        self.opened += 1


@pytest.fixture
def start():
    ports = []

    def make(path):
        ears = Ears()
        port = SerialPort(str(path), 921600, ears.bytes, ears.open, reopen_s=0.02)
        ports.append(port)
        port.start()
        return port, ears

    yield make
    for port in ports:
        port.stop()
        assert port.status.state is PortState.CLOSED


def test_bytes_arrive_and_leave(line, start):
    port, ears = start(line.link)
    assert until(lambda: port.status.state is PortState.OPEN)
    os.write(line.master, b'hello')
    assert until(lambda: ears.data == b'hello')
    assert port.write(b'back')
    assert os.read(line.master, 10) == b'back'


def test_a_port_that_does_not_exist_is_waited_for(tmp_path, start):
    port, ears = start(tmp_path / 'tty')
    assert until(lambda: port.status.state is PortState.NOT_THERE)
    assert not port.write(b'lost')
    assert port.status.dropped_writes == 0  # the diagnostics say that it is shut
    line = Pty(tmp_path / 'tty')
    assert until(lambda: port.status.state is PortState.OPEN)
    os.write(line.master, b'x')
    assert until(lambda: ears.data == b'x')


def test_a_busy_port_is_named_so_and_taken_when_free(line, start):
    with os.fdopen(os.open(line.link, os.O_RDWR | os.O_NOCTTY), 'rb', buffering=0) as other:
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        port, _ = start(line.link)
        assert until(lambda: port.status.state is PortState.BUSY)
    assert until(lambda: port.status.state is PortState.OPEN)


def test_hang_up_and_replug_under_the_same_name(line, start):
    port, ears = start(line.link)
    assert until(lambda: port.status.state is PortState.OPEN)
    line.unplug()
    assert until(lambda: port.status.state in {PortState.HUNG_UP, PortState.NOT_THERE})
    line.plug()
    assert until(lambda: port.status.state is PortState.OPEN and ears.opened == 2)
    os.write(line.master, b'again')
    assert until(lambda: ears.data == b'again')
    assert port.status.opened == 2


def test_a_pattern_finds_the_adapter_under_another_name(tmp_path, start):
    port, ears = start(tmp_path / 'ttyACM*')
    assert until(lambda: port.status.state is PortState.NOT_THERE)
    assert 'nothing matches' in port.status.detail
    first = Pty(tmp_path / 'ttyACM0')
    assert until(lambda: port.status.state is PortState.OPEN)
    first.unplug()
    assert until(lambda: port.status.state is PortState.NOT_THERE)
    second = Pty(tmp_path / 'ttyACM1')
    assert until(lambda: port.status.state is PortState.OPEN)
    assert port.status.path == str(tmp_path / 'ttyACM1')
    os.write(second.master, b'here')
    assert until(lambda: ears.data == b'here')


def test_a_link_that_leads_elsewhere_is_followed_though_nothing_has_hung_up(line, start):
    """As /dev/serial/by-id after a re-enumeration that left the old device half-open."""
    port, ears = start(line.link)
    assert until(lambda: port.status.state is PortState.OPEN)
    line.link.unlink()
    line.plug()  # the old pty stays open, and silent
    assert until(lambda: ears.opened == 2)
    os.write(line.master, b'new')
    assert until(lambda: ears.data == b'new')


def test_a_silent_one_of_several_is_left_for_the_next(tmp_path, start, monkeypatch):
    monkeypatch.setattr(serial_port, 'HALF_OPEN_S', (0.3, 60.0))
    Pty(tmp_path / 'ttyACM0')
    talking = Pty(tmp_path / 'ttyACM1')
    port, ears = start(tmp_path / 'ttyACM*')
    assert until(lambda: port.status.path.endswith('1'))
    os.write(talking.master, b'x')
    assert until(lambda: ears.data == b'x')


def test_a_silent_port_is_opened_anew_ever_less_often(line, start, monkeypatch):
    monkeypatch.setattr(serial_port, 'HALF_OPEN_S', (0.05, 1e9))
    port, ears = start(line.link)
    assert until(lambda: ears.opened == 3)
    os.write(line.master, b'x')
    assert until(lambda: ears.data == b'x')
    assert port.status.state is PortState.OPEN


def test_a_log_says_things_once_and_never_floods():
    log = Sparing(repeat_s=30.0, burst=5, per_s=60.0)
    assert [log.allow('hung up', t) for t in (0.0, 1.0, 29.0, 30.0)] == [True, False, False, True]
    assert [log.allow(f'line {k}', 31.0) for k in range(5)] == [True] * 3 + [False] * 2
    assert log.allow('line 9', 70.0)
    assert log.left_out == 4


def test_a_file_that_is_no_terminal_is_said_to_be_unusable(tmp_path, start):
    path = tmp_path / 'file'
    path.write_text('text', encoding='utf-8')
    port, _ = start(path)
    assert until(lambda: port.status.state is PortState.UNUSABLE)
    assert '\n' not in port.status.detail


def test_an_output_that_takes_frames_in_parts_tears_none(line, start, monkeypatch):
    port, _ = start(line.link)
    assert until(lambda: port.status.state is PortState.OPEN)
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
        arrived += os.read(line.master, 65536)
    assert arrived == expected
    assert port.status.dropped_writes >= len(frames) - len(taken)


def test_what_is_said_to_a_port_that_was_pulled_out_is_not_counted(line, start):
    port, _ = start(line.link)
    assert until(lambda: port.status.state is PortState.OPEN)
    line.unplug()
    assert until(lambda: port.status.state is PortState.NOT_THERE)
    assert not port.write(b'lost')
    assert (port.status.opened, port.status.dropped_writes) == (1, 0)


@pytest.fixture
def deaf():
    """A network peer that accepts and never reads."""
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        server.bind(('127.0.0.1', 0))
        server.listen(1)
        yield f'socket://127.0.0.1:{server.getsockname()[1]}'


def written(port, writes):
    """Whether so many writes come to an end; they are made in a thread that may hang."""
    thread = threading.Thread(target=lambda: [port.write(bytes(60)) for _ in range(writes)])
    thread.daemon = True
    thread.start()
    thread.join(PATIENCE_S)
    return not thread.is_alive()


def test_no_write_waits_for_a_terminal_whose_output_is_full(line, start):
    port, _ = start(line.link)
    assert until(lambda: port.status.state is PortState.OPEN)
    assert written(port, 2000)  # 120 KB, where 20 KB have room
    dropped = port.status.dropped_writes
    assert 1000 < dropped < 2000
    while not port.write(b'again'):
        os.read(line.master, 65536)
    assert port.status.state is PortState.OPEN


def test_no_write_waits_for_a_network_peer_that_stops_reading(deaf):
    port = SerialPort(deaf, 921600, lambda _: None)
    port.start()
    assert until(lambda: port.status.state is PortState.OPEN)
    assert written(port, 100_000)  # 6 MB, more than both ends buffer
    assert port.status.dropped_writes > 1000
    port.stop()
    assert port.status.state is PortState.CLOSED


def test_a_network_peer_that_does_not_listen_is_said_to_be_unreachable(start):
    with socket.socket() as closed:
        closed.bind(('127.0.0.1', 0))
        port, _ = start(f'socket://127.0.0.1:{closed.getsockname()[1]}')
        assert until(lambda: port.status.state is PortState.UNREACHABLE)
        assert 'refused' in port.status.detail


def test_what_opens_after_the_stop_is_not_announced(monkeypatch):
    """A network's peer may be waited for longer than anybody waits for the thread."""
    opening, stopped = threading.Event(), threading.Event()

    def late(*_args, **_named):
        opening.set()
        stopped.wait(PATIENCE_S)
        return SimpleNamespace(close=lambda: None, fileno=lambda: -1)

    monkeypatch.setattr(serial_port.serial, 'serial_for_url', late)
    ears = Ears()
    port = SerialPort('socket://far', 921600, ears.bytes, ears.open)
    port.start()
    assert opening.wait(PATIENCE_S)
    port.stop()  # does not wait for it
    assert port._thread.is_alive()
    stopped.set()
    port._thread.join(PATIENCE_S)
    assert (port.status.state, ears.opened) == (PortState.CLOSED, 0)


def test_stop_ends_the_thread_at_once(line):
    port = SerialPort(str(line.link), 921600, lambda _: None)
    port.start()
    assert until(lambda: port.status.state is PortState.OPEN)
    port.stop()
    port.stop()
    assert 'serial reader' not in [t.name for t in threading.enumerate() if t.is_alive()]
