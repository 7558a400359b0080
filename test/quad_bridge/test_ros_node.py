"""Parameters of nodes: what YAML makes of a plain `off` is taken for it where it makes sense."""

import signal
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
    told = 'bag_logger: parameter foldr: is unknown; known are folder\n'
    assert capsys.readouterr().err == told


def spun(monkeypatch, callback, node):
    """Run a node whose executor calls `callback` until it ends by SIGTERM's handler."""
    handlers = {}
    monkeypatch.setattr('quad_bridge.ros_node.rclpy.init', lambda **_: None)
    monkeypatch.setattr('quad_bridge.ros_node.rclpy.try_shutdown', lambda: None)
    monkeypatch.setattr('quad_bridge.ros_node.signal.signal', handlers.__setitem__)
    executor = SimpleNamespace(
        add_node=lambda _node: None,
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
