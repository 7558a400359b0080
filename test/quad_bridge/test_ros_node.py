"""Parameters of nodes: what YAML makes of a plain `off` is taken for it where it makes sense."""

import signal
import sys
import threading
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from quad_bridge import ros_node
from quad_bridge.errors import BadInputError
from quad_bridge.ros_node import Fence, choice, refuse_unknown, run

MODES = ('auto', 'manual', 'off')


def node(value):
    return SimpleNamespace(
        declare_parameter=lambda _name, _default, _descriptor: SimpleNamespace(value=value),
        get_name=lambda: 'bridge',
    )


@pytest.mark.parametrize(('given', 'taken'), [('off', 'off'), (False, 'off'), ('auto', 'auto')])
def test_false_stands_for_off(given, taken):
    assert choice(node(given), 'polarity', MODES, 'pulses', no='off') == taken


@pytest.mark.parametrize('given', [True, 0, 'never', None])
def test_anything_else_is_refused_with_what_was_found(given):
    with pytest.raises(BadInputError, match=f'must be one of auto, manual, off: found {given!r}'):
        choice(node(given), 'polarity', MODES, 'pulses', no='off')


def test_false_is_no_choice_where_nothing_stands_for_it():
    with pytest.raises(BadInputError, match='found False'):
        choice(node(False), 'storage', ('mcap', 'sqlite3'), 'storage')


def test_a_refusal_names_the_node_once(monkeypatch, capsys):
    monkeypatch.setattr('quad_bridge.ros_node.rclpy.init', lambda **_: None)
    monkeypatch.setattr('quad_bridge.ros_node.rclpy.try_shutdown', lambda: None)
    monkeypatch.setattr('quad_bridge.ros_node.signal.signal', lambda *_: None)
    given = SimpleNamespace(
        _parameter_overrides={'foldr': SimpleNamespace(value='x')}, get_name=lambda: 'bag_logger'
    )
    with pytest.raises(SystemExit) as caught:
        run(lambda: refuse_unknown(given, ['folder']), 'bag_logger')
    assert caught.value.code == 2
    told = 'bag_logger: parameter foldr: is unknown; is it folder?\n'
    assert capsys.readouterr().err == told


def test_of_an_unknown_name_that_is_like_none_all_are_told_groups_once():
    given = SimpleNamespace(_parameter_overrides={'x': SimpleNamespace(value=1)})
    with pytest.raises(BadInputError, match=r'known are bounds\.\*, port$'):
        refuse_unknown(given, ['port', 'bounds.roll.rate.kp', 'bounds.yaw.rate.kp'])


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['--params-file', '{}/absent.yaml'], 'absent.yaml: cannot be read (No such file'),
        (['--params-file', '{}'], 'cannot be read (Is a directory)'),
        (['--params-file', '{}/broken.yaml'], 'Sequences can only be values'),
        (['--params-file', '{}/rootless.yaml'], 'Cannot have a value before ros__parameters'),
        (['-r', '__ns:=/2bad'], "'-r __ns:=/2bad'; write -r FROM:=TO"),
        (['-p', 'port:='], "'-p port:='; write -p NAME:=VALUE"),
        (['--log-level', 'loud'], 'does not use a valid severity level'),
        (['--nonsense'], "unknown argument: found ['--nonsense']"),
    ],
)
def test_wrong_arguments_of_ros_are_one_line(monkeypatch, tmp_path, capfd, arguments, words):
    (tmp_path / 'broken.yaml').write_text('bridge: [\n')
    (tmp_path / 'rootless.yaml').write_text('bridge:\n  port: x\n')
    given = ['bridge', '--ros-args', *(a.format(tmp_path) for a in arguments)]
    monkeypatch.setattr(sys, 'argv', given)
    monkeypatch.setattr('quad_bridge.ros_node.signal.signal', lambda *_: None)
    with pytest.raises(SystemExit) as caught:
        run(pytest.fail, 'bridge')
    assert caught.value.code == 2
    error = capfd.readouterr().err  # what rcl writes by itself included
    assert (error.count('\n'), words in error) == (1, True), error


