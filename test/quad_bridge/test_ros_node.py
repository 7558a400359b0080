"""Parameters of nodes: what YAML makes of a plain `off` is taken for it where it makes sense."""

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from quad_bridge.errors import BadInputError
from quad_bridge.ros_node import choice, refuse_unknown, run

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