def test_what_keeps_a_node_from_beginning_is_one_line(monkeypatch, capsys):
    def begin():
        raise OSError(36, 'File name too long', 'aaa')

    node = Told()
    node.begin = begin
    monkeypatch.setattr('quad_bridge.ros_node.rclpy.init', lambda **_: None)
    monkeypatch.setattr('quad_bridge.ros_node.rclpy.try_shutdown', lambda: None)
    monkeypatch.setattr('quad_bridge.ros_node.signal.signal', lambda *_: None)
    with pytest.raises(SystemExit) as caught:
        run(lambda: node, 'bag_logger')
    assert (caught.value.code, node.closed) == (2, 1)
    assert capsys.readouterr().err == 'bag_logger: aaa: File name too long\n'


@pytest.mark.parametrize(('set_', 'warned'), [({}, 1), ({'port': SimpleNamespace(value='x')}, 0)])
def test_a_parameter_file_of_another_node_is_told(monkeypatch, set_, warned):
    lines = []
    node = SimpleNamespace(
        _parameter_overrides=set_,
        get_fully_qualified_name=lambda: '/left/serial_bridge',
        get_logger=lambda: SimpleNamespace(warning=lines.append),
    )
    monkeypatch.setattr(sys, 'argv', ['bridge', '--ros-args', '--params-file', 'mine.yaml'])
    ros_node.tell_unused(node)
    assert len(lines) == warned
    assert all('root it at "/left/serial_bridge:"' in line for line in lines)


def spun(monkeypatch, callback, node):
    """Run a node whose executor calls `callback` until it ends by SIGTERM's handler."""
    handlers = {}
    monkeypatch.setattr('quad_bridge.ros_node.rclpy.init', lambda **_: None)
    monkeypatch.setattr('quad_bridge.ros_node.rclpy.try_shutdown', lambda: None)
    monkeypatch.setattr('quad_bridge.ros_node.signal.signal', handlers.__setitem__)
    executor = SimpleNamespace(
        add_node=lambda _node: None,
        shutdown=lambda timeout_sec: None,  # noqa: ARG005
        spin_once=lambda timeout_sec: callback(handlers[signal.SIGTERM]),  # noqa: ARG005
    )
    monkeypatch.setattr('quad_bridge.ros_node.SingleThreadedExecutor', lambda: executor)
    run(lambda: node, 'bridge')


class Told:
    """As much of a node as `run` needs."""

    def __init__(self):
        self.lines, self.closed = [], 0
        self.destroy_node = lambda: None

    def get_logger(self):
        return SimpleNamespace(error=self.lines.append)

    def close(self):
        self.closed += 1


def test_a_callback_that_fails_is_logged_once_and_does_not_end_the_node(monkeypatch):
    node, calls = Told(), []

    def callback(stop):
        calls.append(1)
        if len(calls) == 50:
            stop()
        if len(calls) % 2:
            raise OverflowError('int too large\nto convert')

    spun(monkeypatch, callback, node)
    assert len(calls) == 50
    assert node.closed == 1
    (line,) = node.lines
    assert 'OverflowError: int too large to convert' in line
    assert 'test_ros_node.py:' in line


def test_ros_that_fails_without_end_ends_the_node(monkeypatch):
    node = Told()

    def callback(_stop):
        raise RuntimeError('wait set')

    with pytest.raises(RuntimeError, match='wait set'):
        spun(monkeypatch, callback, node)
    assert node.closed == 1


def test_a_thread_of_its_own_outlives_whatever_its_callback_raises(monkeypatch):
    monkeypatch.setattr(ros_node, 'MOST_IN_A_ROW', 3)
    heard = []
    fence = Fence(lambda _line: None)

    def take(data):
        heard.append(data)
        if data == b'bad':
            raise KeyError(data)

    fenced = fence.around(take)
    for data in (b'bad',) * 5 + (b'good', b'bad'):
        fenced(data)
    assert len(heard) == 7
    assert fence.failed == 6
    assert (fence.lately(), fence.lately()) == (6, 0)


def test_a_port_that_goes_on_does_not_hide_that_ros_fails_without_end(monkeypatch):
    monkeypatch.setattr(ros_node, 'MOST_IN_A_ROW', 3)
    fence = Fence(lambda _line: None)

    def spin():
        raise RuntimeError('wait set')

    def both():
        for _ in range(10):
            try:
                spin()
            except RuntimeError as error:
                fence.take(error)
            port = threading.Thread(target=fence.around(lambda: None))
            port.start()
            port.join()

    with pytest.raises(RuntimeError, match='wait set'):
        both()
    assert fence.failed == 4
